from dataclasses import dataclass, replace

import unrender as ur
from unrender.core import arrays
from unrender.optimizers.base import Optimizer, check_rates, rates_of
from unrender.schedules import Schedule, schedule_factor


@dataclass(frozen=True)
class SignState:
    """State between steps: the steps made, and each parameter's learning rate."""

    step: int
    learning_rates: dict[str, float]

    def upsampled(self, upsampler):
        return self

    def restarted(self, fresh):
        return replace(fresh, step=self.step)


@ur.register
@dataclass(frozen=True)
class SignDescent(Optimizer):
    """Steps −η sign(g).

    Args:
        learning_rate: η, in units of the parameter, > 0; for the parameters without their own.
        schedule: factor of every learning rate by step.
    """

    learning_rate: float = 0.01
    schedule: Schedule | None = None

    def __post_init__(self):
        check_rates("SignDescent", self.learning_rate, self.schedule)

    @property
    def requires(self):
        return frozenset({"gradient"})

    def init(self, parameters, learning_rates=None):
        return SignState(0, rates_of("SignDescent", parameters, self.learning_rate, learning_rates))

    def update(self, estimate, state, parameters):
        factor = schedule_factor("SignDescent", self.schedule, state.step)
        steps = {
            key: arrays.sign(g) * arrays.scalar(-state.learning_rates[key] * factor, g)
            for key, g in estimate.gradient.items()
        }
        return steps, replace(state, step=state.step + 1)
