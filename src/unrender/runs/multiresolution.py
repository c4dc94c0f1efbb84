"""A run's step to a finer resolution: the parameters, and what optimizer, estimator and pixel sampler remember.

Where a texel becomes n finer ones (n is the ratio of their numbers), the finer ones share its gradient: with x = P u for the
interpolation P, ∂L/∂u = Pᵀ ∂L/∂x, so an element of ∂L/∂x is about 1/n of one of ∂L/∂u, and the detail of ∂L/∂x that Pᵀ averages out is
unknown. *Carried* states are therefore interpolated like the parameter, times a power of 1/n:

- parameters of an earlier step: 1;
- gradients (Adam's first moment, velocities, meta-estimates and their differences): 1/n;
- mean squares and variances of gradients: 1/n². That is what they do where gradients are smooth, so Adam's steps keep their length. Noise
  falls less, up to 1/n where each path touches one texel alone: steps are then too long by up to √n until the means have followed.

What is kept per pixel (a control variate and its statistics, the pixels' probabilities) is of pictures, and stays as it is: at the finer
resolution the previous state is the interpolated one, whose picture differs only by the kinks of linear interpolation; that difference
decays with the control weights.

A meta-estimate carries on without the detail, which it learns as its memory is replaced: biased for as long.

By default (`CoarseToFine.states`) the estimator's state is carried and the optimizer's is not. That came out best, or as good as
any, in `benchmarks/coarse_to_fine`: a control variate is what a run has paid for and stays true, while Adam's mean squares take a
thousand steps to follow.

States that are not carried start anew, as before the first step; but learning rates, their schedules and the smoothing's go on (not
those of L-BFGS, which counts its pairs by them).
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, field, replace
from functools import singledispatch
from typing import Any

from unrender.core import arrays, trees
from unrender.core.arrays import Array
from unrender.core.trees import Tree
from unrender.estimators.meta import MetaState
from unrender.estimators.path import PathGradientState
from unrender.estimators.smoothed import SmoothedState
from unrender.images.plain import PlainState
from unrender.images.recursive_control_variate import RecursiveControlVariateState
from unrender.optimizers.adam import AdamState
from unrender.optimizers.meta_adam import MetaAdamState
from unrender.optimizers.newton import NewtonState
from unrender.optimizers.sgd import SGDState
from unrender.pixels.all import AllState
from unrender.pixels.guided import GuidedSamplerState
from unrender.pixels.uniform import UniformState
from unrender.problem.problem import Problem
from unrender.runs.noise import GradientNoise
from unrender.runs.run import Memory, Run
from unrender.statistics import meta

SQUARES = 2.0
"""The power of 1/n with which mean squares of gradients are carried."""


def is_due(run: Run) -> bool:
    """Whether the next step is the first of another resolution."""
    return bool(run.problem.coarse_to_fine) and trees.shapes(run.parameters) != run.problem.shapes(run.step)


def unfinished(run: Run) -> list[str]:
    """One line for each parameter that did not come to its scene's own resolution."""
    found = []
    for key, way in run.problem.coarse_to_fine.items():
        if (shape := arrays.shape(run.parameters[key])) != run.problem.shapes()[key]:
            size = "x".join(map(str, reversed(shape[:-1])))
            found.append(
                f"parameter {key}: still {size} at the end, after {run.step} steps of at least {way.steps[-1] + 1}"
            )
    return found


def refine(run: Run, memory: Memory) -> float:
    """Bring parameters and states to the resolution of the next step. Returns the seconds it took."""
    started = time.perf_counter()
    upsampler = Upsampler(run.problem, run.step, run.parameters)
    asked = {way.states for key, way in run.problem.coarse_to_fine.items() if key in upsampler.shares}
    carry = {"estimator": "reset" not in asked, "optimizer": asked == {"carry"}}
    run.parameters = upsampler.tree(run.parameters)
    fresh = (
        run.estimator.init(run.problem, run.parameters),
        run.optimizer.init(run.parameters, run.problem.learning_rates),
    )
    for name, new in zip(("estimator", "optimizer"), fresh, strict=True):
        state = getattr(memory, name)
        try:
            state = carried(state, upsampler) if carry[name] else restarted(state, new)
        except NotCarried as error:
            run.warnings.append(f"step {run.step}: {error} cannot be carried to another resolution: it starts anew")
            state = restarted(state, new)
        setattr(memory, name, state)
    memory.noise = GradientNoise()
    arrays.evaluate(run.parameters, memory.estimator, memory.optimizer)
    return time.perf_counter() - started


class NotCarried(Exception):
    """A state that is tied to its resolution."""


@dataclass
class Upsampler:
    """The interpolation from the parameters' shapes to those of a step.

    Args:
        problem: whose.
        step: that is to come.
        parameters: the current ones, still coarse.
    """

    problem: Problem
    step: int
    parameters: Tree
    shares: dict[str, float] = field(default_factory=dict)
    _made: dict[int, tuple[Array, Array]] = field(default_factory=dict)

    def __post_init__(self):
        self._shapes = self.problem.shapes(self.step)
        for key, old in trees.shapes(self.parameters).items():
            if old != self._shapes[key]:
                self.shares[key] = math.prod(old) / math.prod(self._shapes[key])

    def tree(self, tree: Tree, power: float = 0.0, factor: float = 1.0) -> Tree:
        """{key: array} of the parameters' coarse shapes at the finer ones, times `factor` and (1/n)^`power`."""
        return {key: self.array(key, value, power, factor) for key, value in tree.items()}

    def array(self, key: str, value: Array, power: float = 0.0, factor: float = 1.0) -> Array:
        """Likewise of one parameter. Equal objects stay equal where nothing but the resolution changes: estimators compare them."""
        plain = power == 0.0 and factor == 1.0
        if key not in self.shares:
            return value if factor == 1.0 else value * arrays.scalar(factor, value)
        if plain and id(value) in self._made:
            return self._made[id(value)][1]
        way = self.problem.coarse_to_fine[key]
        fine = way.refined(arrays.numpy(value), self._shapes[key]) * (self.shares[key] ** power * factor)
        made = arrays.like(fine, value)
        if plain:
            self._made[id(value)] = value, made
        return made


# ---------------------------------------------------------------------- carried


@singledispatch
def carried(state: Any, upsampler: Upsampler) -> Any:
    """The state at the finer resolution. Raises `NotCarried` for one that is tied to its own."""
    del upsampler
    raise NotCarried(type(state).__name__)


@carried.register(PlainState)
@carried.register(AllState)
@carried.register(UniformState)
@carried.register(MetaAdamState)
@carried.register(SmoothedState)
def _(state: Any, upsampler: Upsampler) -> Any:
    del upsampler  # nothing in it has a parameter's shape
    return state


@carried.register
def _(state: AdamState, upsampler: Upsampler) -> AdamState:
    first, second = upsampler.tree(state.first_moment, 1.0), upsampler.tree(state.second_moment, SQUARES)
    return replace(state, first_moment=first, second_moment=second)


@carried.register
def _(state: SGDState, upsampler: Upsampler) -> SGDState:
    return replace(state, velocity=upsampler.tree(state.velocity, 1.0))


@carried.register
def _(state: NewtonState, upsampler: Upsampler) -> NewtonState:
    if state.adam is not None:
        raise NotCarried("Newton's Adam")
    del upsampler
    return state


@carried.register
def _(state: PathGradientState, upsampler: Upsampler) -> PathGradientState:
    return replace(state, image=carried(state.image, upsampler), pixels=carried(state.pixels, upsampler))


@carried.register
def _(state: RecursiveControlVariateState, upsampler: Upsampler) -> RecursiveControlVariateState:
    return state if state.parameters is None else replace(state, parameters=upsampler.tree(state.parameters))


@carried.register
def _(state: GuidedSamplerState, upsampler: Upsampler) -> GuidedSamplerState:
    return replace(state, second_moment=upsampler.tree(state.second_moment, SQUARES))


@carried.register
def _(state: MetaState, upsampler: Upsampler) -> MetaState:
    if state.parameters is None:
        return replace(state, image=carried(state.image, upsampler), pixels=carried(state.pixels, upsampler))
    before = upsampler.tree(state.parameters)
    # Differences are kept per unit of a step's length, and the same step is longer where it has more elements.
    old, new = _length(state.parameters, upsampler.parameters), _length(before, upsampler.tree(upsampler.parameters))
    ratio = old / new if new > 0 else 1.0

    def moments(key: str, given: meta.Moments, factor: float) -> meta.Moments:
        mean = upsampler.array(key, given.mean, 1.0, factor)
        return meta.Moments(mean, upsampler.array(key, given.square, SQUARES, factor * factor), given.weight)

    def element(key: str, given: meta.State) -> meta.State:
        return meta.State(
            gradient=upsampler.array(key, given.gradient, 1.0),
            variance=upsampler.array(key, given.variance, SQUARES),
            alpha=upsampler.array(key, given.alpha),
            proportional=moments(key, given.proportional, 1.0),
            difference=moments(key, given.difference, ratio),
            steps=given.steps,
        )

    elements = {key: element(key, given) for key, given in state.elements.items()}
    return MetaState(before, elements, carried(state.image, upsampler), carried(state.pixels, upsampler))


def _length(a: Tree, b: Tree) -> float:
    return math.sqrt(sum(arrays.number(arrays.total((a[key] - b[key]) * (a[key] - b[key]))) for key in a))


# ---------------------------------------------------------------------- begun anew


@singledispatch
def restarted(state: Any, fresh: Any) -> Any:
    """`fresh`, a state that knows nothing, with the count of steps that schedules go by."""
    del state
    return fresh


@restarted.register
def _(state: AdamState, fresh: AdamState) -> AdamState:
    return replace(fresh, step=state.step, begun=state.step)


@restarted.register(SGDState)
@restarted.register(MetaAdamState)
def _(state: Any, fresh: Any) -> Any:
    return replace(fresh, step=state.step)


@restarted.register
def _(state: NewtonState, fresh: NewtonState) -> NewtonState:
    adam = None if state.adam is None or fresh.adam is None else restarted(state.adam, fresh.adam)
    return replace(fresh, step=state.step, adam=adam)


@restarted.register
def _(state: SmoothedState, fresh: SmoothedState) -> SmoothedState:
    del fresh
    return state
