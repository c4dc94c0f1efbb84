"""Warnings about parameters whose error against the known truth has grown, and about runs of few steps."""

from __future__ import annotations

import math
from collections.abc import Mapping
from collections.abc import Set as AbstractSet
from dataclasses import replace

import numpy as np

from unrender.core.errors import InputError
from unrender.core.text import listed
from unrender.estimators.fresh_pictures import FreshPictures
from unrender.methods.rules.exchangeable import exchangeable_children, exchangeable_pairs
from unrender.optimizers.averaged_newton import AveragedNewton
from unrender.optimizers.base import Optimizer
from unrender.runs.image_sensitivity import MAP_AXES, Curvature, curvature, root_of_covariance, seen_cells
from unrender.runs.result import Result
from unrender.runs.verification import misfit
from unrender.scene.problem import Problem

FEW_STEPS = 32
"""Number of steps below which a run with an improved image is unfinished, so that its parameters may still be converging."""
FEW_NEWTON_STEPS = 8
"""The same number for Gauss-Newton steps of all unknowns."""
_FURTHER, _FURTHER_EARLY = 1.1, 1.5
"""Ratio of a parameter's last error to its first from which a warning is given; the second one for runs of few steps."""
_ERRORS = 2.0
"""Number of standard errors of a parameter that its last error must exceed in addition to its first error."""
_EXCHANGED = 0.5
"""Largest geometric mean of the ratios of two lights' errors after and before an exchange that is told."""
_PROBES, _SECONDS_SHARE = 8, 0.02
"""Probes of the sensitivity; fraction of the run's time after which no further one is started."""
_SIGNS_SEED, _DRAWS = 5, 8
"""Seed and number of sets of random signs by which deviations of all elements become an error of the parameter."""


def has_few_steps(steps: int, optimizer: Optimizer) -> bool:
    """Return whether a run is unfinished; a Gauss-Newton step solves for all unknowns, so few of them may converge."""
    return steps < (FEW_NEWTON_STEPS if isinstance(optimizer, AveragedNewton) else FEW_STEPS)


def with_few_steps(problem: Problem, result: Result, unsettled: AbstractSet[str] = frozenset()) -> Result:
    """Return the result with a line that so few steps cannot be judged, unless another line or standard errors judge them. For the
    `unsettled` unknowns they are few whatever their number."""
    short = 0 < result.steps < FEW_NEWTON_STEPS
    unknown = [key for key in problem.unknowns if key not in result.standard_error and (short or key in unsettled)]
    lines = (*result.warnings, *result.undetermined)
    advised = any(x in line for x in ("more steps", "more seconds", "of at least", "allows about") for line in lines)
    if result.status != "finished" or advised or not unknown:
        return result
    steps = "1 step is" if result.steps == 1 else f"{result.steps} steps are"
    line = f"{steps} too few to judge whether {listed(unknown)} converged: give more steps"
    return replace(result, warnings=[*result.warnings, line])


def further_from_truth(
    problem: Problem,
    pictures: FreshPictures,
    first: Mapping[str, np.ndarray],
    last: Mapping[str, np.ndarray],
    few: bool,
    seconds: float,
    errors: Mapping[str, np.ndarray] | None = None,
) -> list[str]:
    """Return a line for each parameter whose error has grown, if the images determine it.

    The error of a texture or grid includes only cells that affect the images at the truth. It must exceed the first error by a tenth, and
    by more than the noise of the references and of a new image explains. The sensitivity converts that noise to a standard error of the
    parameter, see `unrender.runs.sensitivity`.

    Args:
        pictures: source of a new image at the truth, for the noise of the references.
        first, last: {key: array}, the parameters at the start and at the end.
        few: whether the run had fewer than `FEW_STEPS` steps; errors must then exceed the first by a half.
        errors: {key: array}, standard errors of the run, for parameters without a sensitivity, such as poses.
    """
    ratio = _FURTHER_EARLY if few else _FURTHER
    last, places = exchanged(problem, last)
    before, after = problem.parameter_error(first), problem.parameter_error(last)
    # The error over all cells grows less than that of the seen ones if the others do not change.
    least = {key: 1.0 if last[key].ndim >= MAP_AXES else _FURTHER for key in after}
    suspects = [key for key, error in after.items() if 0.0 < least[key] * before[key] < error]
    if not suspects:
        return places
    truth = {**last, **{key: value for key, value in problem.truth.items() if key in last}}
    of = _curvature(problem, pictures, truth, seconds)
    sensitivities = of.sensitivity()
    lines = []
    for key in suspects:
        measure, where, noise, words = problem.unknowns[key].measure, None, 0.0, ""
        start, end = before[key], after[key]
        if errors and key in errors and key in problem.truth:
            noise = _standard_error(problem, key, errors[key])
        sensitivity_of_key = sensitivities.get(key)
        if sensitivity_of_key is not None and key in problem.truth:
            where = seen_cells(sensitivity_of_key)
            if where is not None and not where.all():
                words = " where the pictures show it"
            known = problem.truth[key]
            start, end = (measure.error(np.asarray(x[key]), known, where) or 0.0 for x in (first, last))
            noise = max(noise, _noise(problem, key, of, where))
        if start > 0.0 and math.hypot(ratio * start, _ERRORS * noise) < end:
            lines.append(
                f"{key} ends further from the truth than it began{words}: error {measure.text(end)}, {measure.text(start)} at the "
                "start; the images may allow several solutions: try another start, bounds, or more views"
            )
    return [*places, *lines]


def exchanged(problem: Problem, values: Mapping[str, np.ndarray]) -> tuple[Mapping[str, np.ndarray], list[str]]:
    """Return values with equal lights, or children of blends, exchanged where that is nearer to the truth, and a line about each such pair.

    All values of these are unknown or equal to those of the other, so the pictures stay the same. Poses are relative to a light's own
    place, so lights with these are left as they are.
    """
    infos, lines = problem.renderer.parameters(), []
    children = exchangeable_children(problem)
    for pair in (*exchangeable_pairs(problem), *children):
        one, other = ([key for key in values if key.startswith(f"{name}.")] for name in pair)
        partners = dict(zip([*one, *other], [*other, *one], strict=True)) if len(one) == len(other) else {}
        equal = all(key.removeprefix(pair[0]) == partners[key].removeprefix(pair[1]) for key in one if partners)
        if not partners or not equal or any(infos[key].rigid or key not in problem.truth for key in partners):
            continue
        weights = {children[pair]: 1.0 - values[children[pair]]} if pair in children else {}
        swapped = {**values, **{key: values[partner] for key, partner in partners.items()}, **weights}
        now, then = (problem.parameter_error(x) for x in (values, swapped))
        if math.prod(then[key] / now[key] for key in partners if now[key] > 0.0) < _EXCHANGED ** len(partners):
            values, errors = swapped, [f"{key} {problem.unknowns[key].measure.text(then[key])}" for key in partners]
            lines.append(
                f"{listed(pair)} ended in each other's place, where the pictures are the same: exchanged, the errors are {listed(errors)}"
            )
    return values, lines


def _curvature(problem: Problem, pictures: FreshPictures, truth: Mapping[str, np.ndarray], seconds: float) -> Curvature:
    """Return the curvature at the truth, with the noise of the pixels."""
    try:
        root = _noise_of_pixels(pictures, truth)
        noise = [np.broadcast_to(root, (*size, 2)) for size in problem.sizes]
        return curvature(problem, truth, _PROBES, seconds=_SECONDS_SHARE * seconds, noise=noise)
    except InputError:  # the renderer rejects the true values
        return Curvature()


def _noise_of_pixels(pictures: FreshPictures, truth: Mapping[str, np.ndarray]) -> np.ndarray:
    """Return a and b (2,) of the root a I + b 11ᵀ of the channels' covariance, of the noise of references and image.

    It is the residual at the truth without what neighbours share, such as the difference of a wrong model or of exchanged references.
    """
    residuals = pictures.compare(pictures.images(truth))
    shared = misfit(residuals, 0.0)
    variance = max(residuals.mean_square - (shared.error**2 if shared else 0.0), 0.0)
    mean, used = residuals.images.mean(axis=0), residuals.weights > 0
    unshared = (mean[1::2] - mean[:-1:2])[used[1::2] & used[:-1:2]]
    squares = float(np.square(unshared).sum())
    products = 0.5 * (float(np.square(unshared.sum(axis=1)).sum()) - squares)
    return root_of_covariance(variance, products / max(squares, 1e-300))


def _noise(problem: Problem, key: str, of: Curvature, where: np.ndarray | None) -> float:
    """Return the standard error of a parameter, in the unit of its error measure, from the noise of the pixels.

    Few probes make single elements uncertain, so all get the standard error of their mean curvature.
    """
    if where is not None and not where.any():
        return 0.0
    square, noise = (float(np.mean(x[key] if where is None else x[key][where])) for x in (of.squares, of.noise))
    return _standard_error(problem, key, math.sqrt(noise) / square, where) if square > 0.0 else 0.0


def _standard_error(
    problem: Problem, key: str, deviations: np.ndarray | float, where: np.ndarray | None = None
) -> float:
    """Return standard deviations of the elements as one of the parameter, in the unit of its error measure, such as degrees."""
    known, measure = np.asarray(problem.truth[key]), problem.unknowns[key].measure
    signs = np.random.default_rng(_SIGNS_SEED).choice((-1.0, 1.0), (_DRAWS, *known.shape))
    errors = [measure.error(known + deviations * of, known, where) or 0.0 for of in signs]
    return float(np.sqrt(np.mean(np.square(errors))))
