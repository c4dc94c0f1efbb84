"""Giving up runs whose error is above the median of earlier trials' at the same share of the budget (Golovin et al. 2017), and does not
fall fast enough to end below it."""

from __future__ import annotations

import json
import math
import statistics
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from unrender.core.errors import InputError
from unrender.io import bounded_files, files
from unrender.runs.callbacks import Callback
from unrender.runs.folder.reader import RunFolder
from unrender.runs.result import PRUNED
from unrender.scene.problem import Problem
from unrender.scene.render import render
from unrender.statistics import debiased

if TYPE_CHECKING:
    from unrender.runs.run import Run

RUNGS = (0.1, 0.2, 0.3, 0.4, 0.5, 0.65, 0.8)
"""Shares of the budget at which a run's error is looked at; none is pruned at the first."""
RUNG_FILE = "rungs.json"
_FEWEST = 4
"""Trials that must have come to their end before any is pruned."""
_PATHS, _MOST_SPP = 1 << 19, 64
_SEED = 1 << 20
"""Of pictures on the way: not those of final pictures."""


def medians(finished: Iterable[Mapping[float, float]]) -> dict[float, float]:
    """{share: median error there} of trials that came to their end, their last error at the share 1; {} for fewer than four.

    Args:
        finished: {share: error} of each such trial.
    """
    given = list(finished)
    found = {}
    for share in (*RUNGS, 1.0):
        values = [errors[share] for errors in given if share in errors]
        if len(values) >= _FEWEST:
            found[share] = statistics.median(values)
    return found


def is_hopeless(errors: Mapping[float, float], limits: Mapping[float, float]) -> bool:
    """Whether to give up a run: its last error is above the median there, and would end above the median of last errors, too, if it went on
    to fall by the same factor for the same share of the budget as since the look before.

    The second condition spares those that begin slowly and end best, as small learning rates do.

    Args:
        errors: {share: error} of the run so far.
        limits: `medians` of other trials.
    """
    if len(errors) < 2:
        return False
    before, now = sorted(errors)[-2:]
    if errors[now] <= limits.get(now, math.inf):
        return False
    if not 0 < errors[now] < errors[before]:
        return errors[now] > limits.get(1.0, 0.0)
    pace = (math.log(errors[now]) - math.log(errors[before])) / (now - before)
    return math.log(errors[now]) + pace * (1 - now) > math.log(max(limits.get(1.0, 0.0), 1e-300))


def stated_error(run: RunFolder) -> tuple[float, float | None]:
    """What a sweep makes small, and its standard error where it has one.

    Of problems whose truth is known, the root mean square error of the parameter; of several parameters, the mean of their errors relative
    to the start's. Of others, the root mean square error of the final pictures, their noise taken out, the mean over views.

    Raises:
        InputError: the run has neither.
    """
    if run.error_after:
        return _combined(run.error_after, run.error_before), None
    given = [error for name, error in run.record.image_errors.items() if name.endswith("/result")]
    if not given:
        raise InputError(f"run folder {run.path}: neither the truth nor an error of final pictures is known")
    return debiased.mean(given)


class Pruning(Callback):
    """Measures a run's error at `RUNGS`, writes it to rungs.json in the run folder, and ends the run where it `is_hopeless`.

    The error is that of `stated_error`, of parameters where the truth is known, else of pictures with few samples; in either case a
    function of the run alone.

    Args:
        folder: the run folder.
        limits: `medians` of other trials; {} ends no run.
    """

    def __init__(self, folder: Path, limits: Mapping[float, float]):
        self._path = folder / RUNG_FILE
        self._limits = dict(limits)
        self._errors: dict[float, float] = {}
        self._initial: dict[str, float] = {}

    def on_start(self, run: Run) -> None:
        problem = run.problem
        self._initial = problem.parameter_error(problem.start(0)) if problem.has_truth else {}
        self._errors = {}
        if run.step:  # resumed
            self._errors = {share: error for share, error in read_rungs(self._path).items() if share <= run.progress()}
        else:
            self._path.unlink(missing_ok=True)

    def on_step(self, run: Run, record: dict[str, Any]) -> None:
        passed = [share for share in RUNGS if max(self._errors, default=0.0) < share <= run.progress()]
        if not passed or run.stopped:
            return
        self._errors[passed[-1]] = self._measure(run)
        if is_hopeless(self._errors, self._limits):
            run.stop(PRUNED)
        text = json.dumps({str(share): value for share, value in self._errors.items()}) + "\n"
        files.write(self._path, text.encode(), durable=False)

    def _measure(self, run: Run) -> float:
        problem = run.problem
        if problem.has_truth:
            return _finite(_combined(problem.parameter_error(run.parameters), self._initial))
        return _finite(_picture_error(problem, run.full()))


def read_rungs(path: Path) -> dict[float, float]:
    """{share: error} of a file that `Pruning` wrote; {} where there is none, or it is malformed."""
    try:
        given = bounded_files.parse_json(bounded_files.read_bytes(path, 1 << 12), str(path))
    except (InputError, OSError):
        return {}
    found = {}
    for name, value in given.items() if isinstance(given, dict) else ():
        share = next((share for share in RUNGS if str(share) == name), None)
        if share is not None and isinstance(value, (int, float)) and not isinstance(value, bool):
            found[share] = float(value)
    return found


def _combined(errors: Mapping[str, float], initial: Mapping[str, float]) -> float:
    """One parameter's error; of several, the mean relative to the start."""
    if len(errors) == 1:
        return next(iter(errors.values()))
    return float(np.mean([error / (initial.get(key) or 1.0) for key, error in errors.items()]))


def _finite(error: float) -> float:
    """With the greatest number in place of none, so that it can be compared and written."""
    return error if math.isfinite(error) else float(np.finfo(np.float64).max)


def _picture_error(problem: Problem, values: Mapping[str, np.ndarray]) -> float:
    pixels = problem.pixels
    spp = min(max(_PATHS // max(pixels, 1), 1), _MOST_SPP)
    found = []
    for index, view in enumerate(problem.views):
        one, other = (render(problem, values, index, spp, _SEED + half) for half in (0, 1))
        mask = None if view.mask is None else np.asarray(view.mask)
        found.append(debiased.rmse(one, other, np.asarray(view.reference), mask))
    return debiased.mean(found)[0]
