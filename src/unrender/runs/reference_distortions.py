"""Distortions of references, such as shifts and turns, and those that the residual of a fit looks like."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np

from unrender.core.text import listed
from unrender.display import formatting
from unrender.rendering.picture_format import format_of
from unrender.runs.verification import STEPS
from unrender.statistics import scores
from unrender.statistics.paired_losses import slices_of_images

if TYPE_CHECKING:
    from unrender.runs.numbers import Numbers
    from unrender.runs.verification import Misfit
    from unrender.scene.problem import Problem

AS_IF = "as if the reference of view"
"""Words before a view and what its reference looks like."""
_EQUAL, _PLATEAU = 1e-3, 16
"""Relative difference of values that count as equal, and fewest values equal to the largest of a reference that is saturated."""
_SMOOTH, _SURE, _OWN, _LEAST_SIDE = 0.7, 4.5, 0.05, 8
"""Standard deviation in pixels of the filter of images whose slopes are taken; standard errors of an amount from which a distortion is
seen, since at the ends of 16 runs of right scenes all 95 amounts were below 2.5; share of its change of the picture that the unknowns must
leave; fewest pixels of the shorter side of a picture."""
_ORIENTATIONS = {
    "mirrored left to right": lambda x: x[:, ::-1],
    "upside down": lambda x: x[::-1],
    "turned by 180°": lambda x: x[::-1, ::-1],
    "turned by 90° counterclockwise": lambda x: np.rot90(x, -1),
    "turned by 90° clockwise": np.rot90,
    "mirrored along a diagonal": lambda x: x.swapaxes(0, 1),
    "mirrored along the other diagonal": lambda x: x[::-1, ::-1].swapaxes(0, 1),
}
"""Errors of orientation of a reference, and for each the function that corrects its image."""
_BETTER, _CLEARLY, _MOST_VIEWS, _SIDE = 0.5, 0.1, 32, 64
"""Share of the contrast that another reference may leave, relative to that which the view's own one leaves, and least difference of both
shares. Of 1160 comparisons at the starts of right scenes, the least share was 0.87 and the largest difference 0.09 where no unknown moves
what is seen. Most views whose references are compared with each other; most pixels of a side of the compared images."""
_MOSTLY, _BRIGHTER, _UNEQUAL = 0.5, 0.15, 0.05
"""Share of the squares of a residual from which a distortion that explains them is named; least relative change of brightness, and least
relative difference between views. Factors of views explained 0.49 and 0.83 in 2 of 10 wrong scenes, and differed by at most 0.016 there."""


def distortions(image: np.ndarray, reference: np.ndarray) -> dict[Callable[[np.ndarray], str], list[np.ndarray]]:
    """Return changes of an image (H, W, 3), in units of a pixel where they move it, by functions that name amounts: brightness first,
    distortion by a lens last. A picture of few pixels along a side has none.

    Its reference (H, W, 3) may be saturated only where many of its values equal the largest: noise exceeds a single brightest value.
    """
    from scipy.ndimage import gaussian_filter  # takes long to import

    if min(image.shape[:2]) < _LEAST_SIDE:
        return {}
    down, along = np.gradient(image, axis=(0, 1))
    # Slopes of noise hide distortion by a lens, most of which a field of view explains. Smooth ones tell as much as four times the samples.
    smooth_down, smooth_along = np.gradient(gaussian_filter(image, (_SMOOTH, _SMOOTH, 0.0)), axis=(0, 1))
    height, width = image.shape[:2]
    y, x = np.mgrid[:height, :width] - np.array([height - 1, width - 1]).reshape(2, 1, 1) / 2
    squares = 4.0 * (x**2 + y**2) / (height**2 + width**2)
    white = float(reference.max())
    equal = reference >= (1.0 - _EQUAL) * white
    saturated = (equal & (np.count_nonzero(equal) >= _PLATEAU)) * (np.minimum(image, white) - image)
    return {
        lambda by: f"were {formatting.number(max(round(1.0 - by[0], 2), 0.0))} times as bright": [image],
        lambda by: f"were shifted by {-by[0]:.2g} pixels along x and {-by[1]:.2g} along y": [-along, -down],
        lambda by: "were blurred" if by[0] < 0.0 else "were sharper": [gaussian_filter(image, (1.0, 1.0, 0.0)) - image],
        lambda by: f"were saturated at {white:.3g} (set the loss Censored)": [saturated],
        lambda by: "had another field of view": [x[..., None] * along + y[..., None] * down],
        lambda by: (
            f"were turned by {abs(math.degrees(by[0])):.2g}° {'counterclockwise' if by[0] < 0.0 else 'clockwise'}"
        ): [x[..., None] * down - y[..., None] * along],
        lambda by: "were distorted by a lens": [
            (squares * x)[..., None] * smooth_along + (squares * y)[..., None] * smooth_down
        ],
    }


def distortions_of_fit(
    numbers: Numbers, residuals: np.ndarray, after: np.ndarray, slopes: np.ndarray, inverse: np.ndarray
) -> list[tuple[str, np.ndarray]]:
    """Return which references look distorted after a least-squares fit, and the changes of the solution with each, (K,), of those that
    explain most first.

    Each distortion of a view is fitted together with the K directions of the fit. One that explains less than half of its view's residual
    has no name. Small changes of brightness are left out, since rare bright samples cause them. The distorted pictures have other noise
    than the residuals to which they are fitted.

    Args:
        residuals, after: two independent residuals before and after the step of the fit, (2, P, 3), with the roots of the pixels' weights.
        slopes: changes of the pictures along the directions, (K, P, 3); 0 where noise hides them.
        inverse: (JᵀJ)⁻¹ of the directions, (K, K).
    """
    found: list[tuple[float, str, np.ndarray]] = []
    mean = after.mean(axis=0)
    sizes = [numbers.problem.sizes[view] for view in numbers.views]
    for view, part, size in zip(numbers.views, slices_of_images(sizes), sizes, strict=True):
        reference, roots = np.asarray(numbers.problem.views[view].reference, np.float64), numbers.roots(view)
        images = (residuals[:, part] / np.where(roots > 0.0, roots, math.inf)).reshape(2, *size, 3) + reference
        halves = [list(distortions(image, reference).items()) for image in images]
        for index, ((describe, one), (_, other)) in enumerate(zip(*halves, strict=True)):
            both = [np.reshape(change, (len(change), -1, 3)) * roots for change in (one, other)]
            own = 0.5 * (both[0] + both[1])
            shared = np.tensordot(slopes[:, part], own, axes=((1, 2), (1, 2)))
            gains, squares = inverse @ shared, np.tensordot(*both, axes=((1, 2), (1, 2)))
            matrix = 0.5 * (squares + squares.T) - shared.T @ gains
            if not np.linalg.eigvalsh(matrix)[0] > _OWN * float(np.diag(squares).max()):
                continue
            # The part of the distortion that no direction explains, (k, P, 3), and its product with the residuals.
            rest = np.tensordot(-gains.T, slopes, axes=1)
            product = np.tensordot(rest, mean, axes=2)
            product += 0.5 * sum(np.tensordot(both[half], after[1 - half, part], axes=2) for half in (0, 1))
            rest[:, part] += own
            amounts = np.linalg.solve(matrix, product)
            left = scores.without_own_pixel(
                mean - np.tensordot(amounts, rest, axes=1), rest, rest, np.linalg.inv(matrix)
            )
            middle = np.zeros_like(matrix)
            for change, residual in zip(numbers.by_view(rest), numbers.by_view(left[None]), strict=True):
                score = (change * residual).sum(axis=3)
                middle += scores.covariance(score, score)
            errors = np.sqrt(np.maximum(np.diag(np.linalg.solve(matrix, np.linalg.solve(matrix, middle).T)), 0.0))
            explained = float(amounts @ matrix @ amounts)
            named = explained > _MOSTLY * float((after[0, part] * after[1, part]).sum())
            allowed = index > 0 or (named and abs(amounts[0]) > _BRIGHTER)
            if allowed and explained > 0.0 and (np.abs(amounts) > _SURE * errors).any():
                words = f"{AS_IF} {view} {describe(amounts)}" if named else "by what the unknowns do not explain"
                found.append((explained, words, gains @ amounts))
    return [(words, moves) for _, words, moves in sorted(found, key=lambda each: -each[0])]


def of_references(
    problem: Problem,
    views: Sequence[int],
    starts: Sequence[Sequence[np.ndarray]],
    ends: Sequence[Sequence[np.ndarray]],
    differences: Sequence[Misfit | None],
) -> str:
    """Return what the references look like, see `misplaced` and, unless more steps may explain the known differences of the pictures from
    them or they are already explained, `unequal_brightness`; "" for nothing."""
    sure = any(of and STEPS not in of.causes and AS_IF not in of.line for of in differences)
    return misplaced(problem, views, starts, ends) or (unequal_brightness(problem, views, ends) if sure else "")


def misplaced(
    problem: Problem, views: Sequence[int], starts: Sequence[Sequence[np.ndarray]], ends: Sequence[Sequence[np.ndarray]]
) -> str:
    """Return words about views of which another orientation of the reference, or the reference of another view, fits the pictures far
    better; "" for none, and where unknowns move what the pictures show. Brightness and offset of each channel are free.

    The pictures (H, W, 3) of the start tell, since unknowns may have fitted wrong references; those of the end must still differ.
    """
    known = problem.renderer.parameters()
    if not all(known[key].brightness or known[key].scattering for key in problem.unknowns):
        return ""
    references = [np.asarray(problem.views[view].reference) for view in views]
    found: dict[str, list[int]] = {}
    for view, start, end, own in zip(views, starts, ends, references, strict=True):
        weights = problem.test_weights(view, end)
        # Noise of fewer pixels resembles another orientation by chance.
        if np.count_nonzero(_thinned(weights)) < _LEAST_SIDE**2:
            continue
        others = {f"were {words}": undo(own) for words, undo in _ORIENTATIONS.items()}
        if len(views) <= _MOST_VIEWS:
            others |= {f"were that of view {v}": x for v, x in zip(views, references, strict=True) if v != view}
        left, after = (_unexplained(np.mean(images, axis=0), weights, own) for images in (start, end))
        image = np.mean(start, axis=0)
        shares = {words: _unexplained(image, weights, x) for words, x in others.items() if x.shape == own.shape}
        words = min(shares, key=lambda words: shares[words], default="")
        if words and after > _CLEARLY and shares[words] < min(_BETTER * left, left - _CLEARLY):
            found.setdefault(words, []).append(view)
    return " and ".join(
        f"{AS_IF}{'s' * (len(of) > 1)} {listed([*map(str, of)])} {words}" for words, of in found.items()
    )


def unequal_brightness(problem: Problem, views: Sequence[int], ends: Sequence[Sequence[np.ndarray]]) -> str:
    """Return words about the views of the darkest and the brightest reference relative to their pictures, as exposures that differ cause
    them; "" unless one factor for each view explains most of the difference, and both halves of the pictures of the end tell the same.
    Views of AOVs have no brightness, and black references no exposure.
    """
    factors: dict[int, list[float]] = {}
    explained, total = 0.0, 0.0
    for view, images in zip(views, ends, strict=True):
        if format_of(problem.renderer, problem.views[view].sensor).aov or len(images) < 2:
            continue
        one, other = np.mean(images[0::2], axis=0), np.mean(images[1::2], axis=0)
        reference = np.asarray(problem.views[view].reference, np.float64)
        weights = problem.test_weights(view, images)[..., None] * np.isfinite(one + other)
        one, other, reference = (np.where(weights > 0.0, x, 0.0) for x in (one, other, reference))
        square = max(float((weights * one * other).sum()), 1e-300)
        products = [float((weights * reference * half).sum()) for half in (one, other)]
        factors[view] = [max(product, 0.0) / square for product in products]
        explained += (sum(products) / 2 - square) ** 2 / square
        total += float((weights * (reference - one) * (reference - other)).sum())
    if len(factors) < 2 or not explained > _MOSTLY * total:
        return ""
    dark, bright = (one_of(factors, key=lambda view: sum(factors[view])) for one_of in (min, max))
    if not min(factors[bright]) > (1.0 + _UNEQUAL) * max(factors[dark]) > 0.0:
        return ""
    times = formatting.number(round(sum(factors[bright]) / sum(factors[dark]), 2))
    return f"{AS_IF} {bright} were {times} times as bright as that of view {dark}"


def _unexplained(image: np.ndarray, weights: np.ndarray, reference: np.ndarray) -> float:
    """Return the share of the variance of an image (H, W, 3) that a reference leaves, with the best factor and offset of each channel."""
    x, y, w = (_thinned(of).astype(np.float64) for of in (image, reference, weights[..., None]))
    w = w * np.isfinite(x + y).all(axis=2, keepdims=True)
    x, y = (np.where(w > 0.0, of, 0.0) for of in (x, y))
    x, y = (of - (w * of).sum(axis=(0, 1)) / max(float(w.sum()), 1e-300) for of in (x, y))
    total, both, squares = ((w * of).sum(axis=(0, 1)) for of in (x * x, x * y, y * y))
    explained = np.maximum(both, 0.0) ** 2 / np.maximum(squares, 1e-300)
    return 1.0 - float(explained.sum()) / max(float(total.sum()), 1e-300)


def _thinned(image: np.ndarray) -> np.ndarray:
    """Return every pixel of a small image, and every few of a larger one."""
    step = max(1, -(-max(image.shape[:2]) // _SIDE))
    return image[::step, ::step]
