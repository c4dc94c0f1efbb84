"""Verification of a run at its end: new images of its start and end, and comparison with its control variates."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from unrender.core import phases
from unrender.display import formatting
from unrender.estimators.fresh_pictures import FreshPictures, Picture, is_finite
from unrender.optimizers.averaged_newton import AveragedNewton
from unrender.runs import phase_times
from unrender.runs.callbacks import Callback
from unrender.runs.earlier_image import FIRST_CANDIDATE, EarlierImage, not_converged
from unrender.runs.folder.schema import MEMORY_DISAGREES, WORSE
from unrender.runs.number_means import averaged
from unrender.runs.result import INTERRUPTED, PRUNED, TERMINATED, Result
from unrender.runs.run import Candidate
from unrender.runs.truth_check import FEW_NEWTON_STEPS, FEW_STEPS, further_from_truth
from unrender.runs.verification import control_variates, misfit, misfit_of_numbers, rare_light
from unrender.scene.problem import Problem
from unrender.statistics import paired_losses

if TYPE_CHECKING:
    from unrender.runs.run import Run

_SHARE = 0.004
"""Fraction of the run's paths for one new image; there are at most four."""
_LARGER_SHARE, _PARTS = 0.01, 8
"""The same fraction, and the number of parts with images of their own, where the first images do not tell whether the end is better or
worse than the start: few bright pixels, such as those of a visible lamp, may hold most of the noise. All images then use at most 6 % of
the run's paths. Samples of pixels, those of more than 4,096 pixels, get no larger images."""
_LARGER_IMAGES = 4
"""Number of larger images for which time must be left: the start, the end, a candidate and a control variate."""
_LEVEL, _LEVEL_AGAIN = 1e-4, 1e-3
"""False positive rate of each test; that of the test by more paths, which few runs reach."""
_LEAST_CHANGE = 1e-3
"""Relative change of the loss below which two points count as equal."""
_OF_RESIDUAL, _OF_PICTURE = 0.1, 0.02
"""Smallest error of a control variate, as a fraction of the mean square residual, and relative to the image."""
_WORTH_A_LINE = 1.25
"""Ratio of the last loss to that of earlier parameters from which a warning says that these are returned."""
_FIRST_EARLIER, _COST = 4, 0.02
"""Step from which images of earlier steps are taken for short runs, if their paths are at most this fraction of the steps' paths."""
_CANDIDATES, _END, _AGAIN = 1, 2, 3
"""Indices of the sets of random numbers."""


@dataclass(frozen=True)
class Memory:
    """Comparison of a control variate with a new image.

    Attributes:
        error: root mean square of the difference that neighbouring pixels share.
        picture: root mean square of the new image.
        residual: root mean square difference of the new image from the references, without noise.
        score: score of `error`; see `paired_losses.SystematicDifference`.
    """

    error: float
    picture: float
    residual: float
    score: float

    @property
    def disagrees(self) -> bool:
        """Return whether the error exceeds noise, and is a fraction of the residual that misleads the optimisation."""
        if not math.isfinite(self.error):
            return True
        relevant = self.error**2 > _OF_RESIDUAL * self.residual**2 and self.error > _OF_PICTURE * self.picture
        return self.score > paired_losses.SIGNIFICANT and relevant


@dataclass
class Verify(Callback):
    """Callback that verifies a run at its end by new images, and returns the best parameters.

    Candidates are the start, the parameters after 64, 128, 256, … steps, and the end. The one with the least loss becomes
    `Result.parameters`; another one than the end must be significantly better. Each image uses 0.4 % of the run's paths, or about 8,000
    paths in a short run. Where these leave open which end of the run is better, larger images of 1 % judge it, if time is left. Films of
    more than 4,096 pixels in total get no larger images if a sample of their pixels is rendered. The steps are not affected.
    """

    _pictures: FreshPictures | None = field(default=None, init=False)
    _earlier: list[EarlierImage] = field(default_factory=list, init=False)

    def on_warm_up(self, run: Run, fresh: dict[str, Any], warm: dict[str, Any]) -> None:
        """Compile the kernels of fresh pictures, so that nothing compiles after the last step."""
        del fresh, warm
        with phases.phase(phase_times.COMPILING):
            FreshPictures(run.problem, run.seed, 0, _END).images(run.full())

    def on_step(self, run: Run, record: dict[str, Any]) -> None:
        """Render a candidate at steps 64, 128, 256, …, and images for the residual of short runs at steps 4, 8, 16 and 32."""
        del record
        if run.step < _FIRST_EARLIER or run.step & (run.step - 1) or _other_meshes(run.problem):
            return
        if self._pictures is None:
            self._pictures = FreshPictures(run.problem, run.seed, 0, _CANDIDATES)
        short = run.step < FIRST_CANDIDATE
        if short and self._pictures.paths > _COST * run.state.samples:
            return
        values = run.full()
        earlier = EarlierImage.of(run.step, self._pictures, values)
        self._earlier = [*self._earlier[-1:], earlier]
        if short:
            return
        loss = earlier.loss
        known = run.state.candidate
        if known is None or loss < known.loss:
            run.state.candidate = Candidate(run.step, loss, values)

    def on_result(self, run: Run, result: Result) -> Result:
        """Verify the result, unless the run was interrupted, terminated or pruned."""
        if result.stopped in (INTERRUPTED, TERMINATED, PRUNED) or not result.steps:
            return result
        started = time.perf_counter()
        with phases.phase(phase_times.VERIFYING):
            result = self._verified(run, result)
        return phase_times.with_phase(result, phase_times.VERIFYING, time.perf_counter() - started)

    def _verified(self, run: Run, result: Result) -> Result:
        problem = run.problem
        unaveraged = result.parameters
        pictures, first, result, last, worse = _ends(run, result)
        places: dict[str, tuple[Picture, Mapping[str, np.ndarray]]] = {}
        if worse and problem.remeshed_from is None:
            places["start"] = first, result.initial
        candidate = run.state.candidate
        if candidate is not None and not _other_meshes(problem) and not candidate.loss >= last.loss[0]:
            candidate_picture = pictures.picture(candidate.parameters)
            if _is_worse(pictures, candidate_picture, last):
                places[f"step {candidate.step}"] = candidate_picture, candidate.parameters
        best = min(places, key=lambda name: places[name][0].loss[0], default="end")
        memory = _memory(run, pictures, last)
        disagrees = memory is not None and memory.disagrees
        best_picture = places[best][0] if places else last
        lines = self._residual(problem, result, unaveraged, pictures, last)
        if result.standard_error and not (lines or places):
            differences = pictures.differences(last.images)
            improved = _is_worse(pictures, last, first)
            arguments = problem, differences, pictures.references, pictures.weights
            at_truth = partial(_at_truth, problem, pictures, result) if problem.has_truth else None
            differs = misfit_of_numbers(*arguments, improved=improved, at_truth=at_truth, sampled=pictures.in_pairs)
            lines = [differs] if differs else []
        if lines:
            result = replace(result, standard_error={})
        # A Gauss-Newton step solves for all unknowns, so few of them may converge.
        few = result.steps < (FEW_NEWTON_STEPS if isinstance(run.optimizer, AveragedNewton) else FEW_STEPS)
        if problem.has_truth and not _other_meshes(problem) and not (few and _is_worse(pictures, last, first)):
            ends = places[best][1] if places else result.parameters
            lines += further_from_truth(problem, pictures, result.initial, ends, few, result.seconds)
        lines += _lines(first, last, best, best_picture.loss[0], memory if disagrees else None, worse)
        spp = pictures.paths / (pictures.pixels * len(last.images[0]))
        lines += filter(None, [rare_light(last.images, pictures.weights, spp)])
        verification: dict[str, Any] = {
            "status": WORSE if worse else MEMORY_DISAGREES if disagrees else "finished",
            "start": _numbers(*first.loss),
            "end": _numbers(*last.loss),
            "best": best,
            "best_loss": _numbers(*best_picture.loss),
            "paths": pictures.paths,
        }
        if memory is not None:
            verification["memory"] = {"error": _number(memory.error), "picture": _number(memory.picture)}
        return replace(
            result,
            parameters=dict(places[best][1]) if places else result.parameters,
            standard_error={} if places else result.standard_error,
            verification=verification,
            warnings=[*result.warnings, *lines],
        )

    def _residual(
        self,
        problem: Problem,
        result: Result,
        unaveraged: Mapping[str, np.ndarray],
        pictures: FreshPictures,
        end: Picture,
    ) -> list[str]:
        """Return a warning if the images differ from the references by more than noise, and the loss stays or still falls fast.

        Args:
            unaveraged: parameters of the last step, as the images of earlier steps have them.
            pictures: renderer of the last image, with random numbers independent of those of earlier steps.
            end: the last image.
        """
        earlier = next((one for one in reversed(self._earlier) if one.is_compared(result.steps)), None)
        if self._pictures is None or earlier is None:
            return []
        # Averages over steps lower the loss without progress, so the comparison with an earlier step is of the last step itself.
        last = EarlierImage.of(result.steps, self._pictures, unaveraged)
        if not last.is_still(earlier):
            return not_converged(last, earlier, self._pictures)
        if unaveraged is not result.parameters:
            last = EarlierImage.of(result.steps, self._pictures, result.parameters)
        references, weights = self._pictures.references, self._pictures.weights
        sampled = pictures.sampled or self._pictures.sampled  # each has other pixels then
        fresh = None if sampled else pictures.differences(end.images)
        of = last.residuals, earlier.residuals, references, weights, earlier.least, fresh
        difference = misfit(*of, sampled=self._pictures.in_pairs)
        at_truth = partial(_at_truth, problem, self._pictures, result) if problem.has_truth else None
        if difference is None or difference.is_references_noise(at_truth):
            return []
        cause = "light, depth or something else that is not among the unknowns may be wrong, or the run is in a local minimum"
        if any(unknown.prior is not None for unknown in problem.unknowns.values()):
            cause = f"a prior may be too strong, or {cause}"
        still = "no longer improves"
        if earlier.is_short:
            still = f"has hardly improved since step {earlier.step} of {result.steps}"
            cause = f"it may need more steps, or {cause}"
        return [f"{difference.describe()}, and {still}: {cause}"]


def _ends(run: Run, result: Result) -> tuple[FreshPictures, Picture, Result, Picture, bool]:
    """Return the renderer of new images, the image of the start, the result as `_end` returns it, its image, and whether it is worse.

    If these images show all pixels and do not decide which end of the run is better, larger ones with other random numbers decide. This
    needs time in the run's budget. They are returned only if the end is worse by them.
    """
    start = run.problem.remeshed_from or run.problem
    pictures = FreshPictures(run.problem, run.seed, _SHARE * run.state.samples, _END)
    began = time.perf_counter()
    first = pictures.picture(result.initial, start)
    seconds = time.perf_counter() - began
    ended, last = _end(run, result, pictures)
    worse = _is_worse(pictures, first, last)
    if not (pictures.sampled or worse or _is_worse(pictures, last, first)):
        larger = FreshPictures(run.problem, run.seed, _LARGER_SHARE * run.state.samples, _AGAIN, _PARTS)
        expected = _LARGER_IMAGES * seconds * larger.paths / pictures.paths
        if larger.paths > pictures.paths and expected < run.time_left():
            others = larger.picture(result.initial, start), larger.picture(ended.parameters)
            if _is_worse(larger, *others, _LEVEL_AGAIN):
                return larger, others[0], ended, others[1], True
    return pictures, first, ended, last, worse


def _end(run: Run, result: Result, pictures: FreshPictures) -> tuple[Result, Picture]:
    """Return the result with means of its numbers, unless its picture is worse than with the last values, and that picture."""
    mean = averaged(run, result)
    picture = pictures.picture(mean.parameters)
    if mean is result:
        return result, picture
    last = pictures.picture(result.parameters)
    return (result, last) if _is_worse(pictures, last, picture) else (mean, picture)


def _at_truth(problem: Problem, pictures: FreshPictures, result: Result) -> float:
    """Return the mean square difference between the images at the true values and the references."""
    truth = {**result.parameters, **{key: value for key, value in problem.truth.items() if key in result.parameters}}
    return pictures.residual(pictures.images(truth))


def compare_memory(
    pictures: FreshPictures, memory: list[np.ndarray], fresh: list[np.ndarray], residual: Picture
) -> Memory:
    """Compare new images (K, N, 3) with control variates (N, 3) of the same parameters, frame by frame.

    `residual` is the image whose distance from the references serves as scale.
    """
    weights = pictures.weights
    means = np.concatenate([images.mean(axis=0) for images in fresh])
    differences = np.concatenate(memory) - means
    finite: np.ndarray = np.isfinite(np.sum(means, axis=1, keepdims=True))[:, 0]
    if not np.isfinite(differences[finite]).all():
        return Memory(math.inf, 0.0, 0.0, math.inf)
    shared = paired_losses.systematic(np.where(finite[:, None], differences, 0.0), weights * finite)
    total = max(float((weights * finite).sum()) * 3, 1e-300)

    def product(images: list[np.ndarray], subtracted: np.ndarray | float) -> float:
        joined = np.concatenate(images, axis=1)
        one, other = joined[0::2].mean(axis=0) - subtracted, joined[1::2].mean(axis=0) - subtracted
        products = np.where(np.isfinite(one * other), one * other, 0.0) * (weights * finite)[:, None]
        return math.sqrt(max(float(products.sum()) / total, 0.0))

    error = math.sqrt(max(shared.mean_square, 0.0))
    return Memory(error, product(fresh, 0.0), product(list(residual.images), pictures.references), shared.score)


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
    """Return the warnings, one sentence each."""
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
