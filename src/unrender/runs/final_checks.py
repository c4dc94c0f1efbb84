"""Checks of the final images of a run: worse than those of the start, or different from the references."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from unrender.core import arrays
from unrender.display import formatting
from unrender.estimators.fresh_pictures import Residuals
from unrender.estimators.penalties import penalty
from unrender.runs.determination import changed
from unrender.runs.earlier_image import FIRST_CANDIDATE, falls, no_improvement
from unrender.runs.folder.schema import MISFIT, WORSE
from unrender.runs.reference_distortions import AS_IF, distortions
from unrender.runs.result import Result
from unrender.runs.verification import PRIOR, STEPS, Misfit, as_few_samples, compares, misfit, without_prior
from unrender.scene.problem import Problem
from unrender.statistics import scores
from unrender.statistics.paired_losses import slices_of_images

_ERRORS, _ERRORS_OF_RISE, _OF_START, _OF_PICTURE = 2.0, 4.0, 0.2, 1e-4
"""Standard errors by which a verified loss must have fallen to be lower; those by which final images must be worse than the initial ones,
and by how much of the initial mean square error and of the mean square of the references."""

_OF_BIAS = 0.25
"""Share of the bias from noise that counts as its standard error, since two halves may agree by chance."""

_LITTLE, _OF_PIXEL = 0.1, 0.02
"""Changes of a pixel by random changes of all elements up to which the unknowns hardly change it: relative to the usual one, and relative
to the pixel."""
_AROUND, _OF_AROUND = 5, 0.8
"""Side of the square around such a pixel in which most others must be hardly changed as well, and share of these: random changes of the
elements in a pixel may cancel."""
_FEWEST, _MOST_KEYS = 64, 12
"""Fewest pixels that are judged, and most unknowns that change as a whole."""
_BLOCK, _ELSEWHERE = 8, 0.25
"""Side of the blocks of pixels, and share of them that does not count beside unknown poses: the object may belong there."""
_OF_POSE = "the pose needs more steps or another start, or "
"""Words about the cause that a larger object belongs in these pixels."""
_LEAST, _LEAST_OF_CAUSE = 0.02, 0.25
"""Smallest difference relative to these pixels of the references, and factor of it for one that looks like a distorted reference, which
silhouettes hold."""
_SEED = 7
_SURE, _OF_FILTER, _OF_NOISE, _MOSTLY, _DISTINCT = 4.5, 1.8, 1.2, 0.8, 1.3
"""Standard errors from which a residual looks like a distorted reference; factor of these for noise that neighbouring pixels share;
smallest size relative to the noise of half of the samples, and to the difference whose cause it is; and how many times as much as
any other it must explain."""

Picture = Callable[[Mapping[str, np.ndarray], int], np.ndarray]
"""Function of values and a view that returns a picture (H, W, 3), with the random numbers of the first of the pictures of the end."""


def image_name(view: int, which: str) -> str:
    """Return the name of a view's "initial" or "result" image."""
    return f"view{view}/{which}"


def rise(
    problem: Problem,
    result: Result,
    pictures: Mapping[str, np.ndarray],
    errors: Mapping[str, tuple[float, float]],
    halves: Mapping[str, Sequence[tuple[np.ndarray, ...]]],
) -> str:
    """Return a warning if the final images of all views are worse than the initial ones, by more than noise and by a visible amount.

    It is "" where the verification found that the loss has fallen, or that earlier parameters are better, and for losses and priors whose
    minimum is elsewhere. Losses of full images, of which the verification renders few, are compared themselves.
    """
    if problem.has_prior or (problem.loss.pixelwise and not problem.loss.linear):
        return ""
    start, end = (result.verification.get(name, [None, None]) for name in ("start", "end"))
    ended = (
        problem.remeshed_from is None
        and result.status in ("finished", MISFIT)
        and result.verification.get("best") == "end"
    )
    if not ended or None in (*start, *end):
        return ""
    if end[0] + _ERRORS * math.hypot(start[1], end[1]) < start[0] or len(errors) < 2 * len(problem.views):
        return ""
    if not problem.loss.pixelwise:
        values, views = (result.initial, result.parameters), range(len(problem.views))
        pairs = zip(values, (halves["initial"], halves["result"]), strict=True)
        (before, noise), (after, more) = (loss_of_halves(problem, own, views, images) for own, images in pairs)
        rises = after - before > max(_ERRORS_OF_RISE * math.hypot(noise, more), _OF_START * before)
        return _worse("loss", after, before) if rises else ""
    totals, variance, size = {"initial": 0.0, "result": 0.0}, 0.0, 0.0
    for index, view in enumerate(problem.views):
        share = view.weight / sum(each.weight for each in problem.views)
        size += share * float(np.mean(np.square(pictures[f"view{index}/reference"])))
        for which in totals:
            value, error = errors[image_name(index, which)]
            totals[which] += share * value**2
            # Beyond four errors the second number is the error of the value, else an upper bound (see `debiased.rmse`).
            variance += (share * (2.0 * value * error if value > 4.0 * error else 0.5 * error**2)) ** 2
    risen = totals["result"] - totals["initial"]
    if not (
        risen > _ERRORS_OF_RISE * math.sqrt(variance) and risen > max(_OF_START * totals["initial"], _OF_PICTURE * size)
    ):
        return ""
    return _worse("image error", math.sqrt(totals["result"]), math.sqrt(totals["initial"]))


def _worse(measure: str, after: float, before: float) -> str:
    return (
        f"the final picture is worse than the initial one: {measure} {formatting.number(after)}, {formatting.number(before)} at the start; "
        "the result holds the initial parameters; try a lower learning_rate, more samples per pixel, or another method"
    )


def at_start(result: Result, rise: str) -> Result:
    """Return a result with the initial parameters, which final images have found to be better, and the warning about it."""
    verification = {name: value for name, value in result.verification.items() if name != "change"}
    verification |= {"status": WORSE, "best": "start", "best_loss": verification["start"]}
    return replace(
        result,
        parameters=dict(result.initial),
        standard_error={},
        verification=verification,
        warnings=[*result.warnings, rise],
    )


def loss_of_halves(
    problem: Problem, values: Mapping[str, np.ndarray], views: Sequence[int], images: Sequence[tuple[np.ndarray, ...]]
) -> tuple[float, float]:
    """Return the loss of images of some views without the bias from their noise, and about its standard error, from their halves.

    Pixels that are not finite count as equal to the reference.
    """
    loss, square, array = penalty(problem, values), 0.0, problem.renderer.array
    for view, (one, other) in zip(views, images, strict=True):
        reference = np.asarray(problem.views[view].reference)
        finite = np.isfinite(one + other)
        both, *parts = (
            arrays.number(problem.loss_value(view, array(np.where(finite, image, reference))))
            for image in ((one + other) / 2, one, other)
        )
        half = sum(parts) / 2.0
        loss += 2.0 * both - half
        square += (0.5 * (parts[0] - parts[1])) ** 2 + (_OF_BIAS * (half - both)) ** 2
    return loss, math.sqrt(square)


def differs_still(
    problem: Problem, result: Result, views: Sequence[int], ends: Sequence[tuple[np.ndarray, ...]], spp: int
) -> Misfit | None:
    """Return `no_improvement` or, unless the loss falls, `as_few_samples` of the halves of the final images, of `spp` samples per pixel
    together; None if a difference is known or the images are not all."""
    known = result.misfit is not None or result.verification.get("best") != "end"
    if known or len(views) < len(problem.views) or len(ends[0]) < 2:
        return None
    loss, _ = loss_of_halves(problem, result.parameters, views, ends)
    change = result.verification.get("change", {})
    residuals = Residuals.of(problem, views, ends)
    difference = no_improvement(problem, residuals, change, loss, result.steps)
    if difference or not compares(problem) or falls(loss, *change.get("loss", (None, None))):
        return difference
    return as_few_samples(residuals, spp / 2, change.get("step", 0) < FIRST_CANDIDATE)


def with_misfit(result: Result, difference: Misfit | None) -> Result:
    """Return a result with this difference from the references in place of its own one, also in its warnings.

    It is unchanged for None, and if it has a difference and more steps may explain the new one.
    """
    if difference is None or (result.misfit is not None and difference.causes == (STEPS,)):
        return result
    known = result.misfit.line if result.misfit else ""
    return replace(result, misfit=difference, warnings=[*(x for x in result.warnings if x != known), difference.line])


def renderings_of_check(problem: Problem) -> int:
    """Return the number of images of each view that `unexplained_pixels` renders; 0 if it does not.

    These are one for all unknowns, one for each, and one for each prior.

    Poses of lights and sensors, lenses and vertex positions may change any pixel, so problems with such unknowns are not judged.
    """
    known, count = [problem.renderer.parameters()[key] for key in problem.unknowns], len(problem.unknowns)
    anywhere = any((of.rigid and of.light) or of.viewpoint or of.welded for of in known)
    priors = sum(unknown.prior is not None for unknown in problem.unknowns.values())
    return 0 if anywhere or count > _MOST_KEYS or not compares(problem) else 1 + count + priors


def unexplained_pixels(
    problem: Problem,
    result: Mapping[str, np.ndarray],
    starts: Sequence[Sequence[np.ndarray]],
    ends: Sequence[Sequence[np.ndarray]],
    picture: Picture,
) -> Misfit | None:
    """Return the difference from the references of pixels that the unknowns hardly change; None if noise may explain it.

    A run may be short, so its residual r contains what the unknowns will still explain. Random changes of all elements show which pixels
    depend on them directly. Light that all elements send to the others, such as a wall's to the floor, changes with their mean: what the
    run's own change of the pictures and constant changes of each unknown explain of r is subtracted, by least squares in each channel.
    A prior holds unknowns far from what the references say, so with one these pixels must differ as much as the others. An object whose
    pose is not found yet may belong in these pixels, so beside a pose, more steps are a cause.

    Args:
        result: {key: array} at the end.
        starts, ends: K >= 2 independent pictures (H, W, 3) of each view at the start and at the end.
        picture: see `Picture`.
    """
    views = range(len(problem.views))
    if not renderings_of_check(problem) or len(ends) < len(views) or len(ends[0]) < 2:
        return None
    residuals = Residuals.of(problem, views, ends)

    def change(values: Mapping[str, np.ndarray]) -> np.ndarray:
        return _joined(problem, [picture(values, view) - of[0] for view, of in zip(views, ends, strict=True)])

    signs = np.random.default_rng(_SEED)
    random = change({key: changed(problem, key, x, signs.choice((-1.0, 1.0), x.shape)) for key, x in result.items()})
    residuals = replace(residuals, weights=residuals.weights * np.isfinite(random).all(axis=1))
    weights, sizes = residuals.weights, residuals.sizes
    first = residuals.images[0] + residuals.references
    little = _is_little(first, np.where(weights[:, None] > 0, random, 0.0), weights)
    # Changes do not cancel where no path meets an unknown, such as in a dark background beside an object.
    little &= (_around(little, sizes) >= _OF_AROUND) | ~random.any(axis=1)
    if np.count_nonzero(little * weights) < _FEWEST:
        return None
    explained = [_joined(problem, [np.mean(b, axis=0) - np.mean(a, axis=0) for a, b in zip(starts, ends, strict=True)])]
    explained += [change({**result, key: changed(problem, key, x, np.ones(x.shape))}) for key, x in result.items()]
    explained += map(change, _pulled(problem, result))
    rest = _without(residuals, explained)
    if moves := any(problem.renderer.parameters()[key].rigid for key in problem.unknowns):
        little = little & _calm(rest.images.mean(axis=0), weights * little, sizes)
    rest, everywhere = replace(rest, weights=weights * little), residuals.size
    least = _LEAST * max(1.0, everywhere / max(size := rest.size, 1e-300))
    differs = misfit(rest, least)
    cause, shared, sure = _as_if(rest, residuals.halves[1] + residuals.references)
    if differs is None and sure and shared > _LEAST_OF_CAUSE * least * size:
        differs = Misfit(shared, size, math.sqrt(max(rest.mean_square - shared**2, 0.0)))
    total = math.sqrt(residuals.mean_square)
    if differs is None or (problem.has_prior and differs.share * everywhere < _MOSTLY * total):
        return None
    cause = cause if shared > _MOSTLY * differs.error else ""
    share, where = np.count_nonzero(little * weights) / np.count_nonzero(weights), ", among" if differs.place else " in"
    explanation = (
        f"{where} the {share:.0%} of its pixels that the unknowns hardly change{cause}: {_OF_POSE if moves else ''}light, depth, "
        "alignment or something else that is not among the unknowns is wrong"
    )
    return replace(differs, size=max(size, everywhere), explanation=explanation, causes=(STEPS,) if moves else ())


def _around(little: np.ndarray, sizes: Sequence[tuple[int, int]]) -> np.ndarray:
    """Return the share (N,) of the pixels around each pixel of all views, itself included, that are among some pixels (N,)."""
    from scipy.ndimage import uniform_filter  # takes long to import

    images = [little[part].reshape(size) for part, size in zip(slices_of_images(sizes), sizes, strict=True)]
    return np.concatenate([np.ravel(uniform_filter(image.astype(np.float64), _AROUND)) for image in images])


def _calm(residual: np.ndarray, weights: np.ndarray, sizes: Sequence[tuple[int, int]]) -> np.ndarray:
    """Return the pixels (N,) of all blocks but those where a residual (N, 3) is largest."""
    blocks, first = np.zeros(len(residual), np.int64), 0
    for part, (height, width) in zip(slices_of_images(sizes), sizes, strict=True):
        y, x = np.mgrid[:height, :width] // _BLOCK
        blocks[part] = first + np.ravel(y * (width // _BLOCK + 1) + x)
        first += (height // _BLOCK + 1) * (width // _BLOCK + 1)
    counts = np.bincount(blocks, weights, first)
    sums = np.stack([np.bincount(blocks, weights * channel, first) for channel in residual.T], axis=1)
    means = np.square(sums / np.maximum(counts, 1e-300)[:, None]).sum(axis=1)
    used = counts > 0
    return (means <= np.quantile(means[used], 1.0 - _ELSEWHERE))[blocks] if used.any() else used[blocks]


def beyond_priors(
    problem: Problem,
    difference: Misfit,
    values: Mapping[str, np.ndarray],
    ends: Sequence[Sequence[np.ndarray]],
    picture: Picture,
) -> Misfit:
    """Return a difference without `PRIOR` among its causes if steps against the pull of the priors explain little of it.

    Of a run whose loss may still fall, they explain little even if a prior is the cause, so nothing is judged. `ends`: see
    `unexplained_pixels`.
    """
    if PRIOR not in difference.causes or STEPS in difference.causes or len(problem.unknowns) > _MOST_KEYS:
        return difference
    views = range(len(ends))
    explained = [
        _joined(problem, [picture(moved, view) - of[0] for view, of in zip(views, ends, strict=True)])
        for moved in _pulled(problem, values)
    ]
    left = misfit(_without(Residuals.of(problem, views, ends), explained), 0.0)
    return difference if left is None or left.error < _MOSTLY * difference.error else without_prior(difference)


def _pulled(problem: Problem, values: Mapping[str, np.ndarray]) -> list[dict[str, np.ndarray]]:
    """Return values after a step against each prior, as the loss would take it without that prior."""
    moved = []
    for key, unknown in problem.unknowns.items():
        if unknown.prior is not None:
            _, slope = unknown.prior.evaluate(values[key])
            along = slope / max(float(np.abs(slope).max()), 1e-300)
            moved.append({**values, key: changed(problem, key, values[key], along)})
    return moved


def _as_if(residuals: Residuals, images: np.ndarray) -> tuple[str, float, bool]:
    """Return what a view's reference looks like, the root mean square of the difference over all pixels, and whether that proves it.

    These are "" and 0 for nothing, and "" if another distortion explains nearly as much. The residual of the first half of the images is
    fitted by changes of `images`, (N, 3), the mean of the second half, whose noise is independent of it. Rare bright samples leave most
    pixels too dark, so another brightness proves nothing, nor does a fit below the noise of a half in the same pixels.
    """
    cause, shared, sure, total = "", 0.0, False, max(float(residuals.weights.sum()) * 3, 1e-300)
    references, sizes = residuals.references, residuals.sizes
    for view, part in enumerate(slices_of_images(sizes)):
        root = np.sqrt(residuals.weights[part])[:, None]
        if np.count_nonzero(root) < _FEWEST:
            continue
        wanted, again = (np.ravel(half[part] * root) for half in residuals.halves)
        noise, best, explained = np.square(wanted - again) / 2.0, "", {}
        image, reference = (x.reshape(*sizes[view], 3) for x in (images[part], references[part]))
        most = [*distortions(image, reference).items()][:-1]  # distortion by a lens looks like another field of view
        for index, (words, changes) in enumerate(most):
            columns = np.stack([np.ravel(change.reshape(-1, 3) * root) for change in changes], axis=1)
            inverse = np.linalg.pinv(columns.T @ columns, hermitian=True)
            amounts = inverse @ (columns.T @ wanted)
            fit, pixels = columns @ amounts, columns.T.reshape(len(changes), -1, 3)
            # A bright pixel may decide the fit alone, and its residual is then smaller than the noise of its reference.
            left = scores.without_own_pixel((wanted - fit).reshape(-1, 3), pixels, pixels, inverse)
            products = columns * np.ravel(left)[:, None]
            errors = np.sqrt(np.diagonal(inverse @ (products.T @ products) @ inverse))
            squares, name = np.square(fit), words(amounts)
            explained[name] = float(wanted @ again - (wanted - fit) @ (again - fit))
            fitted = math.sqrt(float(squares.sum()) / total)
            clear = float(squares @ squares) > _OF_NOISE**2 * float(squares @ noise)
            if fitted > shared and clear and (np.abs(amounts) > _SURE * _OF_FILTER * errors).any():
                best, shared, sure = name, fitted, index > 0
        if best:
            alone = explained.pop(best) > _DISTINCT * max(explained.values())
            cause = f", {AS_IF} {view} {best}" if alone else ""
    return cause, shared, sure


def _joined(problem: Problem, pictures: Sequence[np.ndarray]) -> np.ndarray:
    pairs = zip(pictures, problem.units, strict=True)
    return np.concatenate([np.reshape(picture, (-1, 3)) * unit for picture, unit in pairs]).astype(np.float64)


def _is_little(image: np.ndarray, change: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return which pixels of an image (N, 3) a change (N, 3) leaves nearly as they are, (N,).

    Changes are relative to the pixel before or after, so highlights count no more than what a lamp lights. Pixels above the usual change
    have half of the sum of all changes.
    """
    before, after = (np.abs(x).max(axis=1) * (weights > 0) for x in (image, image + change))
    sizes = np.maximum(np.maximum(before, after), _LITTLE * float(before.mean()))
    changes = np.abs(change).max(axis=1) * (weights > 0) / np.maximum(sizes, 1e-300)
    ordered = np.sort(changes)
    usual = ordered[np.searchsorted(np.cumsum(ordered), 0.5 * float(ordered.sum()))]
    return changes <= min(_LITTLE * usual, _OF_PIXEL)


def _without(residuals: Residuals, changes: Sequence[np.ndarray]) -> Residuals:
    """Return residuals without the combination of changes (N, 3) that is closest to their mean, with coefficients of each channel."""
    roots, mean = np.sqrt(residuals.weights), residuals.images.mean(axis=0)
    closest = np.zeros_like(mean)
    for channel in range(mean.shape[1]):
        columns = np.stack([change[:, channel] for change in changes], axis=1)
        used = np.asarray(np.isfinite(columns).all(axis=1))
        columns = np.where(used[:, None], columns, 0.0)
        wanted = roots * used * mean[:, channel]
        closest[:, channel] = columns @ np.linalg.lstsq(roots[:, None] * columns, wanted, rcond=1e-8)[0]
    return replace(residuals, images=residuals.images - closest)
