"""Times of the phases of a run."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING

from unrender.runs.callbacks import Callback

if TYPE_CHECKING:
    from unrender.runs.result import Result
    from unrender.runs.run import Run

COMPILING, STEPS, ASIDE = "compiling", "steps", "checkpoints and callbacks"
VERIFYING, PICTURES = "verification", "final pictures"
"""Phases of a run in order: before the first step; the steps; what happens between and after them."""

RUN_PHASES = (COMPILING, STEPS, ASIDE, VERIFYING, PICTURES)


class PhaseTimes(Callback):
    """Callback that records the seconds of each phase in `Result.phases`. It is the first callback, so that saved results contain them.

    Compiling between steps, after a change of resolution or of a mesh, counts as compiling.

    Args:
        earlier: {phase: seconds} before the run, such as loading.
    """

    def __init__(self, earlier: Mapping[str, float] | None = None):
        self._earlier = dict(earlier or {})
        self._made = self._started = time.perf_counter()
        self._clock = self._warm = 0.0

    def on_start(self, run: Run) -> None:
        self._started, self._clock, self._warm = time.perf_counter(), run.clock, run.warmup_seconds

    def on_result(self, run: Run, result: Result) -> Result:
        steps = run.clock - self._clock
        between = run.warmup_seconds - self._warm
        aside = time.perf_counter() - self._started - steps - between
        run_phases = {COMPILING: self._started - self._made + between, STEPS: steps, ASIDE: max(aside, 0.0)}
        return replace(result, phases={**self._earlier, **run_phases})


def with_phase(result: Result, name: str, seconds: float) -> Result:
    """Return the result with an additional phase."""
    return replace(result, phases={**result.phases, name: seconds})
