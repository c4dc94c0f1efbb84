"""Comparison of a run's pictures with its references, and the control variates in its state."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

import numpy as np

from unrender.core.arrays import Array
from unrender.core.trees import Tree
from unrender.display import formatting
from unrender.estimators.fresh_pictures import FreshPictures, Picture, Residuals
from unrender.losses import FunctionLoss
from unrender.methods.rules.exchangeable import exchangeable_lights
from unrender.runs.folder.schema import MISFIT
from unrender.runs.folder.state import parts
from unrender.scene.problem import Problem
from unrender.statistics import paired_losses

if TYPE_CHECKING:
    from unrender.runs.numbers import Numbers

DIFFERS = "the final picture differs from the references"
"""First words of warnings about images that do not agree with the references."""
SMOOTH = "in a pattern that neither noise nor these numbers explain"
"""Words about the difference of `unexplained_share`."""
STEPS, STEPS_OF_FEW, PRIOR, NOISE = "steps", "steps of few", "prior", "noise"
"""Values of `Misfit.causes` that may explain a difference of a right scene: too few steps, surely or if there were few; a prior; noise."""
LOST = "lost"
"""Value of `Misfit.causes`: an unknown that the pictures show at the start, but no longer at the end."""
OF_FUNCTION = "the loss is a function of your own, whose minimum may differ from the references"
"""Reason for no standard errors with a `FunctionLoss`."""
_OF_PRIOR = "a prior may be too strong, or "
_OF_MODEL = 0.25
"""Smallest difference relative to the picture that ends a run without a known truth as "does not fit"; photographs differ by 13 %."""
_FEW_PIXELS, _OF_FEW = 96, 0.2
"""Number of pixels below which the difference is also judged pixel by pixel, which includes the references' noise; its smallest size
relative to the image in this case."""
_FEW_NUMBERS, _OF_PICTURE, _OF_CONCENTRATED = 24, 0.01, 0.05
"""Most numbers of a problem whose images must agree with the references, and smallest size of a difference relative to the image; that of
one in few pixels."""
_SAMPLES, _OF_SAMPLES, _OF_SAMPLES_SHORT, _SHARED = 16.0, 0.03, 0.05, 3.5
"""Samples per pixel of references up to which a difference as large as their noise is reported, and its smallest size relative to the
image; that in runs of less than about 100 steps; score of the product of two pictures' differences, which few pixels must not hold."""
_LEAST_SHARE = 1e-3
"""Smallest size of a difference after a fit of numbers, relative to the references: rounding to 8 bits has about this size."""
_FAR_ABOVE, _OF_NOISE = 1.5, 0.6
"""Ratios to the error and to the noise from which a warning has the largest difference; 0.6 are five standard errors of 8 x 8 pixels."""
_ROWS, _PAIRS = (3, 1), (1, 0)  # layouts for `paired_losses.systematic` of rows of pixels, and of pairs of a sample
_RARE, _ERRORS = 25.0, 2.0
"""Number of paths, of which one brings light, from which a warning says so, and standard errors by which it must be reached."""
_OF_TRUTH = 4.0  # least mean square of a residual judged pixel by pixel, relative to that at known true values
_OF_RESIDUAL, _OF_SEEN = 0.1, 0.02
"""Smallest error of a control variate, as a fraction of the mean square residual, and relative to the image."""


@dataclass(frozen=True)
class Misfit:
    """A difference of pictures from their references that noise does not explain.

    Attributes:
        error: its root mean square.
        size: root mean square of the references.
        noise: root mean square of the rest of the first picture's difference.
        by_pixel: whether pixels were judged one by one, so that the references' noise may be part of the difference.
        explanation: rest of the warning, after `describe`.
        causes: likely causes: `STEPS`, `STEPS_OF_FEW`, `PRIOR`, `NOISE`, `LOST`; () for something that is not among the unknowns.
        place: words about the pixels that hold it; "" for all.
        of_samples: whether it looks like the noise of few samples per pixel, which standard errors contain.
        largest: see `Residuals.largest`; 0 if unknown.
    """

    error: float
    size: float
    noise: float
    by_pixel: bool = False
    explanation: str = ""
    causes: tuple[str, ...] = ()
    place: str = ""
    of_samples: bool = False
    largest: float = 0.0

    @property
    def share(self) -> float:
        """Size relative to the references; infinite if these are black."""
        return self.error / self.size if self.size > 0.0 else math.inf

    @property
    def line(self) -> str:
        """The warning, one line."""
        return self.describe() + self.explanation

    def is_references_noise(self, at_truth: Callable[[], float] | None) -> bool:
        """Return whether the references' noise may explain a difference that was judged pixel by pixel. `at_truth` returns the mean square
        difference of pictures of the true values; None if these are unknown."""
        return self.by_pixel and at_truth is not None and self.error**2 <= _OF_TRUTH * at_truth()

    def record(self) -> dict[str, Any]:
        """Return the values for run.json."""
        share = float(f"{self.share:.6g}") if math.isfinite(self.share) else None
        return {"error": float(f"{self.error:.6g}"), "share": share, "causes": list(self.causes)}

    def describe(self) -> str:
        """Return the first words of a warning, with the ratio to the noise above 1, and the largest difference if it stands out."""
        times = f"{self.error / self.noise:.1f} times its noise" if 0.0 < self.noise < self.error else ""
        share = f"{self.share:.0%} of the picture" if self.size > 0.0 else ""
        stands_out = self.largest > max(_FAR_ABOVE * self.error, _OF_NOISE * self.noise)
        most = f"up to {formatting.number(self.largest)} over 8 x 8 pixels" * stands_out
        known = ", ".join(filter(None, (share, times, most)))
        parts = f" ({known})" * bool(known)
        return f"{DIFFERS} by {formatting.number(self.error)}{parts}{self.place}"


def misfit(
    residuals: Residuals,
    least: float,
    earlier: Residuals | None = None,
    repeated: Residuals | None = None,
    by_pixel: bool = False,
) -> Misfit | None:
    """Return the difference from the references that two pictures share; None if it may be noise or is small.

    Noise of the references does not count, since neighbouring pixels do not share it.

    Args:
        residuals: those of K independent images, whose halves are the two pictures.
        least: smallest difference relative to the references.
        earlier: those of the second picture, whose noise may depend on the first one's at the same pixel; the first is then the mean of
            all images.
        repeated: those of K >= 4 images at the end. With these, few pixels are also judged one by one.
        by_pixel: whether many pixels are, too. Without `repeated`, only a difference that few of them hold counts.
    """
    for others in filter(None, (earlier, repeated)):
        residuals = replace(residuals, weights=residuals.weights * (others.weights > 0))
    one, other = (x.images.mean(axis=0) for x in (residuals, earlier)) if earlier else residuals.halves
    weights, sizes, size = residuals.weights, residuals.sizes, residuals.size
    total = math.sqrt(paired_losses.mean_square(one, weights))

    def significant(
        shared: paired_losses.SystematicDifference, smallest: float, one_by_one: bool, place: str = ""
    ) -> Misfit | None:
        error = math.sqrt(max(shared.mean_square, 0.0))
        if not (shared.score > paired_losses.SIGNIFICANT and error > smallest * size):
            return None
        return Misfit(error, size, math.sqrt(max(total**2 - error**2, 0.0)), one_by_one, place=place)

    tiles = paired_losses.systematic(one, weights, other, _ROWS if sizes else _PAIRS)
    edges = (paired_losses.nearby(one, weights, sizes, axes, other) for axes in ((0,), (1,), (0, 1)))
    scales = (significant(part, least, False) for part in (tiles, *edges))
    difference = max(filter(None, scales), key=lambda found: found.error, default=None)
    if difference is None:
        line, place = paired_losses.at_border(one, other, weights, sizes)
        difference = significant(line, least, False, place)
    if difference is None and repeated and (by_pixel or np.count_nonzero(weights) < _FEW_PIXELS):
        difference = significant(
            paired_losses.repeated(repeated.images[0::2], repeated.images[1::2], weights), _OF_FEW, True
        )
    if difference is None and by_pixel:
        concentrated = paired_losses.concentrated(one, other, weights, sizes)
        difference = significant(concentrated, max(least, _OF_CONCENTRATED), True)
    return difference and replace(difference, largest=residuals.largest)


def misfit_of_numbers(
    problem: Problem,
    residuals: Residuals,
    known: Misfit | None = None,
    improved: bool = True,
    at_truth: Callable[[], float] | None = None,
) -> Misfit | None:
    """Return the difference of images from the references if only few numbers, or poses of lights, are unknown; None if noise explains it.

    Least squares of few numbers end where the difference is noise. Elsewhere their standard errors mean nothing. Noise of the references
    does not count, since pixels do not share it. It counts after a run without improvement, whose difference may be in few pixels.

    Args:
        problem: problem with the unknowns.
        residuals: those of K independent images; K < 2 gives None.
        known: difference that the run has found, which is returned.
        improved: whether the images are better than at the start.
        at_truth: see `Misfit.is_references_noise`.
    """
    if not compares(problem):
        return None
    infos = [problem.renderer.parameters()[key] for key in problem.shapes()]
    lights = all(info.rigid and info.light for info in infos)
    few = sum(math.prod(info.shape) for info in infos) <= _FEW_NUMBERS
    if not (few or lights) or len(residuals.images) < 2:
        return None
    if known is not None:
        return known
    repeated = None if improved or len(residuals.images) < 4 else residuals
    difference = misfit(residuals, _OF_PICTURE, None, repeated, by_pixel=True)
    if difference is None or difference.is_references_noise(at_truth):
        return None
    noise = "noise does not explain:"
    if difference.by_pixel:
        noise = "this picture's noise does not explain: the references are noisy, or"
    words, causes = prior_cause(problem)
    words += "two lights are in each other's place, or " if exchangeable_lights(problem) else ""
    explanation = (
        f", which {noise} {words}the run needs more steps, another start or other bounds, or something that is not among the unknowns is "
        "wrong; hence no standard errors"
    )
    causes = (*causes, STEPS_OF_FEW, *([NOISE] if difference.by_pixel else []))
    return replace(difference, explanation=explanation, causes=causes)


def as_few_samples(residuals: Residuals, spp: float, short: bool) -> Misfit | None:
    """Return a difference as large as the noise of references with few samples per pixel; None if theirs would have many.

    Noise of n samples has 1/n of the variance of one sample, in every pixel. Other differences exceed it most in the half of the pixels
    with less noise. The noise of a pixel's neighbours orders them, because that is independent of the pixel's own. A pattern is no noise.

    Args:
        residuals: those of two independent images.
        spp: samples per pixel of each image.
        short: whether the run has so few steps that its difference may still fall.
    """
    from scipy.ndimage import uniform_filter  # takes long to import

    weights, sizes, (one, other) = residuals.weights, residuals.sizes, residuals.halves
    products, variances = residuals.products, weights * np.square(one - other).sum(axis=1) * (spp / 2)
    images = [variances[x].reshape(size) for x, size in zip(paired_losses.slices_of_images(sizes), sizes, strict=True)]
    around = np.concatenate([np.ravel(9.0 * uniform_filter(image, 3) - image) for image in images])
    used = np.flatnonzero(weights)
    quiet = used[np.argsort(around[used])[: len(used) // 2]]
    shared, parts = float(products[quiet].sum()), (products[quiet], products[used])
    clear = all(float(x.sum()) > _SHARED * math.sqrt(float(x @ x)) for x in parts)
    error = math.sqrt(residuals.shared)
    count = float(variances[quiet].sum()) / max(shared, 1e-300)
    large = error > (_OF_SAMPLES_SHORT if short else _OF_SAMPLES) * residuals.size
    if not (large and clear and count < _SAMPLES):
        return None
    words = f"as the noise of references with {count:.2g} samples per pixel would: if they have several times as many,"
    if pattern := paired_losses.has_pattern(one, other, weights, sizes):
        words = "in a pattern that noise lacks:"
    words += " the run needs more steps or another start, or light, depth, alignment or something that is not among the unknowns is wrong"
    return Misfit(
        error, residuals.size, 0.0, True, f", {words}", (STEPS,) if pattern else (STEPS, NOISE), of_samples=not pattern
    )


def misfit_of_views(
    problem: Problem, views: Sequence[int], images: Sequence[Sequence[np.ndarray]], known: Misfit | None = None
) -> Misfit | None:
    """Return `misfit_of_numbers` of independent images (H, W, 3) of each of some views."""
    return misfit_of_numbers(problem, Residuals.of(problem, views, images), known)


def unexplained_share(numbers: Numbers, slopes: np.ndarray, inverse: np.ndarray) -> float:
    """Return the size of what a least-squares fit leaves of the final pictures' residual, relative to the references; 0 where noise or
    other unknowns than the numbers may explain it. For the arguments, see `distortions_of_fit`."""
    if not numbers.ends or len(numbers.keys) < len(numbers.problem.unknowns):
        return 0.0
    references = numbers.references()
    ends = [numbers.weighted(view, np.mean(numbers.ends[view], axis=0)[None])[0] for view in numbers.views]
    roots = np.concatenate([numbers.roots(view).any(axis=1) for view in numbers.views])
    sizes = [numbers.problem.sizes[view] for view in numbers.views]
    of = Residuals(np.concatenate(ends)[None] - references, references, roots, sizes)
    left = of.images[0] - np.tensordot(inverse @ np.tensordot(slopes, of.images[0], axes=2), slopes, axes=1)
    size = max(of.size, 1e-150)
    shared = paired_losses.in_blocks(left, of.weights > 0, sizes, _LEAST_SHARE * size)
    share = math.sqrt(max(shared.mean_square, 0.0)) / size
    return share if shared.score > paired_losses.SIGNIFICANT and share > _LEAST_SHARE else 0.0


def compares(problem: Problem) -> bool:
    """Return whether pixels may tell if a run has converged. The minimum of a user's function may differ from the references."""
    return not isinstance(problem.loss, FunctionLoss)


def prior_cause(problem: Problem) -> tuple[str, tuple[str, ...]]:
    """Return the first words of the causes of a difference from the references, and `PRIOR`, if an unknown has a prior."""
    return (_OF_PRIOR, (PRIOR,)) if problem.has_prior else ("", ())


def without_prior(difference: Misfit) -> Misfit:
    """Return a difference that no prior explains."""
    causes = tuple(cause for cause in difference.causes if cause != PRIOR)
    return replace(difference, causes=causes, explanation=difference.explanation.replace(_OF_PRIOR, ""))


def fit_status(problem: Problem, status: str, difference: Misfit | None, few: bool) -> str:
    """Return the status of a run that used up its budget: "does not fit" for a finished one that differs from its references for certain.

    Differences that more steps, a weaker prior or less noise in the references may explain do not change the status. Without a known
    truth, neither do those below a quarter of the picture. An unknown that the pictures have lost always changes it.

    Args:
        status: status without the warnings.
        difference: difference of the run's pictures from the references; None for none.
        few: whether the run had few steps. Differences that more of them may explain then do not change the status.
    """
    if status != "finished" or difference is None:
        return status
    if LOST in difference.causes:
        return MISFIT
    large = difference.share >= (0.0 if problem.has_truth else _OF_MODEL)
    return MISFIT if large and not {*difference.causes} - (set() if few else {STEPS_OF_FEW}) else status


def rare_light(images: Sequence[np.ndarray], weights: np.ndarray, spp: float) -> str:
    """Return a warning if only one path of many brings light to the pictures, as in caustics; "" otherwise.

    A pixel of mean m whose light comes from a fraction p of its paths has a variance of at least m² (1 − p) / p per path.

    Args:
        images: independent images (K, N, 3) of each frame, K >= 2.
        weights: weight of each pixel of all frames, (N,). Pixels of weight 0 do not count.
        spp: samples per pixel of one of these.
    """
    joined = np.concatenate(images, axis=1)[:, weights > 0].sum(axis=2)
    joined = joined[:, np.isfinite(joined).all(axis=0)]
    joined /= max(float(np.abs(joined).max(initial=0.0)), 1e-300)  # squares of the largest numbers overflow
    variances = joined.var(axis=0, ddof=1)
    squares = np.square(joined.mean(axis=0)) - variances / len(joined)
    most = float(squares.sum()) + _ERRORS * math.sqrt(float(np.square(squares).sum()))
    paths = 1.0 + spp * float(variances.sum()) / max(most, 1e-300)
    if not most > 0.0 or paths < _RARE:
        return ""
    return (
        f"at most one path in {paths:.0f} brings light, so pictures and gradients are noisy: paths from the camera rarely find lights "
        "behind glass, in caustics, or through small openings; use more samples per pixel, larger lights, or rough materials"
    )


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
        relevant = self.error**2 > _OF_RESIDUAL * self.residual**2 and self.error > _OF_SEEN * self.picture
        return self.score > paired_losses.SIGNIFICANT and relevant


def compare_memory(
    pictures: FreshPictures, memory: list[np.ndarray], fresh: list[np.ndarray], residual: Picture
) -> Memory:
    """Compare new images (K, N, 3) with control variates (N, 3) of the same parameters, frame by frame.

    `residual` is the image whose distance from the references serves as scale.
    """
    images = np.concatenate(fresh, axis=1)
    own = Residuals(images, np.zeros(images.shape[1:]), pictures.weights, pictures.sizes)  # from a black picture
    differences, counted = np.concatenate(memory) - own.images.mean(axis=0), own.weights > 0
    if not np.isfinite(differences[counted]).all():
        return Memory(math.inf, 0.0, 0.0, math.inf)
    shared = paired_losses.systematic(np.where(counted[:, None], differences, 0.0), own.weights)
    error, left = math.sqrt(max(shared.mean_square, 0.0)), pictures.compare(residual.images).shared
    return Memory(error, math.sqrt(own.shared), math.sqrt(left), shared.score)


@runtime_checkable
class HasControlVariates(Protocol):
    """An estimator's state, or a part of it, with control variates of images."""

    def control_variates(self) -> tuple[Tree, Sequence[Array]] | None:
        """Return the parameters of the images, and the image (H, W, 3) of each view; None before the first step."""
        ...


def control_variates(state: Any) -> Iterator[tuple[Tree, Sequence[Array]]]:
    """Yield the control variates in all parts of an estimator's state."""
    for part in parts(state):
        if isinstance(part, HasControlVariates) and (images := part.control_variates()) is not None:
            yield images
