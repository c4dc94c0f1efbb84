"""New images of earlier steps of a run: does it no longer improve, or has it not converged?"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from unrender.core.errors import InputError
from unrender.estimators.fresh_pictures import FreshPictures, Picture, Residuals
from unrender.runs.verification import NOISE, STEPS, STEPS_OF_FEW, Misfit, compares, misfit, prior_cause
from unrender.scene.problem import Problem
from unrender.statistics.paired_losses import difference

FIRST_CANDIDATE = 64
"""Step after which the first candidate is taken; the interval doubles each time."""
_EARLIER, _STILL = 0.75, 0.85
"""Fraction of the steps up to which an earlier image counts; ratio of the last loss to its loss above which a run no longer improves."""
_OF_PICTURE = 0.02
"""Smallest size of the residual at the end, relative to the image."""
_EARLIER_SHORT, _STILL_SHORT, _SURE, _OF_PICTURE_SHORT = 0.5, 0.9, 2.0, 0.05
"""The same limits as above for runs whose earlier image is of a step before 64: fraction of the steps; ratio of the losses, with the number
of standard errors by which it must be exceeded; smallest size of the residual relative to the image."""
_FALLS, _OF_PICTURE_FALLING = 0.8, 0.1
"""Ratio of the last loss to the earlier one below which a run has not converged, and smallest difference, relative to the image, that is
reported of a run whose loss falls or may do so."""


@dataclass(frozen=True)
class EarlierImage:
    """A new image of an earlier step, with the random numbers of other steps' ones."""

    step: int
    picture: Picture
    pictures: FreshPictures

    @property
    def residuals(self) -> Residuals:
        """Differences from the references."""
        return self.pictures.compare(self.picture.images)

    @property
    def is_short(self) -> bool:
        """Return whether it is of one of the first steps."""
        return self.step < FIRST_CANDIDATE

    def is_compared(self, steps: int) -> bool:
        """Return whether it is early enough for a comparison with the end of a run of that many steps."""
        return self.step <= (_EARLIER_SHORT if self.is_short else _EARLIER) * steps

    def change(self, earlier: EarlierImage, factor: float) -> tuple[float, float]:
        """Return the loss minus `factor` times that of an earlier step, and its standard error; infinite if no part of both is finite."""
        first, second = factor * earlier.picture.losses, self.picture.losses
        finite = np.isfinite(first).all(axis=0) & np.isfinite(second).all(axis=0)
        of = difference(first[:, finite], second[:, finite], self.pictures.sampled)
        return (of.value, of.standard_error) if finite.any() and math.isfinite(of.value) else (math.inf, math.inf)

    def is_still(self, earlier: EarlierImage) -> bool:
        """Return whether the loss has hardly fallen since an earlier step: surely for a short run, as far as noise tells for others."""
        if earlier.is_short:
            value, error = self.change(earlier, _STILL_SHORT)
            return _SURE * error < value < math.inf
        value, error = self.change(earlier, _STILL)
        return -(error if math.isfinite(error) else 0.0) < value < math.inf


def stored(images: Sequence[EarlierImage], rendered: int) -> dict[str, Any]:
    """Return the contents of a checkpoint for images of earlier steps; `rendered` is the number of paths of all new images so far."""
    parts = [{"step": x.step, "images": list(x.picture.images), "losses": x.picture.losses} for x in images]
    return {"rendered": rendered, "earlier": parts}


def check_stored(saved: Any, where: str) -> None:
    """Raise `InputError` unless it is the result of `stored`, of any shapes."""

    def is_image(one: Any) -> bool:
        match one:
            case {"step": int(), "images": list(parts), "losses": np.ndarray() as losses}:
                return all(isinstance(x, np.ndarray) and x.dtype == np.float64 for x in (*parts, losses))
        return False

    match saved:
        case {"rendered": int(rendered), "earlier": list(images)} if rendered >= 0 and all(map(is_image, images)):
            return
    raise InputError(f"{where}: expected images of earlier steps, got {repr(saved)[:60]}")


def restored(saved: Mapping[str, Any], pictures: FreshPictures, like: Picture) -> list[EarlierImage]:
    """Return the images of a checkpoint that have the shapes of another one, and count their paths."""
    if not saved:
        return []
    pictures.rendered = saved["rendered"]
    found = [(x["step"], Picture(tuple(x["images"]), x["losses"])) for x in saved["earlier"]]
    shapes = [x.shape for x in (*like.images, like.losses)]
    return [EarlierImage(n, x, pictures) for n, x in found if [y.shape for y in (*x.images, x.losses)] == shapes]


def stays(loss: float, step: int, change: float, error: float) -> bool:
    """Return whether a loss has surely hardly fallen since a step, after which it changed by `change` with this standard error.

    The loss is that of pictures with little noise. A rise counts as no change, so a change whose noise is large proves nothing.
    """
    factor = _STILL_SHORT if step < FIRST_CANDIDATE else _STILL
    return (1.0 - factor) * loss + factor * min(change, 0.0) > _SURE * factor * error


def falls(loss: float, change: float | None, error: float | None) -> bool:
    """Return whether a loss is surely far below that of an earlier step; for the arguments, see `stays`. None stands for infinity."""
    return change is not None and error is not None and change + _SURE * error < -(1.0 - _FALLS) * (loss - change)


def least_difference(step: int) -> float:
    """Return the smallest difference from the references that counts at the end of a run compared with `step`, relative to the image."""
    return _OF_PICTURE_SHORT if step < FIRST_CANDIDATE else _OF_PICTURE


def no_improvement(
    problem: Problem, residuals: Residuals, change: Mapping[str, Any], loss: float, steps: int
) -> Misfit | None:
    """Return a difference of images of the end of a run from the references, of a tenth or more where the loss may still fall.

    Images of `runs.verify` have few paths. Their paired difference tells the change of the loss, but their noise may hide its value.

    Args:
        residuals: those of K >= 2 independent images.
        change: "change" of `Result.verification`; {} without an earlier image.
        loss: loss of the images, without their noise.
        steps: number of the run's steps.
    """
    if not compares(problem):
        return None
    step, fall = change.get("step", 0), change.get("loss", (None, None))
    still = None not in fall and stays(loss, step, *fall)
    differs = misfit(residuals, least_difference(step) if still else _OF_PICTURE_FALLING, by_pixel=True)
    if differs is None:
        return None
    found = unexplained(problem, differs, step, steps, still)
    if not found.by_pixel:
        return found
    words = found.explanation.replace(": ", ": the references may be noisy, or ", 1)
    return replace(found, explanation=words, causes=(*found.causes, NOISE))


def unexplained(problem: Problem, differs: Misfit, step: int, steps: int, stays: bool = True) -> Misfit:
    """Return a difference at the end of a run whose loss has hardly fallen since `step`, certainly if `stays`, with its explanation."""
    cause = (
        "light, depth or something else that is not among the unknowns may be wrong, or the run is in a local minimum"
    )
    words, causes = prior_cause(problem)
    cause = f"{words}{cause}"
    still = "no longer improves"
    if step < FIRST_CANDIDATE or not stays:
        still = f"has hardly improved since step {step} of {steps}" if stays else "may still improve"
        cause, causes = f"it may need more steps, or {cause}", (*causes, STEPS_OF_FEW if stays else STEPS)
    return replace(differs, explanation=f", and {still}: {cause}", causes=causes)


def of_best(difference: Misfit, pictures: FreshPictures, best: Picture) -> Misfit | None:
    """Return a difference of the end with the size of that of better parameters, which the result holds; None if these have none."""
    smaller = misfit(pictures.compare(best.images), _OF_PICTURE)
    return smaller and replace(smaller, explanation=difference.explanation, causes=difference.causes)


def not_converged(problem: Problem, last: EarlierImage, earlier: EarlierImage) -> Misfit | None:
    """Return a difference of the image from the references of a tenth or more beyond noise if the loss still falls, or may do so.

    Both images have the same random numbers. Averages over steps would lower the loss without progress, so neither is of averages.
    """
    residuals = last.residuals
    differs = misfit(residuals, _OF_PICTURE_FALLING, residuals) if compares(problem) else None
    if differs is None:
        return None
    value, error = last.change(earlier, _FALLS)
    if not value + _SURE * error < 0.0:
        return unexplained(problem, differs, earlier.step, last.step, stays=False)
    fallen = f"its loss has fallen by {1 - last.picture.loss[0] / earlier.picture.loss[0]:.0%} since step {earlier.step} of {last.step}"
    explanation = f", and the run has not converged: {fallen}; give it more steps or seconds"
    return replace(differs, explanation=explanation, causes=(STEPS,))
