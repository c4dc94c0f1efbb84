"""Warnings about parameters that end further from their known truth than they began."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from unrender.core.errors import InputError
from unrender.runs.sensitivity import seen_cells, sensitivity
from unrender.runs.verification import FreshPictures
from unrender.scene.problem import Problem

__all__ = ["FEW_NEWTON_STEPS", "FEW_STEPS", "further_from_truth"]

FEW_STEPS = 32
"""Number of steps below which a run whose picture has improved is unfinished, and its parameters may still be on their way."""
FEW_NEWTON_STEPS = 8
"""The same number for Gauss-Newton steps of all unknowns."""
_FURTHER, _FURTHER_EARLY = 1.1, 1.5
"""Ratio of a parameter's last error to its first from which on a warning says so; the second one for runs of few steps."""
_MAP_AXES = 3
_ERRORS = 2.0
"""Standard errors of a parameter that its last error must exceed, besides its first error."""
_HARDLY = 0.05
"""Share of the median of the cells that are seen, below which a cell is hardly seen itself."""
_PROBES, _SECONDS_SHARE = 8, 0.02
"""Probes of the sensitivity; share of the run's time after which no further one is begun."""
_SIGNS_SEED = 5


def further_from_truth(
    problem: Problem,
    pictures: FreshPictures,
    first: Mapping[str, np.ndarray],
    last: Mapping[str, np.ndarray],
    few: bool,
    seconds: float,
) -> list[str]:
    """Return a line for each parameter that ends further from its truth than it began, where the pictures show it.

    The error of a texture or grid is that of its cells which change the pictures at the truth. It has to exceed the first error by a
    tenth, and by more than the noise of the references and of a fresh picture explains. The sensitivity turns that noise into a
    standard error of the parameter, see `unrender.sensitivity`.

    Args:
        problem: its truth, views and scene.
        pictures: for the noise of the references, from a fresh picture of the truth.
        first, last: {key: array}, the parameters at the start and at the end.
        few: whether the run made fewer than `FEW_STEPS` steps. Its errors have to exceed the first by a half.
        seconds: of the run.
    """
    ratio = _FURTHER_EARLY if few else _FURTHER
    before, after = problem.parameter_error(first), problem.parameter_error(last)
    # The error over all cells rises less than that of the seen ones where the others stay.
    least = {key: 1.0 if last[key].ndim >= _MAP_AXES else _FURTHER for key in after}
    suspects = [key for key, error in after.items() if 0.0 < least[key] * before[key] < error]
    if not suspects:
        return []
    truth = {**last, **{key: value for key, value in problem.truth.items() if key in last}}
    sensitivities = _sensitivities(problem, truth, seconds)
    # Sensitivities are of all views. The mean square that remains at the truth is the noise of references and picture.
    residual = pictures.residual(pictures.images(truth)) if sensitivities else math.nan
    lines = []
    for key in suspects:
        measure, where, noise, words = problem.unknowns[key].measure, None, 0.0, ""
        start, end = before[key], after[key]
        told = sensitivities.get(key)
        if told is not None and key in problem.truth:
            where = _seen(told)
            if where is not None and not where.all():
                words = " where the pictures show it"
            known = problem.truth[key]
            start, end = (measure.error(np.asarray(x[key]), known, where) or 0.0 for x in (first, last))
            noise = _noise(problem, key, told, where, residual)
        if start > 0.0 and math.hypot(ratio * start, _ERRORS * noise) < end:
            lines.append(
                f"{key} ends further from the truth than it began{words}: error {measure.text(end)}, {measure.text(start)} at the "
                "start; the images may allow several solutions: try another start, bounds, or more views"
            )
    return lines


def _sensitivities(problem: Problem, values: Mapping[str, np.ndarray], seconds: float) -> dict[str, np.ndarray]:
    try:
        return sensitivity(problem, values, _PROBES, seconds=_SECONDS_SHARE * seconds)
    except InputError:  # the renderer refuses the truth
        return {}


def _seen(told: np.ndarray) -> np.ndarray | None:
    """Return the cells that change the pictures, themselves and not only those around them; None for what has no cells."""
    where = seen_cells(told)
    if where is None:
        return None
    own = np.sqrt(np.mean(np.square(told, dtype=np.float64), axis=-1))
    return where & (own > _HARDLY * np.median(own[where])) if where.any() else where


def _noise(problem: Problem, key: str, told: np.ndarray, where: np.ndarray | None, residual: float) -> float:
    """Return the standard error of a parameter, in the units of its error measure, from the noise of the pixels.

    Few probes make single sensitivities uncertain, so all elements get the same standard error from their mean square.
    """
    seen = told if where is None else told[where]
    square = float(np.mean(np.square(seen, dtype=np.float64))) if seen.size else 0.0
    if not (square > 0.0 and math.isfinite(residual)):
        return 0.0
    known = np.asarray(problem.truth[key])
    signs = np.random.default_rng(_SIGNS_SEED).choice((-1.0, 1.0), known.shape)
    return problem.unknowns[key].measure.error(known + math.sqrt(residual / square) * signs, known, where) or 0.0
