"""Runs of `unrender` over processor time, and what they reach: errors of surfaces and of pictures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

import unrender as ur
from benchmarks.image_errors import views_error
from benchmarks.peers.drivers.recorder import BudgetSpentError, Recorder
from benchmarks.runner.timing import work_time

Point = tuple[float, dict[str, np.ndarray]]
"""Processor seconds, and parameters."""
POINTS = 40
"""Of a curve."""
_PICTURE_SPP = 64


class Kept(ur.protocols.Callback):
    """Parameters along a run of ours, over the processor time of its steps; ends it when that is used up.

    Args:
        seconds: of the processor.
        points: how many times parameters are kept.
        steps: after which the run ends at the latest; None for no limit.
    """

    def __init__(self, seconds: float, points: int = POINTS, steps: int | None = None):
        self._recorder = Recorder(seconds, points, steps, timer=work_time)

    def on_step(self, run: Any, record: dict[str, Any]) -> None:
        try:
            self._recorder.step(run.full)
        except BudgetSpentError:
            run.stop()

    @property
    def steps(self) -> int:
        """Number of steps so far."""
        return self._recorder.steps

    @property
    def found(self) -> list[Point]:
        """(processor seconds, parameters) along the run."""
        return [(seconds, values) for seconds, _, values in self._recorder.kept]


def timed_run(problem: ur.Problem, seconds: float, seed: int, *method: Any, points: int = POINTS) -> Kept:
    """Run `auto`, or an estimator and an optimizer, for some processor seconds without measuring errors; return what was kept."""
    kept = Kept(seconds, points)
    limit = 100 * seconds  # of the clock, never reached
    ur.optimize(blind(problem), *method, seconds=limit, seed=seed, callbacks=[kept], progress=False)
    return kept


def blind(problem: ur.Problem) -> ur.Problem:
    """The same without the truth: errors are no part of a run's time."""
    unknowns = {key: replace(unknown, truth=None, surface=None) for key, unknown in problem.unknowns.items()}
    return problem.with_parts(unknowns=unknowns)


def measured(problem: ur.Problem, found: Sequence[tuple[float, Mapping[str, np.ndarray]]]) -> dict[str, Any]:
    """What was reached in the end, and the curve of the surface's error over seconds; pictures alone where no surface is known."""
    first, last = (views_error(problem, at, _PICTURE_SPP) for at in (problem.initial_values(), found[-1][1]))
    if all(unknown.surface is None for unknown in problem.unknowns.values()):
        return {"pictures": last / first}
    (key,) = problem.faces
    start = problem.parameter_error(problem.initial())[key]
    curve = [(0.0, 1.0), *((seconds, problem.parameter_error(values)[key] / start) for seconds, values in found)]
    return {"curve": [list(x) for x in zip(*curve, strict=True)], "surface": curve[-1][1], "pictures": last / first}
