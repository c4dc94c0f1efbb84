"""Optimizers as chains of transforms."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, TypeVar

from unrender.core import arrays
from unrender.core.errors import InputError
from unrender.core.registry import register
from unrender.core.trees import Tree
from unrender.estimators.base import Estimate
from unrender.estimators.capabilities import Capabilities, Gradient
from unrender.optimizers.base import check_rates, rates_of, schedule_factor
from unrender.optimizers.transforms.base import StepTransform, StepUpdate, checked_transforms
from unrender.scene.upsampling import Upsampler, restarted, upsampled
from unrender.schedules import Schedule

S = TypeVar("S")


@dataclass(frozen=True)
class ChainState:
    """State of a chain between steps: those of the transforms, in order, which started at the step `begun`, and {key: η} without schedule
    and factors."""

    step: int
    learning_rates: dict[str, float]
    states: tuple[Any, ...]
    begun: int = 0

    def of(self, kind: type[S]) -> S:
        """Return the first state of this type. Raise `KeyError` if there is none."""
        for state in self.states:
            if isinstance(state, kind):
                return state
        raise KeyError(kind.__name__)

    def upsampled(self, upsampler: Upsampler) -> ChainState:
        """Interpolate each of the states."""
        return replace(self, states=tuple(upsampled(state, upsampler) for state in self.states))

    def restarted(self, fresh: ChainState) -> ChainState:
        """Continue the schedule, and restart the transforms at this step."""
        pairs = zip(self.states, fresh.states, strict=True)
        states = tuple(restarted(state, begun) for state, begun in pairs)
        return replace(fresh, step=self.step, begun=self.step, states=states)


class Recipe(ABC):
    """An optimizer that is a composition of transforms. Subclasses are registered frozen dataclasses."""

    learning_rate: Any
    schedule: Schedule | None

    @abstractmethod
    def compose(self) -> tuple[StepTransform, ...]:
        """Return the transforms, first to last."""

    @cached_property
    def _composed(self) -> tuple[StepTransform, ...]:
        return self.compose()

    @property
    def requires(self) -> Capabilities:
        """A gradient, and the capabilities that the transforms require."""
        return Capabilities(Gradient, *(kind for part in self._composed for kind in part.requires))

    def init(self, parameters: Tree, learning_rates: Mapping[str, float] | None = None) -> ChainState:
        own = rates_of(type(self).__name__, parameters, self.learning_rate, learning_rates)
        return ChainState(0, own, tuple(part.init(parameters, own) for part in self._composed))

    def update(self, estimate: Estimate, state: ChainState, parameters: Tree) -> tuple[Tree, ChainState]:
        """Return the steps and the next state. Lazy on Dr.Jit unless a transform waits: evaluate both together."""
        factor = schedule_factor(type(self).__name__, self.schedule, state.step)
        if not 0 <= state.begun <= state.step:
            raise InputError(f"state of {type(self).__name__}: begun at step {state.begun}, is at step {state.step}")
        made, gradient = state.step - state.begun, estimate.gradient
        update = StepUpdate(estimate, parameters, made, state.learning_rates, gradient, gradient, factor)
        states = []
        for part, before in zip(self._composed, state.states, strict=True):
            update, after = part.update(update, before)
            states.append(after)
        steps = {
            key: update.steps[key] if key in update.steps else arrays.scalar(-update.rate(key), x) * x
            for key, x in update.direction.items()
        }
        return steps, replace(state, step=state.step + 1, states=tuple(states))

    def choices(self, state: ChainState) -> tuple[str, ...]:
        """Return the choices of the transforms, one line each."""
        made, pairs = state.step - state.begun, zip(self._composed, state.states, strict=True)
        return tuple(line for part, own in pairs for line in part.choices(own, made))


@register
@dataclass(frozen=True)
class Chain(Recipe):
    """Sequence of transforms, followed by a step against the direction: −η × direction.

        Chain((GradientMean(0.9), ScaleByRms(0.999)), learning_rate=0.01)

    This example is Adam. A transform gets the direction from the previous one, so the order matters.

    Args:
        transforms: Transforms in order; see `unrender.optimizers.transforms`.
        learning_rate: η, in units of the parameter for a direction of size 1, > 0; or {key: rate, "*": rate of the others}.
        schedule: Factor of every learning rate by step; see `unrender.schedules`.
    """

    transforms: tuple[StepTransform, ...] = ()
    learning_rate: float | Mapping[str, float] = 0.01
    schedule: Schedule | None = None

    def __post_init__(self):
        check_rates("Chain", self.learning_rate, self.schedule)
        object.__setattr__(self, "transforms", checked_transforms("Chain: transforms", self.transforms))

    def compose(self) -> tuple[StepTransform, ...]:
        return self.transforms
