"""Path gradients while successive ones agree, then Gauss-Newton steps, for few numbers."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np

from unrender.core import arrays, checks, trees
from unrender.core.random import WARM_UP, Key
from unrender.core.registry import register
from unrender.core.trees import Tree
from unrender.estimators.base import Estimate
from unrender.estimators.capabilities import BlockEstimate, Capabilities, Gradient, Hessian, HessianNoise
from unrender.estimators.derivative_images import cost
from unrender.estimators.gauss_newton import GaussNewton, GaussNewtonState
from unrender.estimators.gauss_newton_system import Point
from unrender.estimators.path import PathGradient, PathGradientState
from unrender.scene.problem import Problem
from unrender.scene.upsampling import Upsampler
from unrender.statistics.scores import scaled_eigh

_NEWTON = 1 << 34
"""Stream of a step's key for the Gauss-Newton step; path gradients use lower streams."""
_MEMORY = 0.8
"""Decay of the mean correlation of successive gradients and of their mean square, as in `AgreementRate`."""
_AGREEMENT = 0.5
"""Mean correlation below which path gradients are noise or oppose each other, and `AgreementRate` raises no rate."""
_CLEAR, _LONGEST_WAIT = 2.0, 16.0
"""Ratio of noise to curvature below which a trial is a step; largest factor of the steps until the next trial."""


@dataclass(frozen=True)
class PathThenNewtonState:
    """State between steps.

    Attributes:
        path: state of the path gradients, after the change that before the first step.
        newton: state of the Gauss-Newton steps.
        changed: whether these have begun.
        origin: initial parameters, (n,).
        step: number of steps so far.
        trial: number of steps from which derivative images may be tried.
        agreement: mean correlation of successive path gradients, each element relative to its root mean square.
        last: last path gradient, (n,); zeros before the first.
        square: mean square of the path gradients, (n,).
    """

    path: PathGradientState
    newton: GaussNewtonState
    changed: bool
    origin: np.ndarray
    step: int
    trial: int
    agreement: float
    last: np.ndarray
    square: np.ndarray

    def upsampled(self, upsampler: Upsampler) -> PathThenNewtonState:
        return self


@register
@dataclass(frozen=True)
class PathThenNewton:
    """Path gradients first, and Gauss-Newton steps from the step on from which these promise more.

    A path gradient costs little, so it is ahead while gradients agree. Near the solution it is mostly noise, and a Gauss-Newton step is the
    better average. Derivative images are tried as soon as the mean correlation of successive gradients falls below one half and the steps
    so far took at least the time of that trial. If curvatures are positive, and noise adds less than twice as much to them, the trial is
    the first Gauss-Newton step. Otherwise the next trial follows after twice as many steps, or after as many times the steps as noise
    exceeds the curvature, at most 16. The first differences are as wide as the parameters have moved so far. Elements at a bound beyond
    which the loss falls, and elements that change no image, do not count.

    A Gauss-Newton step is a `BlockEstimate` of all parameters. An optimizer such as `Successive` therefore takes both kinds of steps.

    Args:
        path: estimator of the first steps.
        newton: estimator of the later ones.
    """

    path: PathGradient = field(default_factory=PathGradient)
    newton: GaussNewton = field(default_factory=GaussNewton)

    def __post_init__(self):
        checks.fields(self)

    @property
    def spp(self) -> int:
        """Samples per pixel of the path gradients."""
        return self.path.spp

    provides = Capabilities(Gradient, BlockEstimate)

    def pixel_weights(self, state: PathThenNewtonState) -> tuple[np.ndarray, ...]:
        return self.newton.pixel_weights(state.newton) if state.changed else ()

    def init(self, problem: Problem, parameters: Tree) -> PathThenNewtonState:
        """Return the state before the first step. Raises `InputError` for a parameter that one of the two does not support."""
        theta = trees.ravel(parameters)
        newton, path = self.newton.init(problem, parameters), self.path.init(problem, parameters)
        return PathThenNewtonState(path, newton, False, theta, 0, 0, 1.0, np.zeros_like(theta), np.zeros_like(theta))

    def estimate(
        self, problem: Problem, parameters: Tree, state: PathThenNewtonState, key: Key
    ) -> tuple[Estimate, PathThenNewtonState]:
        """Return an estimate and the next state. `info`: that of the estimator of this step, with "samples" of a trial, too."""
        own, tried = key.fold(_NEWTON), 0
        if key.stream == WARM_UP and not state.step:  # compiles its kernels
            self.newton.estimate(problem, parameters, self._begun(problem, parameters, state), own)
        elif state.changed or self._is_due(problem, state):
            begun = state.newton if state.newton.widths else self._begun(problem, parameters, state)
            estimate, newton = self.newton.estimate(problem, parameters, begun, own)
            state = replace(state, newton=newton)
            noise = (
                0.0 if state.changed else _noise(estimate, _free(problem, parameters, trees.ravel(estimate.gradient)))
            )
            if noise < _CLEAR:
                if not state.changed:  # control variates of earlier parameters are no pictures of the end
                    state = replace(state, path=self.path.init(problem, parameters), changed=True)
                block = BlockEstimate(tuple(parameters), estimate)
                return replace(estimate, capabilities=(block,)), replace(state, step=state.step + 1)
            wait = min(max(noise, 2.0), _LONGEST_WAIT)
            tried, state = int(estimate.info["samples"]), replace(state, trial=math.ceil(wait * state.step))
        estimate, path = self.path.estimate(problem, parameters, state.path, key)
        estimate = replace(
            estimate,
            capabilities=(*estimate.capabilities, BlockEstimate((), None)),
            info={**estimate.info, "samples": int(estimate.info["samples"]) + tried},
        )
        gradient = trees.ravel(estimate.gradient)
        return estimate, replace(_observed(state, gradient, _free(problem, parameters, gradient)), path=path)

    def _is_due(self, problem: Problem, state: PathThenNewtonState) -> bool:
        """Return whether derivative images are to be tried."""
        renders, pixels = 2 * state.origin.size, problem.pixels
        trial = cost(pixels * (self.newton.spp + renders * self.newton.derivative_spp), 2 * renders + 2)
        spent = state.step * cost(2 * pixels * self.path.spp, 2)  # images and adjoints
        return state.agreement < _AGREEMENT and state.step >= state.trial and spent >= trial

    def _begun(self, problem: Problem, parameters: Tree, state: PathThenNewtonState) -> GaussNewtonState:
        """Return the state before the first Gauss-Newton step, with widths as large as the way so far."""
        point = Point(self.newton, problem, parameters)
        moved = trees.parts(np.abs(point.theta - state.origin)[None], parameters)
        least = {
            key: self.newton.width * (float(np.abs(arrays.numpy(x)).max()) or 1.0) for key, x in parameters.items()
        }
        widths = {key: min(max(float(moved[key].max()), least[key]), point.largest[key]) for key in parameters}
        return replace(state.newton, widths=widths, shift=self.newton.coarse or self.newton.shift, point=point.theta)


def _free(problem: Problem, parameters: Tree, gradient: np.ndarray) -> np.ndarray:
    """Return which elements are not at a bound beyond which the loss falls, (n,)."""
    sides = trees.ravel({key: problem.unknowns[key].sides(x) for key, x in parameters.items()})
    return sides * gradient >= 0.0


def _noise(estimate: Estimate, free: np.ndarray) -> float:
    """Return the mean ratio of what noise adds to a curvature to the curvature; infinite unless all curvatures are positive.

    Only `free` elements count that change the images: no step moves the others.
    """
    hessian, noise = (
        arrays.numpy(estimate.require("PathThenNewton", kind).matrix).astype(np.float64)
        for kind in (Hessian, HessianNoise)
    )
    used = np.flatnonzero(free & (np.diag(hessian) != 0.0))
    hessian, noise = (x[np.ix_(used, used)] for x in (hessian, noise))
    if not used.size or not (np.isfinite(hessian).all() and np.isfinite(noise).all()):
        return math.inf
    scales, curvatures, directions = scaled_eigh(hessian)
    added = np.einsum("ki,kl,li->i", directions, noise / scales, directions)
    return float((added / curvatures).mean()) if (curvatures > 0.0).all() else math.inf


def _observed(state: PathThenNewtonState, gradient: np.ndarray, free: np.ndarray) -> PathThenNewtonState:
    """Return the state after a path gradient (n,), whose `free` elements (n,) count in the agreement."""
    agreement, square = state.agreement, np.square(gradient)
    if state.step:
        square = _MEMORY * state.square + (1.0 - _MEMORY) * square
        units = np.where(free & (square > 0.0), np.sqrt(square), np.inf)
        one, other = gradient / units, state.last / units
        lengths = math.sqrt(float(one @ one) * float(other @ other))
        agreement = _MEMORY * agreement + (1.0 - _MEMORY) * (float(one @ other) / lengths if lengths > 0.0 else 0.0)
    return replace(state, step=state.step + 1, agreement=agreement, last=gradient, square=square)
