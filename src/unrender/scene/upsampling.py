"""The step to a finer resolution: how parameters, and what components remember of them, are interpolated.

Where a texel becomes n finer ones (n is the ratio of their numbers), the finer ones share its gradient: with x = P u for the
interpolation P, ∂L/∂u = Pᵀ ∂L/∂x, so an element of ∂L/∂x is about 1/n of one of ∂L/∂u, and the detail of ∂L/∂x that Pᵀ averages out is
unknown. A state that is carried is therefore interpolated like the parameter, times a power of 1/n:

- parameters of an earlier step: 1;
- gradients (Adam's first moment, velocities, meta-estimates and their differences): 1/n;
- mean squares and variances of gradients: 1/n². That is what they do where gradients are smooth, so Adam's steps keep their length. Noise
  falls less, up to 1/n where each path touches one texel alone: steps are then too long by up to √n until the means have followed.

What is kept per pixel (a control variate and its statistics, the pixels' probabilities) belongs to images, and stays as it is: at the finer
resolution the previous state is the interpolated one, whose image differs only by the kinks of linear interpolation; that difference
decays with the control weights.

A meta-estimate carries on without the detail, which it learns as its memory is replaced: biased for as long.

States that are not carried start again, as before the first step; but learning rates, their schedules and the smoothing's go on (not
those of L-BFGS, which counts its pairs by them).
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
"""The power of 1/n with which mean squares of gradients are carried."""


class NotCarried(Exception):
    """A state that is tied to its resolution."""


@dataclass
class Upsampler:
    """The interpolation from the parameters' shapes to those of a step.

    Args:
        problem: whose `coarse_to_fine` gives the shapes.
        step: the coming one.
        parameters: the current ones, still coarse.
    """

    problem: Problem
    step: int
    parameters: Tree
    shares: dict[str, float] = field(default_factory=dict)

    def __post_init__(self):
        self._shapes = self.problem.shapes(self.step)
        for key, old in trees.shapes(self.parameters).items():
            if old != self._shapes[key]:
                self.shares[key] = math.prod(old) / math.prod(self._shapes[key])

    def tree(self, tree: Tree, power: float = 0.0, factor: float = 1.0) -> Tree:
        """{key: array} of the parameters' coarse shapes at the finer ones, times `factor` and (1/n)^`power`."""
        return {key: self.array(key, value, power, factor) for key, value in tree.items()}

    def array(self, key: str, value: Array, power: float = 0.0, factor: float = 1.0) -> Array:
        """Likewise of one parameter."""
        if key not in self.shares:
            return value if factor == 1.0 else value * arrays.scalar(factor, value)
        way = self.problem.coarse_to_fine[key]
        fine = way.refined(arrays.numpy(value), self._shapes[key]) * (self.shares[key] ** power * factor)
        return arrays.like(fine, value)


@runtime_checkable
class Upsamplable(Protocol):
    """A state that can be carried to a finer resolution."""

    def upsampled(self, upsampler: Upsampler) -> Any:
        """The state at the finer resolution; itself where nothing in it has a parameter's shape.

        Raises `NotCarried` for one that is tied to its resolution.
        """
        ...


@runtime_checkable
class Restartable(Protocol):
    """A state part of which goes on where the rest starts again."""

    def restarted(self, fresh: Any) -> Any:
        """`fresh`, a state from `init`, with what goes on: the count of steps of a schedule."""
        ...


def upsampled(state: Any, upsampler: Upsampler) -> Any:
    """The state at the finer resolution, None where there is none. Raises `NotCarried` for one that is no `Upsamplable`."""
    if state is None:
        return None
    if not isinstance(state, Upsamplable):
        raise NotCarried(type(state).__name__)
    return state.upsampled(upsampler)


def restarted(state: Any, fresh: Any) -> Any:
    """`fresh`, with what goes on of a `Restartable` state."""
    return state.restarted(fresh) if isinstance(state, Restartable) else fresh
