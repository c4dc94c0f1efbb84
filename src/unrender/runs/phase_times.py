"""Where the time of a run goes."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING

from unrender.runs.hooks import Hook

if TYPE_CHECKING:
    from unrender.runs.loop import Descent
    from unrender.runs.result import Result

COMPILING, STEPS, ASIDE = "compiling", "steps", "checkpoints and callbacks"
VERIFYING, PICTURES = "verification", "final pictures"
"""Phases of a run, in their order: before the first step; the steps themselves; what stands between and after them."""

RUN_PHASES = (COMPILING, STEPS, ASIDE, VERIFYING, PICTURES)


class PhaseTimes(Hook):
    """Notes the seconds of each phase in `Result.phases`. First among the hooks, so that the result has them when it is saved.

    Args:
        earlier: {phase: seconds} before this was made, such as loading.
    """

    def __init__(self, earlier: Mapping[str, float] | None = None):
        self._earlier = dict(earlier or {})
        self._made = self._started = time.perf_counter()
        self._clock = 0.0

    def on_start(self, descent: Descent) -> None:
        self._started, self._clock = time.perf_counter(), descent.run.clock

    def on_result(self, descent: Descent, result: Result) -> Result:
        steps = descent.run.clock - self._clock
        aside = time.perf_counter() - self._started - steps
        found = {COMPILING: self._started - self._made, STEPS: steps, ASIDE: max(aside, 0.0)}
        return replace(result, phases={**self._earlier, **found})


def with_phase(result: Result, name: str, seconds: float) -> Result:
    """The result with one more phase."""
    return replace(result, phases={**result.phases, name: seconds})
