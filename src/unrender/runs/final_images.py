"""Final images of a run for its report, and their errors against the references."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from unrender.core import phases, timing
from unrender.core.text import names_in
from unrender.io.resampling import resize_nearest
from unrender.methods.rules.exchangeable import ambiguous_blends
from unrender.runs.budget import LEAST_NUMBERS, MOST_SLOWDOWN, cost_of_end, seconds_of_steps, slowdown
from unrender.runs.determination import (
    common_factor,
    undetermined,
    undetermined_cells,
    untested_cells,
    untested_factor,
    with_lost,
    without_known,
)
from unrender.runs.final_checks import (
    beyond_priors,
    differs_still,
    image_name,
    renderings_of_check,
    rise,
    unexplained_pixels,
)
from unrender.runs.image_sensitivity import Curvature, curvature, map_keys, seconds_of_probe
from unrender.runs.joint_maps import blurred_cells, hidden_changes, untested_changes
from unrender.runs.least_squares import NumbersCheck, check_numbers, checked_keys, compile_check
from unrender.runs.map_fit import no_better_maps
from unrender.runs.map_uncertainty import Uncertainty, no_maps, of_residuals, pixel_noise
from unrender.runs.numbers import TOO_SHORT
from unrender.runs.reference_distortions import AS_IF, of_references
from unrender.runs.result import Result
from unrender.runs.truth_check import FEW_NEWTON_STEPS, FEW_STEPS
from unrender.runs.verification import DIFFERS, SMOOTH, Misfit, misfit_of_views
from unrender.scene.coarse_to_fine import NEVER
from unrender.scene.problem import Problem
from unrender.scene.render import MANY_SENSORS, power_of_two, render
from unrender.statistics import debiased

_PICTURE_PATHS, _FEWEST, _MOST = 1 << 22, 16, 512
_SHARE, _LEAST_SECONDS = 0.05, 1.0
"""Time limit of final images relative to the time of the steps, and its minimum in seconds of an idle machine."""
_SENSITIVITY_SHARE = 0.5
"""Additional time limit of the sensitivity relative to that; it takes at least one probe."""
_LOOK_SHARE, _LOOK_SECONDS = 0.01, 0.25
"""Time limit of each of two tests of undetermined parameters relative to the time of the steps, and its minimum in seconds."""
_LEAST_COUNTED = 0.1  # time limit of each such test if renderings are counted, even if no time is left
_LEAST_TESTS = 0.6
"""Seconds on an idle machine that the tests of undetermined parameters have together even if the budget is over."""
_NUMBERS_SHARE, _NUMBERS_COUNTED = 0.05, 2.0
"""Time limit of least squares of few numbers relative to the time of the steps, and its minimum if renderings are counted: for four numbers
and up to 90 x 90 pixels it takes 1.5. Otherwise the minimum is a second."""
_TRIAL_PATHS, _PASS_PATHS, _MOST_PASS = 1 << 18, 1 << 18, 16
"""Paths of a trial and of one pass over all views, and most samples per pixel of a pass."""
_PICTURES_SHARE, _MOST_CHECK = 0.5, 1.25
"""Share of the time that is left at the end that final pictures may take with the check of unchanged pixels, and of what is left then that
this check may take; its most time, relative to that of the pictures, that is set aside by rendering fewer samples."""
_MOST_BYTES, _PICTURES = 1 << 29, 3
"""Memory limit of the images of views whose references are not in memory, and the number of images per view: reference, start, result."""
_NOT_TESTED = "the end of the run was not tested, or had no time left"  # for standard errors of textures and grids
_SEEDS = {"initial": 1, "result": 2}
_HALVES = 2 * len(_SEEDS)
_FEWEST_SAMPLES = 8
"""Fewest samples per pixel of a half with which `unexplained_pixels` judges: of fewer, most pixels miss the rare bright paths."""
_SECOND_HALF = 1 << 16  # offset of the seed for the second half of an image's samples


@dataclass(frozen=True)
class FinalImages:
    """Images at the end of a run with `spp` samples per pixel, and what `Result` states about them.

    Attributes:
        warnings: one line for each unknown that had not settled at the end.
        rise: warning that the final images are worse than those of the start, where the verification was uncertain; "" if they are not.
            Nothing is tested then.
    """

    pictures: dict[str, np.ndarray]
    errors: dict[str, tuple[float, float]]
    spp: int
    sensitivity: dict[str, np.ndarray]
    undetermined: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    standard_error: Mapping[str, np.ndarray] = field(default_factory=dict)
    data_share: Mapping[str, np.ndarray] = field(default_factory=dict)
    without_errors: tuple[str, ...] = ()
    misfit: Misfit | None = None
    rise: str = ""


def warm_up(problem: Problem, values: Mapping[str, np.ndarray], tested: bool = True, counted: float = math.inf) -> None:
    """Compile the kernels of `render_final_images` with an image of one pass per view and, if `tested`, one pass of each test.

    `counted` is the time for the check of few numbers if renderings are counted; otherwise infinite.
    """
    pass_spp, count = _pass_spp(problem), len(problem.views)
    own = count if count < MANY_SENSORS else 1  # more of them share their kernels
    for view in range(own):
        render(problem, values, view, pass_spp, per_pass=pass_spp)
    if tested and len(_chosen(problem)) == count:
        curvature(problem, values, probes=1, views=own)
        compile_check(problem, values, counted)


def render_final_images(
    problem: Problem,
    result: Result,
    spp: int | None = None,
    left: Callable[[], float] = lambda: math.inf,
    tested: bool = True,
    weights: Sequence[np.ndarray] = (),
    complete: bool = False,
    grace: float = math.inf,
) -> FinalImages:
    """Render the reference, initial and final image of each view, and collect control weights, pixel probabilities and sensitivities.

    Only some of many large views are rendered. Two independent halves of an image tell its error from its noise (`statistics.debiased`).

    Args:
        spp: samples per pixel; None for a power of two within a twentieth of the steps' time, or a second, and 4 million paths a view.
        left: function that returns the remaining seconds. If few remain, images have fewer samples, and the tests take half a second.
        tested: whether to estimate sensitivities and to test what the images determine.
        weights: weights of each view's pixels in the run's steps, see `WeighsPixels`.
        complete: whether the standard errors of the result contain the references' noise.
        grace: further seconds within which the first probe of the sensitivity must end; without them nothing is tested.
    """
    with phases.phase("final pictures") as advance:
        samples = spp or _affordable(problem, result, _PICTURES_SHARE * left())
        chosen, began = _chosen(problem), timing.now()
        pictures, errors, halves_of = _pictures(problem, result, chosen, samples, advance)
        spent, ends, paths = timing.now() - began, halves_of["result"], 2 * samples * problem.pixels
        if risen := rise(problem, result, pictures, errors, halves_of):
            return FinalImages(pictures, errors, samples, {}, rise=risen)
        tests = max(left(), 0.0 if timing.counts() else _LEAST_TESTS * min(slowdown(), MOST_SLOWDOWN))
        seconds = min(_SENSITIVITY_SHARE * max(_SHARE * seconds_of_steps(result), _LEAST_SECONDS), 0.5 * tests)
        tested = tested and seconds_of_probe(problem, spent, timing.cost(paths, 4 * len(chosen)), 2) < left() + grace
        everything = tested and len(chosen) == len(problem.views)
        halves = list(zip(*ends, strict=True)) if everything and result.steps and len(ends[0]) == 2 else []
        noise = pixel_noise(problem, halves) if halves else ()
        known = curvature(problem, result.parameters, seconds=seconds, noise=noise) if everything else Curvature()
        sensitivities, deviations = known.sensitivity(), dict(result.standard_error)
        lines, warnings, maps = [], (), _untested(problem, result, _NOT_TESTED)
        can_check = renderings_of_check(problem) / _HALVES * spent < _PICTURES_SHARE * left()
        differs = _differs(problem, result, chosen, halves_of, samples, can_check)
        still = None if differs else differs_still(problem, result, chosen, ends, samples)
        fits = not differs and (still is None or still.of_samples)
        if not tested and result.steps and not differs:
            lines, deviations = _left_out(problem, result, complete)
        if everything:
            end = _Tests(problem, result, weights, left, tests, spent / paths, ends)
            lines, warnings, deviations, unseen = _undetermined(end, known, fits, complete)
            differs = with_lost(problem, result, differs, unseen, ends, _pass_spp(problem), left)
            lines += _without_gradient(problem, result, sensitivities, ends, samples, 3.0 * spent < left())
            if halves and left() > 0.0:
                maps = of_residuals(problem, result.parameters, halves, known)
    fits, differs = fits and not differs, differs or still
    maps = maps if fits else _untested(problem, result, f"{DIFFERS} by more than noise")
    errors_of = {**deviations, **maps.standard_error} if fits else {}, maps.data_share, maps.missing
    if differs and len(chosen) == len(problem.views) and len(ends[0]) == 2 and spent < left():
        differs = beyond_priors(problem, differs, result.parameters, ends, partial(_first_half, problem, samples))
    few = result.steps < (FEW_NEWTON_STEPS if complete else FEW_STEPS)  # lights may still be far from their values
    words = "" if few else of_references(problem, chosen, halves_of["initial"], ends, (differs, result.misfit))
    texts, differs = _named([*lines, *maps.limited], differs, words)
    return FinalImages(pictures, errors, samples, sensitivities, texts, warnings, *errors_of, differs)


def _named(lines: Sequence[str], differs: Misfit | None, words: str) -> tuple[tuple[str, ...], Misfit | None]:
    """Return lines without those that a difference makes superfluous, and the difference; `words` name references."""
    if words:
        differs = differs and replace(differs, explanation=f"{differs.explanation}; they look {words}")
        lines = [*lines, f"the pictures look {words}; check the references"]
    if differs is None or differs.of_samples:  # such noise explains no smooth difference
        return tuple(lines), differs
    named = AS_IF in differs.line
    return tuple(line for line in lines if SMOOTH not in line and not (named and AS_IF in line)), differs


def _left_out(problem: Problem, result: Result, complete: bool) -> tuple[list[str], dict[str, np.ndarray]]:
    """Return lines about tests that are left out, and the standard errors that need none. Small `complete` ones exclude a shared factor."""
    late = NumbersCheck(unchecked=checked_keys(problem, result.parameters, result.initial))
    factors = without_known(untested_factor(problem), result.parameters, result.standard_error if complete else {})
    lines = [*factors, *untested_changes(problem), *untested_cells(problem), *late.missing()]
    return lines, _without(result.standard_error, late.unchecked)


def _untested(problem: Problem, result: Result, reason: str) -> Uncertainty:
    """Return no standard errors, with this reason for each texture and grid; without one for a run without steps."""
    keys = map_keys(problem) if result.steps else []
    return Uncertainty(missing=no_maps(dict.fromkeys(keys, reason)))


def _pictures(
    problem: Problem, result: Result, views: Sequence[int], spp: int, advance: Callable[[float], None]
) -> tuple[dict[str, np.ndarray], dict[str, tuple[float, float]], dict[str, list[tuple[np.ndarray, ...]]]]:
    """Return the pictures of some views by name, their errors, and the halves of each view's initial and final image."""
    pictures: dict[str, np.ndarray] = {}
    errors: dict[str, tuple[float, float]] = {}
    halves_of: dict[str, list[tuple[np.ndarray, ...]]] = {which: [] for which in _SEEDS}
    for place, index in enumerate(views):
        reference = np.asarray(problem.views[index].reference, np.float32)
        pictures[f"view{index}/reference"] = reference
        if (mask := problem.views[index].mask) is not None:
            pictures[f"view{index}/mask"] = np.asarray(mask, np.float32)
        for done, (which, values) in enumerate((("initial", result.initial), ("result", result.parameters))):
            name = image_name(index, which)
            of = problem.remeshed_from or problem if which == "initial" else problem
            halves, error = _picture(of, values, index, spp, _SEEDS[which])
            pictures[name] = sum(halves[1:], halves[0]) / len(halves)
            halves_of[which].append(halves)
            if error is not None:
                errors[name] = error
            advance((2 * place + done + 1) / (2 * len(views)))
        pictures |= _maps(result, index, reference.shape[:2])
    return pictures, errors, halves_of


def _maps(result: Result, view: int, shape: tuple[int, ...]) -> dict[str, np.ndarray]:
    weights, probabilities = (result.info.get(name, {}) for name in ("control_weight", "pixel_probability"))
    maps = {}
    if view in weights:
        maps[f"view{view}/control_weight"] = np.asarray(weights[view], np.float32)
    if view in probabilities:
        density = np.asarray(probabilities[view], np.float32)
        maps[f"view{view}/pixel_probability"] = resize_nearest(density, shape[0], shape[1])
    return maps


@dataclass(frozen=True)
class _Tests:
    """Run whose end is tested, `weights` and `left` of `render_final_images`, seconds for all tests, time of a path, and final pictures."""

    problem: Problem
    result: Result
    weights: Sequence[np.ndarray]
    left: Callable[[], float]
    seconds: float
    path_seconds: float
    ends: Sequence[Sequence[np.ndarray]]

    def within(self, seconds: float) -> float:
        """Return the seconds that a test may take: if renderings are counted, no more than are left."""
        return min(seconds, max(self.left(), _LEAST_COUNTED)) if timing.counts() else seconds


def _undetermined(
    tests: _Tests, known: Curvature, fits: bool, complete: bool
) -> tuple[list[str], tuple[str, ...], dict[str, np.ndarray], list[str]]:
    """Return lines about what the images do not determine and about numbers that have not settled, standard errors, and keys of
    undetermined numbers; none without steps.

    A final picture that does not fit the references (`fits`) has no standard errors. `complete`: see `render_final_images`. A test takes
    at most about a quarter of the time, unless renderings are counted: tests then take what is left, the most telling ones first.
    """
    problem, result, within = tests.problem, tests.result, tests.within
    most = tests.seconds if timing.counts() else 0.25 * tests.seconds
    if not result.steps:
        return [], (), {}, []
    sensitivities = known.sensitivity()
    lines = undetermined_cells(sensitivities)
    seconds = min(max(_LOOK_SHARE * seconds_of_steps(result), _LOOK_SECONDS), most)
    spp = power_of_two(min(max(_TRIAL_PATHS // math.prod(problem.sizes[0]), 1), _most_spp(problem) // 2))
    per_pass, stated = _pass_spp(problem), result.standard_error
    factors = common_factor(problem, result.parameters, spp, within(seconds), per_pass, within(most))
    slow = min(slowdown(), MOST_SLOWDOWN)
    allowed = min(slow * max(_NUMBERS_SHARE * seconds_of_steps(result), _LEAST_SECONDS), 2.0 * most)
    of_numbers, most_of_numbers = allowed, max(allowed, _NUMBERS_COUNTED)
    if timing.counts():
        of_numbers = min(most_of_numbers, cost_of_end(result.history[-1]["samples"], result.steps, LEAST_NUMBERS))
    given = of_numbers, sensitivities, tests.weights, stated, dict(enumerate(tests.ends))
    numbers = check_numbers(problem, result.parameters, result.initial, *given)
    deviations = _without(stated, (*numbers.unchecked, *numbers.elsewhere))
    deviations |= numbers.standard_errors(result.parameters, deviations, complete)
    limits = within(seconds), per_pass, within(most), sensitivities, deviations, tests.path_seconds
    lines += without_known(factors, result.parameters, deviations if fits else {})
    lines += undetermined(problem, result.parameters, spp, *limits)
    told = names_in("\n".join(line for line in lines if TOO_SHORT not in line), problem.unknowns)  # and tested
    lines += hidden_changes(problem, result.parameters, per_pass, within(2.0 * allowed), per_pass)
    limits = within(seconds), per_pass, within(most), tests.path_seconds
    lines += blurred_cells(problem, result.parameters, known, spp, *limits) if tests.left() > 0.0 else []
    lines += ambiguous_blends(problem)
    if fits:
        lines += [line for key, line in numbers.undetermined.items() if key not in told]
        lines += numbers.missing([key for key in numbers.unchecked if key in told] + [*numbers.undetermined])
        lines += numbers.noisy(stated)
    elif numbers.distorted:
        lines.append(numbers.distorted)
    failed = result.status == "failed"  # such a run did not end by its budget
    unfinished = () if failed else tuple(line for key, line in numbers.unfinished.items() if key not in told)
    return lines, unfinished, deviations, [*numbers.undetermined]


def _without(errors: Mapping[str, np.ndarray], keys: Sequence[str]) -> dict[str, np.ndarray]:
    """Return the standard errors of other keys: those of a number that may not have converged are too small."""
    return {key: error for key, error in errors.items() if key not in keys}


def _chosen(problem: Problem) -> list[int]:
    largest = max(height * width for height, width in problem.sizes)
    most, count = max(1, _MOST_BYTES // (_PICTURES * 12 * largest)), len(problem.views)
    if not problem.references.in_host_memory or count <= most:
        return list(range(count))
    return sorted({round(place) for place in np.linspace(0, count - 1, most)})


def _picture(
    problem: Problem, values: Mapping[str, np.ndarray], view: int, spp: int, seed: int
) -> tuple[tuple[np.ndarray, ...], tuple[float, float] | None]:
    """Return the halves of a view's image, and its error with the standard error; the image and None for a single sample."""
    first = spp // 2
    if first == 0:
        return (render(problem, values, view, spp, seed),), None
    per_pass = _per_pass(problem, first)
    one, other = (render(problem, values, view, first, seed + x, per_pass=per_pass) for x in (0, _SECOND_HALF))
    reference = np.asarray(problem.views[view].reference)
    return (one, other), debiased.rmse(one, other, reference, problem.test_weights(view, (one, other)))


def _without_gradient(
    problem: Problem,
    result: Result,
    sensitivities: Mapping[str, np.ndarray],
    ends: Sequence[tuple[np.ndarray, ...]],
    spp: int,
    in_time: bool,
) -> list[str]:
    """Return `no_better_maps` of the textures, grids and meshes without a sensitivity, with the random numbers of the result's final
    images."""
    meshes, seed = problem.faces if problem.remeshed_from is None else {}, _SEEDS["result"]
    keys = [key for key in (*map_keys(problem), *meshes) if key not in sensitivities] if result.steps else []
    return no_better_maps(
        problem, result, keys, ends, lambda values, view: _picture(problem, values, view, spp, seed)[0], in_time
    )


def _per_pass(problem: Problem, spp: int) -> int | None:
    """Return the samples per pixel of each pass of a half of an image; None for all at once."""
    pass_spp = _pass_spp(problem)
    return pass_spp if spp % pass_spp == 0 else None


def _differs(
    problem: Problem,
    result: Result,
    views: Sequence[int],
    halves: Mapping[str, Sequence[tuple[np.ndarray, ...]]],
    spp: int,
    can_check: bool,
) -> Misfit | None:
    """Return the difference of a run's pictures from the references by something that is not among the unknowns; None without one.

    `can_check` says whether there is time to render images for `unexplained_pixels`. Details that a coarse grid lacks are no other cause.
    """
    ends = halves["result"]
    differs = misfit_of_views(problem, views, ends, result.misfit) if result.steps else None
    coarse = any(result.steps <= levels.steps[-1] < NEVER for levels in problem.coarse_to_fine.values())
    possible = can_check and not coarse and spp >= 2 * _FEWEST_SAMPLES
    if differs or not result.steps or not possible or result.verification.get("best") != "end":
        return differs
    return unexplained_pixels(problem, result.parameters, halves["initial"], ends, partial(_first_half, problem, spp))


def _first_half(problem: Problem, spp: int, values: Mapping[str, np.ndarray], view: int) -> np.ndarray:
    """Return an image with the random numbers of the first half of a final image of the result."""
    return render(problem, values, view, spp // 2, _SEEDS["result"], per_pass=_per_pass(problem, spp // 2))


def _affordable(problem: Problem, result: Result, most_seconds: float) -> int:
    """Return the affordable samples per pixel of final images, from the measured time of a few samples of the first view."""
    sizes = [height * width for height, width in problem.sizes]
    most, trial, seconds = _most_spp(problem), _pass_spp(problem), timing.cost(_pass_spp(problem) * sizes[0])
    for seed in () if timing.counts() else (0, 1):  # the first rendering compiles kernels
        started = timing.now()
        render(problem, result.parameters, 0, trial, seed, per_pass=trial)
        seconds = timing.now() - started
    check = min(renderings_of_check(problem) / _HALVES, _MOST_CHECK)
    least = _LEAST_SECONDS * min(slowdown(), MOST_SLOWDOWN)
    allowed = min(max(_SHARE * seconds_of_steps(result), least), most_seconds / (1.0 + check))
    paths = allowed / max(seconds, 1e-6) * trial * sizes[0]
    return max(2, 2 * trial, power_of_two(int(min(most, max(paths, 0.0) / (2 * sum(sizes))))))


def _most_spp(problem: Problem) -> int:
    return min(min(max(_PICTURE_PATHS // (height * width), _FEWEST), _MOST) for height, width in problem.sizes)


def _pass_spp(problem: Problem) -> int:
    """Return the samples per pixel of one pass, few enough for the least pictures of all views. All passes share one kernel."""
    pixels = sum(height * width for height, width in problem.sizes)
    return power_of_two(min(_PASS_PATHS // pixels, _MOST_PASS, _most_spp(problem) // 2))
