"""Conversion of a search direction to a step, shared by `Newton`, `NewtonCG` and `LBFGS`.

They compute a direction on the host, in coordinates u = x / scale. The step is a multiple of the direction, or the step of an inner Adam.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from unrender.core import arrays, checks, trees
from unrender.core.errors import InputError
from unrender.core.text import in_words
from unrender.core.trees import Tree
from unrender.estimators.base import Estimate
from unrender.estimators.capabilities import AtBounds, Smoothing
from unrender.optimizers.base import check_rates, rates_of
from unrender.optimizers.recipes import Adam, ChainState
from unrender.scene.upsampling import NotCarried, Upsampler
from unrender.schedules import Schedule, schedule_factor


@dataclass(frozen=True)
class NewtonState:
    """State between steps: learning rate of each parameter, its scale, and the inner Adam, in double precision on the host, if there is
    one."""

    step: int
    learning_rates: dict[str, float]
    adam: ChainState | None = None

    def upsampled(self, upsampler: Upsampler) -> NewtonState:
        """Return this state. Raises `NotCarried` with an inner Adam, whose moments are on the host."""
        if self.adam is not None:
            raise NotCarried("Newton's Adam")
        return self

    def restarted(self, fresh: NewtonState) -> NewtonState:
        """Continue the schedule in a new state."""
        adam = None if self.adam is None or fresh.adam is None else self.adam.restarted(fresh.adam)
        return replace(fresh, step=self.step, adam=adam)


class Scaled(Protocol):
    """State of an optimizer with a scale per parameter."""

    @property
    def learning_rates(self) -> Mapping[str, float]: ...


class DirectionOptions(Protocol):
    """Options that these methods share; `Newton` documents them."""

    @property
    def learning_rate(self) -> float: ...

    @property
    def step_scale(self) -> float: ...

    @property
    def inner_optimizer(self) -> Adam | None: ...

    @property
    def schedule(self) -> Schedule | None: ...


def check_options(owner: str, options: DirectionOptions) -> None:
    """Raise `InputError` for an option out of range or of the wrong type."""
    check_rates(owner, options.learning_rate, options.schedule)
    if checks.number(owner, "step_scale", options.step_scale, above=0.0) > 1.0:
        raise InputError(f"{owner}: step_scale must be at most 1, got {in_words(options.step_scale)}")


def init_state(
    owner: str, options: DirectionOptions, parameters: Tree, learning_rates: Mapping[str, float] | None
) -> NewtonState:
    """Return the state before the first step. Raises `InputError` for an invalid learning rate or an unknown parameter."""
    own = rates_of(owner, parameters, options.learning_rate, learning_rates)
    adam = None
    if options.inner_optimizer is not None:
        adam = options.inner_optimizer.init(_on_host(parameters), learning_rates)
    return NewtonState(0, own, adam)


def coordinate_scales(estimate: Estimate, state: Scaled, parameters: Tree, common: float) -> np.ndarray:
    """Return the unit of each element's coordinate u, (n,): its learning rate, or σ of smoothed derivatives times the `common` one.

    A parameter's own rate is in its units, as for Adam, and no multiple of σ.
    """
    smoothing = estimate.get(Smoothing)
    scales = {key: common * smoothing.sigma[key] if smoothing else η for key, η in state.learning_rates.items()}
    return trees.repeat_per_element(scales, parameters)


def sides_of_bounds(estimate: Estimate, parameters: Tree) -> np.ndarray:
    """Return the side of the bound at which each element is, -1 or 1, and 0 for the others, (n,); see `AtBounds`."""
    bounds = estimate.get(AtBounds)
    return np.zeros(trees.ravel(parameters).size) if bounds is None else trees.ravel(bounds.sides())


def free_elements(estimate: Estimate, parameters: Tree) -> np.ndarray:
    """Return 0 for elements at a bound beyond which the loss falls, and 1 for the others, (n,).

    The former stay, and the others take the step of a problem without them (Bertsekas 1982, "Projected Newton Methods for Optimization
    Problems with Simple Constraints"). The projection of a step of all elements would end at that of the minimum without bounds.
    """
    downwards = -np.sign(trees.ravel(estimate.gradient))
    return np.where(sides_of_bounds(estimate, parameters) * downwards > 0.0, 0.0, 1.0)


def apply_direction(
    owner: str, options: DirectionOptions, direction: np.ndarray, state: NewtonState, parameters: Tree
) -> tuple[Tree, NewtonState]:
    """Return the step along a direction (n,), in units of the parameters, and the next state.

    A direction that is not finite counts as zero.
    """
    if not np.isfinite(direction).all():
        direction = np.zeros_like(direction)
    step, adam = options.step_scale * direction, state.adam
    if options.inner_optimizer is not None and adam is not None:
        opposite = trees.unravel(-direction, _on_host(parameters))
        steps, adam = options.inner_optimizer.update(Estimate(0.0, opposite), adam, opposite)
        step = trees.ravel(steps)
    factor = schedule_factor(owner, options.schedule, state.step)
    return trees.unravel(factor * step, parameters), NewtonState(state.step + 1, state.learning_rates, adam)


def _on_host(parameters: Tree) -> Tree:
    return {key: np.zeros(arrays.shape(x)) for key, x in parameters.items()}
