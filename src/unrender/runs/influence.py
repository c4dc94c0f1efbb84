"""Parameters that do not influence the images."""

from __future__ import annotations

from typing import TYPE_CHECKING

from unrender.core import arrays, memory
from unrender.estimators.base import Estimate
from unrender.runs.hooks import Hook

if TYPE_CHECKING:
    from unrender.runs.loop import Descent

__all__ = ["InfluenceWatch"]

_STEPS = 5


class InfluenceWatch(Hook):
    """Warns of parameters whose gradient was exactly zero in each of the first five steps."""

    def on_update(self, descent: Descent, estimate: Estimate, applied: bool) -> None:
        """See `Hook.on_update`."""
        run, zero = descent.run, descent.state.zero_gradient
        if not applied or run.step > _STEPS:
            return
        for key, gradient in estimate.gradient.items():
            zero[key] = zero[key] and arrays.number(memory.square(gradient)) == 0.0
            if zero[key] and run.step == _STEPS:
                run.warnings.append(
                    f"parameter {key}: its gradient is zero so far; it does not seem to influence the images"
                )
