"""How long a run may go on."""

from __future__ import annotations

from typing import TYPE_CHECKING

from unrender.core.errors import InputError
from unrender.estimators.base import Estimate
from unrender.runs.hooks import Hook
from unrender.runs.result import NON_FINITE

if TYPE_CHECKING:
    from unrender.runs.loop import Descent

__all__ = ["Budget", "check_budget"]

_MOST_SKIPPED = 20
_MOST_STEPS = 1 << 63
"""Exclusive: what the files of a run folder hold."""


class Budget(Hook):
    """Stops a run that has used up its steps or seconds, or whose last twenty steps were not finite."""

    def on_start(self, descent: Descent) -> None:
        """See `Hook.on_start`."""
        self._check(descent)

    def on_update(self, descent: Descent, estimate: Estimate, applied: bool) -> None:
        """See `Hook.on_update`."""
        del estimate, applied
        self._check(descent)

    def _check(self, descent: Descent) -> None:
        run = descent.run
        if run.steps is not None and run.step >= run.steps:
            run.stop("steps")
        if run.seconds is not None and run.clock >= run.seconds:
            run.stop("seconds")
        if descent.state.skipped_in_a_row >= _MOST_SKIPPED:
            run.stop(NON_FINITE)
            line = f"{_MOST_SKIPPED} steps in a row were not finite: the run was given up; kept are the last values that were finite"
            if line not in run.warnings:
                run.warnings.append(line)


def check_budget(steps: int | None, seconds: float | None) -> None:
    """Raise `InputError` unless a run can have this budget."""
    if steps is None and seconds is None:
        raise InputError("optimize: give a budget, steps= or seconds=")
    if isinstance(steps, int) and steps >= _MOST_STEPS:
        raise InputError(f"optimize: steps must be below 2**63, got an integer of {steps.bit_length()} bits")
    if steps is not None and (not isinstance(steps, int) or steps < 1):
        raise InputError(f"optimize: steps must be a whole number of at least 1, got {steps!r}")
    if seconds is not None and not (0 < float(seconds) < float("inf")):
        raise InputError(f"optimize: seconds must be positive and finite, got {seconds!r}")
