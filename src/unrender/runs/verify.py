"""Verification of a run at its end: new images of its start and end, and comparison with its control variates."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from unrender.core import phases, timing
from unrender.display import formatting
from unrender.estimators.fresh_pictures import FreshPictures, Picture, is_finite
from unrender.optimizers.base import Settling
from unrender.runs import callbacks
from unrender.runs.budget import seconds_of_steps
from unrender.runs.callbacks import Callback
from unrender.runs.earlier_image import (
    FIRST_CANDIDATE,
    EarlierImage,
    least_difference,
    no_improvement,
    not_converged,
    of_best,
    restored,
    stored,
    unexplained,
)
from unrender.runs.folder.schema import MEMORY_DISAGREES, WORSE
from unrender.runs.number_means import averaged, normalised
from unrender.runs.result import INTERRUPTED, TERMINATED, Result
from unrender.runs.run import Candidate
from unrender.runs.truth_check import further_from_truth, has_few_steps, with_few_steps
from unrender.runs.verification import (
    Memory,
    Misfit,
    compare_memory,
    compares,
    control_variates,
    fit_status,
    misfit,
    misfit_of_numbers,
    rare_light,
)
from unrender.scene.problem import Problem
from unrender.statistics import paired_losses

if TYPE_CHECKING:
    from unrender.runs.run import Run

_MOST_SHARE = 0.02
"""Largest fraction of the run's paths for all new images, from about a million paths on; images of shorter runs have the least size."""
_SHARE, _PARTS = 0.0025, 8
"""Fraction of the run's paths for one new image, of which there are at most five: the start, the last values, the means of numbers, a
candidate and a control variate. Number of parts, with images of their own, of larger images that judge start and end where these do not
tell them apart: few bright pixels, such as those of a visible lamp, may hold most of the noise. They use the paths that are left."""
_LEAST_LARGER, _LEAST_DOUBTFUL = 1 << 13, 1 << 15
"""Paths that such an image may have in any run whose images show all pixels: twice as many as others of short runs, and eight times as
many where the end has the larger loss."""
_LEVEL, _LEVEL_AGAIN = 1e-4, 1e-3
"""False positive rate of each test; that of the test by more paths, which few runs reach."""
_LEAST_CHANGE = 1e-3
"""Relative change of the loss below which two points count as equal."""
_WORTH_A_LINE, _LARGE = 1.25, 0.2
"""Ratio of the last loss to that of earlier parameters from which a warning says that these are returned; share of the picture from which
an image of few paths tells."""
_FIRST_EARLIER, _COST, _OF_TRUTH = 4, 0.014, 8.0
"""First step with an image for short runs, largest share of these in the steps' paths, and time of a check against the truth, in steps."""
_SMALL, _END, _AGAIN = 1, 2, 3
"""Indices of the sets of random numbers."""


@dataclass
class Verify(Callback):
    """Callback that verifies a run at its end by new images, and returns the best parameters.

    Candidates are the start, the parameters after 64, 128, 256, … steps, and the end. The one with the least loss becomes
    `Result.parameters`; another one than the end must be significantly better. All images together use at most 2 % of the run's paths,
    if these are a million or more. Each uses 0.25 %, or about 4,000 paths in a short run. Larger images use the paths that are left, if
    there is time: where start and end are not told apart, and for the end of a run without a run folder, which has no final pictures.
    Where the end may be worse, images of start and end may use 33,000 paths each in addition. The steps are not affected.
    """

    _small: FreshPictures | None = field(default=None, init=False)
    _first: Picture | None = field(default=None, init=False)
    _candidate: tuple[int, Picture] | None = field(default=None, init=False)
    _earlier: list[EarlierImage] = field(default_factory=list, init=False)
    _larger: tuple[FreshPictures, Picture] | None = field(default=None, init=False)

    def on_warm_up(self, run: Run, fresh: dict[str, Any], warm: dict[str, Any]) -> None:
        """Render the start, which also compiles the kernels of fresh pictures, so that nothing compiles after the last step."""
        with phases.phase(callbacks.COMPILING):
            self._small = FreshPictures(run.problem, run.seed, 0, _SMALL)
            if _other_meshes(run.problem):
                self._small.images(run.full())
            else:
                self._first = self._small.picture(run.initial)
                self._earlier = restored(run.state.pictures, self._small, self._first)

    def on_step(self, run: Run, record: dict[str, Any]) -> None:
        """Render a candidate at steps 64, 128, 256, …, and images for the residual of short runs at steps 4, 8, 16 and 32."""
        pictures = self._small
        if pictures is None or run.step < _FIRST_EARLIER or run.step & (run.step - 1) or _other_meshes(run.problem):
            return
        short = run.step < FIRST_CANDIDATE
        at_end = run.step == run.steps and run.folder is None  # no run continues, and the end has its own image
        if at_end or (short and pictures.paths > _COST * run.state.samples):
            return
        values = run.full()
        picture = pictures.picture(values)
        self._earlier = [*self._earlier[-1:], EarlierImage(run.step, picture, pictures)]
        run.state.pictures = stored(self._earlier, pictures.rendered)
        known, loss = run.state.candidate, picture.loss[0]
        if not short and (known is None or loss < known.loss):
            run.state.candidate, self._candidate = Candidate(run.step, loss, values), (run.step, picture)

    def on_result(self, run: Run, result: Result) -> Result:
        """Verify the result, unless the run was interrupted or terminated."""
        if result.stopped in (INTERRUPTED, TERMINATED) or not result.steps:
            return result
        started = time.perf_counter()
        with phases.phase(callbacks.VERIFYING), timing.counting(run.seconds is None):
            result = normalised(run.problem, self._verified(run, result))
        if run.folder is None:  # a folder has more tests
            of, solver = run.problem.coordinates.of(run.parameters), run.optimizer
            unsettled = solver.unsettled(run.state.optimizer, of) if isinstance(solver, Settling) else frozenset()
            result = with_few_steps(run.problem, result, unsettled)
        return callbacks.with_phase(result, callbacks.VERIFYING, time.perf_counter() - started)

    def _verified(self, run: Run, result: Result) -> Result:
        problem, (pictures, first) = run.problem, self._start(run, result)
        began = time.perf_counter()
        result, last, unaveraged = _end(run, result, pictures)
        seconds = time.perf_counter() - began
        memory, candidate_picture = _memory(run, pictures, last), None
        candidate = None if _other_meshes(problem) else run.state.candidate
        if candidate is not None and not (candidate.step == result.steps or candidate.loss >= last.loss[0]):
            candidate_picture = self._candidate_picture(pictures, candidate)
        judged = self._judged(run, result, pictures, (first, last), seconds)
        worse = _is_worse(pictures, first, last) or judged[0] is not first
        places: dict[str, tuple[Picture, Mapping[str, np.ndarray]]] = {}
        if worse and problem.remeshed_from is None:
            places["start"] = first, result.initial
        if candidate is not None and candidate_picture is not None and _is_worse(pictures, candidate_picture, last):
            places[f"step {candidate.step}"] = candidate_picture, candidate.parameters
        best = min(places, key=lambda name: places[name][0].loss[0], default="end")
        disagrees = memory is not None and memory.disagrees
        best_loss = {"start": judged[0], "end": judged[1]}.get(best, candidate_picture or last).loss
        differs, change = self._residual(problem, result, pictures, last, unaveraged)
        differs = of_best(differs, pictures, places[best][0]) if differs and places else differs
        if result.standard_error and not (differs or places):
            improved, truth = _is_worse(pictures, last, first), _at_truth(problem, pictures)
            differs = misfit_of_numbers(problem, pictures.compare(last.images), improved=improved, at_truth=truth)
        if run.folder is None and not (differs or places):
            differs = self._by_more_paths(run, result, pictures, last, change, seconds)
        if differs:
            result = replace(result, standard_error={})
        lines = [differs.line] if differs else []
        few = has_few_steps(result.steps, run.optimizer)
        known = problem.has_truth and run.tested and run.time_left() > _OF_TRUTH * run.clock / result.steps
        if known and not _other_meshes(problem) and not (few and _is_worse(pictures, last, first)):
            ends = places[best][1] if places else result.parameters
            errors = {} if places else result.standard_error
            lines += further_from_truth(problem, pictures, result.initial, ends, few, seconds_of_steps(result), errors)
        lines += _lines(*judged, best, best_loss[0], memory if disagrees else None, worse)
        spp = pictures.paths / (pictures.pixels * len(last.images[0]))
        lines += filter(None, [rare_light(last.images, pictures.weights, spp)])
        status = WORSE if worse else MEMORY_DISAGREES if disagrees else "finished"
        verification: dict[str, Any] = {
            "status": fit_status(problem, status, differs, few),
            "start": _numbers(*judged[0].loss),
            "end": _numbers(*judged[1].loss),
            "best": best,
            "best_loss": _numbers(*best_loss),
            "paths": pictures.paths,
            **({} if places else change),
        }
        if memory is not None:
            verification["memory"] = {"error": _number(memory.error), "picture": _number(memory.picture)}
        return replace(
            result,
            parameters=dict(places[best][1]) if places else result.parameters,
            standard_error={} if places else result.standard_error,
            verification=verification,
            misfit=differs,
            warnings=[*result.warnings, *lines],
        )

    def _start(self, run: Run, result: Result) -> tuple[FreshPictures, Picture]:
        """Return the renderer of new images, and the image of the start: the one before the first step, unless the run is long."""
        pictures = FreshPictures(run.problem, run.seed, _SHARE * run.state.samples, _END)
        if self._small is not None and self._first is not None and pictures.paths <= self._small.paths:
            return self._small, self._first
        return pictures, pictures.picture(result.initial, run.problem.remeshed_from or run.problem)

    def _candidate_picture(self, pictures: FreshPictures, candidate: Candidate) -> Picture:
        if pictures is self._small and self._candidate is not None and self._candidate[0] == candidate.step:
            return self._candidate[1]
        known, picture = pictures.rendered, pictures.picture(candidate.parameters)
        if pictures is self._small:  # of a resumed run, which has counted it
            pictures.rendered = known
        return picture

    def _judged(
        self, run: Run, result: Result, pictures: FreshPictures, ends: tuple[Picture, Picture], seconds: float
    ) -> tuple[Picture, Picture]:
        """Return images of start and end: larger ones where `ends` do not tell which one is better and the end is worse by the larger ones.

        The larger ones show all pixels. They use the paths that are left, and need time in the run's budget.

        Args:
            pictures: the renderer of `ends`.
            ends: images of the start and of the end.
            seconds: time of the images of the end.
        """
        first, last = ends
        if _is_worse(pictures, first, last) or _is_worse(pictures, last, first):
            return ends
        # Paths of the images of `_residual`.
        waiting = 0 if self._small is None or self._small is pictures else len(ends) * self._small.paths
        least = _LEAST_DOUBTFUL if last.loss[0] > first.loss[0] else _LEAST_LARGER
        larger = self._larger_pictures(run, pictures, len(ends), waiting, seconds, least)
        if larger is None or larger.sampled:
            return ends
        start = run.problem.remeshed_from or run.problem
        others = larger.picture(result.initial, start), larger.picture(result.parameters)
        self._larger = larger, others[1]
        return others if _is_worse(larger, *others, _LEVEL_AGAIN) else ends

    def _by_more_paths(
        self, run: Run, result: Result, pictures: FreshPictures, last: Picture, change: dict[str, Any], seconds: float
    ) -> Misfit | None:
        """Return the difference that final pictures would show, from an image with the paths that are left, or a large one of `last`.
        `change` is the second value of `_residual`; see `_judged` for the others."""
        if self._larger is None:
            larger = self._larger_pictures(run, pictures, 1, 0, seconds)
            self._larger = larger and (larger, larger.picture(result.parameters))
        larger, end = self._larger or (pictures, last)
        of = run.problem, larger.compare(end.images)
        fall = change.get("change", {}), end.loss[0], result.steps
        differs = misfit_of_numbers(*of) or no_improvement(*of, *fall)
        return differs if differs and (self._larger or differs.share > _LARGE) else None

    def _larger_pictures(
        self, run: Run, pictures: FreshPictures, count: int, waiting: int, seconds: float, least: int = _LEAST_LARGER
    ) -> FreshPictures | None:
        """Return a renderer of `count` larger images for the paths that are left; None without paths or time.

        `waiting` is the number of paths of images that are still to be rendered; `seconds` is the time of an image of `pictures`; `least`
        is the number of paths that each of two images may have in any case.
        """
        spent = pictures.rendered + waiting
        if self._small is not None and self._small is not pictures:
            spent += self._small.rendered
        left = (_MOST_SHARE * run.state.samples - spent) / count
        left = left if pictures.sampled or count < 2 else max(left, least)
        larger = FreshPictures(run.problem, run.seed, left, _AGAIN, _PARTS)
        expected = count * seconds * larger.paths / pictures.paths
        return larger if pictures.paths < larger.paths <= left and expected <= run.time_left() else None

    def _residual(
        self, problem: Problem, result: Result, pictures: FreshPictures, end: Picture, unaveraged: Picture
    ) -> tuple[Misfit | None, dict[str, Any]]:
        """Return a difference of the images from the references beyond noise, if the loss stays or still falls fast.

        The second value is {"change": …} of `Result.verification`; {} if no earlier image is compared.

        Args:
            pictures: renderer of the images of the end.
            end: image of the result.
            unaveraged: image of the parameters of the last step, as the images of earlier steps have them.
        """
        earlier = next((one for one in reversed(self._earlier) if one.is_compared(result.steps)), None)
        small = self._small
        if small is None or earlier is None:
            return None, {}
        averages = unaveraged is not end
        if small is not pictures:
            unaveraged = small.picture(result.last)
        # Averages over steps lower the loss without progress, so the comparison with an earlier step is of the last step itself.
        last = EarlierImage(result.steps, unaveraged, small)
        change = {"change": {"step": earlier.step, "loss": _numbers(*last.change(earlier, 1.0))}}
        if not (compares(problem) and last.is_still(earlier)):
            return not_converged(problem, last, earlier), change
        if averages:
            last = replace(last, picture=end if small is pictures else small.picture(result.parameters))
        # A sample of pixels has others than the images of earlier steps.
        repeated = None if pictures.sampled or small.sampled else pictures.compare(end.images)
        difference = misfit(last.residuals, least_difference(earlier.step), earlier.residuals, repeated)
        if difference is None or difference.is_references_noise(_at_truth(problem, small)):
            return None, change
        return unexplained(problem, difference, earlier.step, result.steps), change


def _end(run: Run, result: Result, pictures: FreshPictures) -> tuple[Result, Picture, Picture]:
    """Return the result with means of its numbers, unless its image is worse than with the last values, its image, and that of these."""
    mean = averaged(run, result)
    last = pictures.picture(result.parameters)
    if mean is result:
        return result, last, last
    picture = pictures.picture(mean.parameters)
    return (result, last, last) if _is_worse(pictures, last, picture) else (mean, picture, last)


def _at_truth(problem: Problem, pictures: FreshPictures) -> Callable[[], float] | None:
    """Return the function of `Misfit.is_references_noise`; None unless the true values of all unknowns are known."""
    truth = problem.truth
    return (
        (lambda: pictures.compare(pictures.images(truth)).mean_square)
        if truth.keys() == problem.unknowns.keys()
        else None
    )


def _memory(run: Run, pictures: FreshPictures, last: Picture) -> Memory | None:
    """Compare the control variates of the estimator's state with a new image; returns the worst of several, None for none.

    Those in workers are compared only in runs with a run folder, whose last checkpoint collects them anyway.
    """
    problem, state = run.problem, run.state.estimator
    if problem.executor.variant is not None:
        if run.folder is None:
            return None
        state = problem.executor.collect(state)
    memories = [
        compare_memory(pictures, pictures.memory(images), pictures.images(parameters), last)
        for parameters, images in control_variates(state)
    ]
    return max(memories, key=lambda memory: (memory.disagrees, memory.score), default=None)


def _is_worse(pictures: FreshPictures, first: Picture, other: Picture, level: float = _LEVEL) -> bool:
    """Return whether the loss of `other` is significantly above that of `first`; an image that is not finite is worse."""
    if not is_finite(first, other):
        return True
    (finite,) = np.nonzero(np.isfinite(np.sum(first.losses + other.losses, axis=0)))
    if not finite.size:
        return False
    a, b = first.losses[:, finite], other.losses[:, finite]
    change = paired_losses.difference(a, b, pictures.sampled)
    if not pictures.sampled and not math.isfinite(change.standard_error):
        return not change.value <= 0  # the standard error has overflowed
    least = _LEAST_CHANGE * abs(float(a.mean(axis=0).sum()))
    return change.value > least and change.exceeds_noise(level)


def _other_meshes(problem: Problem) -> bool:
    """Return whether meshes are remeshed, so that parameters of different steps have different shapes."""
    planned = any(unknown.remeshing is not None for unknown in problem.unknowns.values())
    return planned or problem.remeshed_from is not None


def _lines(first: Picture, last: Picture, best: str, best_loss: float, memory: Memory | None, worse: bool) -> list[str]:
    lines = []
    if worse:
        outcomes = {"end": "no earlier parameters can be kept", "start": "the result holds the initial parameters"}
        words = outcomes.get(best, f"the result holds the parameters of {best}")
        lines.append(
            f"the final picture is worse than the initial one: loss {_loss(last)}, {_loss(first)} at the start; {words}; "
            "try a lower learning_rate, more samples per pixel, or another method"
        )
    elif best != "end" and best_loss * _WORTH_A_LINE < last.loss[0]:
        lines.append(
            f"the final picture is worse than that of {best}: the result holds the parameters of {best}; try a lower learning_rate"
        )
    if memory is not None:
        share = f"{memory.error / memory.picture:.0%} of the picture" if memory.picture > 0 else "not finite"
        lines.append(
            f"the control variate differs from a fresh picture by {formatting.number(memory.error)} ({share}), so the reported loss "
            "is wrong; try --method plain, or the control variate's space = primary"
        )
    return lines


def _loss(picture: Picture) -> str:
    value, error = picture.loss
    return formatting.with_standard_error(value, error) if math.isfinite(value) else "not finite"


def _number(value: float) -> float | None:
    return float(f"{value:.6g}") if math.isfinite(value) else None


def _numbers(*values: float) -> list[float | None]:
    return [_number(value) for value in values]
