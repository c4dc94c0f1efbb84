"""Refinement of the resolution: interpolation of parameters and of the components' states.

Suppose that refinement divides a texel into n finer ones. With the interpolation P and x = P u, ∂L/∂u = Pᵀ ∂L/∂x. An element of ∂L/∂x is
thus about 1/n of one of ∂L/∂u, and the detail that Pᵀ averages out is unknown. A state is therefore interpolated like the parameter,
times a power of 1/n:

- parameters of an earlier step: 1;
- gradients (Adam's first moment, velocities, meta-estimates and their differences): 1/n;
- mean squares and variances of gradients: 1/n². This is exact for smooth gradients, so the lengths of Adam's steps are preserved. Noise
  decreases less, by down to 1/n if each path touches one texel only. Steps are then too long by up to √n until the means have adapted.

States per pixel (a control variate and its statistics, the pixels' probabilities) belong to images and stay unchanged. At the finer
resolution the previous state is the interpolated one, whose image differs only by the kinks of linear interpolation. That difference
decays with the control weights.

A meta-estimate lacks the detail until new samples have replaced it, and is biased until then.

Other states restart as before the first step. Learning rates, their schedules and that of the smoothing continue, except for L-BFGS,
which counts its pairs by them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any, Protocol, runtime_checkable

from unrender.core import arrays, trees
from unrender.core.arrays import Array
from unrender.core.trees import Tree
from unrender.scene.problem import Problem

SQUARES = 2.0
"""Power of 1/n by which mean squares of gradients are scaled."""


class NotCarried(Exception):
    """A state that cannot be interpolated to another resolution."""


@dataclass
class Upsampler:
    """Interpolation from the current shapes of coarse parameters to those of the next step, by `coarse_to_fine`; `shares` are {key: 1/n} of
    those whose shape changes."""

    problem: Problem
    step: int
    parameters: Tree
    shares: dict[str, float] = field(default_factory=dict, init=False)

    def __post_init__(self):
        self._shapes = self.problem.shapes(self.step)
        for key, old in trees.shapes(self.parameters).items():
            if old != self._shapes[key]:
                self.shares[key] = math.prod(old) / math.prod(self._shapes[key])

    def tree(self, tree: Tree, power: float = 0.0) -> Tree:
        """Interpolate {key: array} to the finer shapes, and multiply by (1/n)^`power`."""
        return {key: self.array(key, value, power) for key, value in tree.items()}

    def array(self, key: str, value: Array, power: float = 0.0, factor: float = 1.0) -> Array:
        """Interpolate the array of one parameter as `tree` does, and multiply it by `factor`."""
        if key not in self.shares:
            return value if factor == 1.0 else value * arrays.scalar(factor, value)
        resolutions = self.problem.coarse_to_fine[key]
        fine = resolutions.refined(arrays.numpy(value), self._shapes[key]) * (self.shares[key] ** power * factor)
        return arrays.like(fine, value)


@runtime_checkable
class Upsamplable(Protocol):
    """A state that can be interpolated to a finer resolution."""

    def upsampled(self, upsampler: Upsampler) -> Any:
        """Return the state at the finer resolution; itself without a parameter's shape. Raises `NotCarried` if that is impossible."""
        ...


class Unchanged:
    """Base of a state in which nothing has a parameter's shape."""

    def upsampled(self, upsampler: Upsampler) -> Any:
        return self


@runtime_checkable
class Restartable(Protocol):
    """A state with a part that continues after a restart."""

    def restarted(self, fresh: Any) -> Any:
        """Return `fresh`, a state from `init`, with the part that continues, such as a schedule's step count."""
        ...


def upsampled(state: Any, upsampler: Upsampler) -> Any:
    """Return the state at the finer resolution, None for None. Raises `NotCarried` for a state that is not `Upsamplable`."""
    if state is None:
        return None
    if not isinstance(state, Upsamplable):
        raise NotCarried(type(state).__name__)
    return state.upsampled(upsampler)


def restarted(state: Any, fresh: Any) -> Any:
    """Return `fresh`, with the part of a `Restartable` state that continues."""
    return state.restarted(fresh) if isinstance(state, Restartable) else fresh
