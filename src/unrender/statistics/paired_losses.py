"""Tests whether two images, or an image of a control variate and a new one, differ by more than their noise."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

_TILES, _ROBUST = 48, 1.8  # maximum number of tiles of an image; maximum ratio of the sharp score to the robust one
DISTANCE = 2
"""Distance of the pixels of a pair; a reconstruction filter correlates the references' noise in adjacent pixels."""
_OF_FILTER, _OF_PRODUCTS = 0.03, 1.25
"""Correlation at a distance of 2 pixels that counts as noise, and the standard deviation of the sum of products of such pixels relative to
that of independent products. Mitsuba's default filter, a Gaussian, leaves exp(-4) = 0.018 and 1.23 to 1.31."""

_OF_NOISE, _LEVEL = 4.0, 1e-5
"""Smallest mean square of a difference in few pixels, relative to the reference's noise as the other pixels suggest it; false positive
rate of its test."""
_BESIDE, _ALONG, _LEAST_SIDE = 4, 2.0, 12
"""Number of lines of pixels, from the third on, to which a picture's outermost line is compared; score of the products along it from which
its pixels agree; fewest pixels of a side."""
_SIDE, _FEWEST, _ROUNDING = 3, 16, 2.0
"""Blocks of `in_blocks` along each axis, fewest pixels of one, and standard errors of a mean that does not count."""
_OFFSETS, _PATTERN = ((0, DISTANCE), (DISTANCE, 0), (DISTANCE, DISTANCE), (DISTANCE, -DISTANCE)), 0.25
"""Rows and columns between the pixels of `has_pattern`, and the smallest correlation that counts."""


@dataclass(frozen=True)
class Difference:
    """The second of two losses minus the first, its standard error, infinite if unknown, and its degrees of freedom (Welch and
    Satterthwaite)."""

    value: float
    standard_error: float
    degrees: float

    def exceeds_noise(self, level: float) -> bool:
        """Return whether the difference is positive, by a one-sided t-test with false positive rate `level`."""
        if math.isnan(self.value) or math.isinf(self.standard_error):
            return False
        if math.isinf(self.value):
            return self.value > 0
        return self.value > self.quantile(level) * self.standard_error

    def quantile(self, level: float) -> float:
        """Return the number of standard errors that noise exceeds with probability `level`, by the t-distribution."""
        from scipy.special import stdtrit  # takes long to import

        return -float(stdtrit(max(self.degrees, 1.0), level))


SIGNIFICANT = 4.5
"""Score of a `SystematicDifference` that noise alone hardly reaches."""


@dataclass(frozen=True)
class SystematicDifference:
    """The part of the difference of two images that neighbouring pixels share.

    Attributes:
        mean_square: unbiased estimate of its mean square per channel; may be negative.
        score: sum of the tiles' products, in units of its standard deviation. Two estimates of that deviation exist. The sharp one comes
            from the contrast within pairs of pixels. The robust one comes from the products and is large if a few tiles dominate the sum;
            it limits the score to 1.8 times the robust score. Noise that is independent between pixels scores above 4.5 with probability
            below 1/10,000, even with heavy tails.
    """

    mean_square: float
    score: float


def pseudo_values(losses: np.ndarray, left_out: np.ndarray) -> np.ndarray:
    """Return the jackknife pseudo-values (K, N) of N losses at the mean of K images, (N,), and with each image left out, (K, N).

    Their mean over K is the loss without the bias from image noise: exactly for a quadratic loss, to second order otherwise.
    """
    count = len(left_out)
    return count * losses - (count - 1) * left_out


def mean_and_error(pseudo: np.ndarray) -> tuple[float, float]:
    """Return the sum of N losses from pseudo-values (K, N), and its standard error from their spread over K."""
    total = difference(np.zeros_like(pseudo), pseudo)
    return total.value, total.standard_error


def difference(first: np.ndarray, second: np.ndarray, sampled: bool = False) -> Difference:
    """Return the sum of the second losses minus that of the first, from pseudo-values (K, N) on equal random numbers.

    Args:
        first, second: pseudo-values of N independent parts of a loss, (K, N).
        sampled: whether the N parts are a random sample from many. The standard error then comes from the spread over all parts,
            otherwise from the spread of each part over its K pseudo-values.
    """
    with np.errstate(invalid="ignore", over="ignore"):
        changes = second - first
        groups, parts = changes.shape
        mean = changes.mean(axis=0)
        value = float(mean.sum())
        if sampled:
            if parts < 2:
                return Difference(value, math.inf, 1.0)
            return Difference(value, math.sqrt(parts * float(mean.var(ddof=1))), parts - 1.0)
        variances = changes.var(axis=0, ddof=1) / groups
        total, largest = float(variances.sum()), float(variances.max(initial=0.0))
    if not math.isfinite(total):
        return Difference(value, math.inf, 1.0)
    shares = variances / largest if largest > 0 else variances
    degrees = float(shares.sum() ** 2 / (shares**2).sum()) * (groups - 1) if largest > 0 else math.inf
    return Difference(value, math.sqrt(total), degrees)


def mean_square(values: np.ndarray, weights: np.ndarray) -> float:
    """Return the mean square per channel of values (N, C), with a weight per pixel (N,)."""
    total = float((weights[:, None] * np.square(values, dtype=np.float64)).sum())
    return total / max(float(weights.sum()) * values.shape[1], 1e-300)


def slices_of_images(sizes: Sequence[tuple[int, int]]) -> list[slice]:
    """Return the slice of each image, of height and width, in an array of the pixels of all."""
    ends = np.cumsum([height * width for height, width in sizes], dtype=np.int64).tolist()
    return [slice(end - height * width, end) for end, (height, width) in zip(ends, sizes, strict=True)]


def repeated(one: np.ndarray, other: np.ndarray, weights: np.ndarray) -> SystematicDifference:
    """Return the part of two pictures' differences (K, N, C) from one reference that both share, pixel by pixel, with weights (N,) in [0,
    1].

    For pictures of few pixels, of which `systematic` makes too few tiles. Noise of the reference is shared too, and counts.
    """
    means, errors = [], []
    for images in (one, other):
        means.append(images.mean(axis=0) * weights[:, None])
        errors.append(images.std(axis=0, ddof=1) / math.sqrt(len(images)) * weights[:, None])
    products = (means[0] * means[1]).sum(axis=1)
    noise = float(np.sqrt(((errors[0] * errors[1]).sum(axis=1) ** 2).sum()))
    total, count = float(products.sum()), max(float(weights.sum()) * one.shape[2], 1e-300)
    return SystematicDifference(total / count, total / noise if noise > 0 else math.inf * np.sign(total))


def concentrated(
    one: np.ndarray, other: np.ndarray, weights: np.ndarray, sizes: Sequence[tuple[int, int]] = ()
) -> SystematicDifference:
    """Return the part of two pictures' differences from one reference that both share, if few pixels hold it; a score of 0 otherwise.

    A misplaced reflection or highlight changes its sign from pixel to pixel, which `systematic` and `nearby` miss. Noise of the reference
    is shared as well. Its variance is taken to be proportional to that of the pictures, with the median ratio of tiles of pixels; only four
    times as much counts. A pixel where the picture is too dark does not count if neither a pixel is too bright by as much, nor two at a
    distance of 2 are too dark by half as much, since it may be an outlier of the reference. Nor does the largest pixel of the rest.

    Args:
        one, other: differences of two independent pictures, (N, C).
        weights: (N,), how much each pixel counts, in [0, 1].
        sizes: see `nearby`; () if neighbours are unknown.
    """
    one, other = (np.asarray(of, np.float64) * weights[:, None] for of in (one, other))
    brighter, products = (one + other).sum(axis=1), (one * other).sum(axis=1)
    most = products[brighter > 0].max(initial=0.0)
    counted = (brighter > 0) | (products <= most) | _shared_with_neighbours(brighter, sizes)
    one, other, products = one * counted[:, None], other * counted[:, None], products * counted
    variances = np.square(one - other).sum(axis=1) / 2
    starts = np.linspace(0, len(one), min(len(one), _TILES), endpoint=False).astype(np.int64)
    shared, noise = (np.maximum(np.add.reduceat(of, starts), 1e-300) for of in (products, variances))
    total = float(products.sum() - products.max(initial=0.0))
    if not total > _OF_NOISE * float(np.median(shared / noise)) * float(variances.sum()):
        return SystematicDifference(0.0, 0.0)
    error = math.sqrt(float(np.square((one**2 - other**2).sum(axis=1)).sum())) / 2
    square = float(products.sum()) / max(float(weights.sum()) * one.shape[1], 1e-300)
    # Two pictures tell the noise of a pixel with one degree of freedom.
    needed = Difference(1.0, 1.0, float(products.sum() ** 2 / np.square(products).sum())).quantile(_LEVEL)
    return SystematicDifference(square, SIGNIFICANT * total / (needed * error) if error > 0 else math.inf)


def has_pattern(one: np.ndarray, other: np.ndarray, weights: np.ndarray, sizes: Sequence[tuple[int, int]]) -> bool:
    """Return whether the difference that two pictures share correlates at a distance of 2, along an axis or a diagonal.

    The references' noise does not. The score of `nearby` misses a texture that is seen in the wrong place, since its sign alternates.

    Args:
        one, other: differences of two independent pictures from one reference, (N, C).
        weights, sizes: see `nearby`.
    """
    one, other = (np.asarray(of, np.float64) * weights[:, None] for of in (one, other))
    least = _PATTERN * float((one * other).sum())
    for down, right in _OFFSETS:
        total = squares = 0.0
        for part, (height, width) in zip(slices_of_images(sizes), sizes, strict=True):
            a, b = (of[part].reshape(height, width, -1)[:, :: -1 if right < 0 else 1] for of in (one, other))
            products = (a[down:, abs(right) :] * b[: height - down, : width - abs(right)]).sum(axis=2)
            total, squares = total + float(products.sum()), squares + float(np.square(products).sum())
        if abs(total) > max(least, SIGNIFICANT * _OF_PRODUCTS * math.sqrt(squares)):
            return True
    return False


def at_border(
    one: np.ndarray, other: np.ndarray, weights: np.ndarray, sizes: Sequence[tuple[int, int]]
) -> tuple[SystematicDifference, str]:
    """Return the part of two pictures' differences from one reference that both share in an outermost line of pixels, and which line it is.

    A frame or padding of the reference leaves such a difference, as does a shift that wraps around. It is too small a part of the picture
    for `nearby`. Its products at a distance of 2 must agree along the line. Their sum must be four times the sum of squares of each line
    beside it, and of the reference's noise in the line, as those lines and the pictures' noise suggest it, and exceed the pictures'
    noise in the line. Otherwise the score is 0.

    Args:
        one, other: differences of two independent pictures, (N, C).
        weights, sizes: see `nearby`.
    """
    one, other = (np.asarray(of, np.float64) * weights[:, None] for of in (one, other))
    most, place = 0.0, ""
    for part, size in zip(slices_of_images(sizes), sizes, strict=True):
        for axis, names in enumerate((("top row", "bottom row"), ("left column", "right column"))):
            for name, turned in zip(names, (slice(None), slice(None, None, -1)), strict=True):
                a, b = (of[part].reshape(*size, -1).swapaxes(0, axis)[turned] for of in (one, other))
                if min(size) < _LEAST_SIDE:
                    continue
                lines = [0, *range(DISTANCE, DISTANCE + _BESIDE)]
                shared, noise = (x[lines].sum(axis=(1, 2)) for x in (a * b, np.square(a - b) / 2))
                along = 0.5 * (a[0, :-DISTANCE] * b[0, DISTANCE:] + b[0, :-DISTANCE] * a[0, DISTANCE:]).sum(axis=1)
                total, deviation = float(along.sum()), _OF_PRODUCTS * math.sqrt(float(np.square(along).sum()))
                expected = float(np.median(shared[1:] / np.maximum(noise[1:], 1e-300)) * noise[0])
                beyond = total > max(_OF_NOISE * max(float(shared[1:].max()), expected), float(noise[0]))
                if beyond and total > _ALONG * deviation and shared[0] > most:
                    most, place = float(shared[0]), f" in its {name} of pixels"
    square = most / max(float(weights.sum()) * one.shape[1], 1e-300)
    return SystematicDifference(square, math.inf if most else 0.0), place


def systematic(
    values: np.ndarray,
    weights: np.ndarray | None = None,
    earlier: np.ndarray | None = None,
    layout: tuple[int, int] = (1, 0),
) -> SystematicDifference:
    """Estimate the part of the differences that neighbouring pixels share.

    Each tile is divided into two interleaved halves with independent noise, so the noise in the product of their means has expectation
    zero. A difference that changes its sign within tiles is missed; see `nearby`.

    Args:
        values: differences of pixels, (N, C), in an order that mostly keeps neighbours in the image adjacent.
        weights: weight of each pixel, (N,), in [0, 1]; None for equal weights.
        earlier: the same at an earlier step, (N, C). The second halves are taken from it, which excludes what changes between the steps.
            None takes them from `values`.
        layout: number of consecutive pixels that alternate between the halves, and how many of these are left out. Noise of references
            with a reconstruction filter is correlated between adjacent pixels, but hardly at a distance of 2.
    """
    block, gap = layout
    count = len(values) // (2 * block) * 2 * block
    weight = np.ones(len(values)) if weights is None else np.asarray(weights, np.float64)

    def halves_of(array: np.ndarray) -> np.ndarray:
        columns = array.shape[1]
        parts = array[:count].reshape(-1, 2, block, columns)[:, :, : block - gap]
        return parts.swapaxes(1, 2).reshape(-1, 2, columns)

    used = halves_of(weight[:, None])[..., 0].min(axis=1) > 0

    def paired(differences: np.ndarray) -> np.ndarray:
        return halves_of(np.asarray(differences, np.float64) * weight[:, None])[used]

    pairs = paired(values)
    if earlier is not None:
        pairs = np.stack([pairs[:, 0], paired(earlier)[:, 1]], axis=1)
    if len(pairs) == 0:
        return SystematicDifference(0.0, 0.0)
    starts = np.linspace(0, len(pairs), min(len(pairs), _TILES), endpoint=False).astype(np.int64)
    sizes = np.diff([*starts, len(pairs)])[:, None]
    halves = np.add.reduceat(pairs, starts, axis=0) / sizes[..., None]
    products = (halves[:, 0] * halves[:, 1] * sizes).sum(axis=1)
    square = float(products.sum() / (sizes.sum() * values.shape[1]))
    contrast = (np.add.reduceat((pairs[:, 0] - pairs[:, 1]) ** 2 / 2, starts, axis=0) / sizes).sum(axis=1)
    sharp, robust = (float(np.sqrt((parts**2).sum())) for parts in (contrast, products))
    if not (sharp > 0 and robust > 0):
        return SystematicDifference(square, math.inf if square > 0 else 0.0)
    total = float(products.sum())
    return SystematicDifference(square, min(total / sharp, _ROBUST * total / robust))


def in_blocks(
    values: np.ndarray, counted: np.ndarray, sizes: Sequence[tuple[int, int]], least: float
) -> SystematicDifference:
    """Return the part of differences that the pixels of a block share, for nine blocks of each image: smooth differences far below a
    pixel's noise.

    The mean of a block is divided by its standard error from the scatter of its pixels, which correlations of adjacent ones increase. The
    sum of the squares has the χ²-distribution if all is noise; the score is its normal deviate (Wilson and Hilferty 1931). Blocks that rare
    bright samples miss have too little scatter, so the squares of all means must exceed those of all standard errors as clearly.

    Args:
        values: differences, (N, C), with noise that is independent of pixels further apart than adjacent ones.
        counted: pixels that count, (N,).
        sizes: (height, width) of the images.
        least: mean of a block that does not count, since rounding is no noise: above 0.
    """
    squares, means, variances, along, total = [], [], [], np.zeros(2), 0.0
    for part, size in zip(slices_of_images(sizes), sizes, strict=True):
        image, used = values[part].reshape(*size, -1), counted[part].reshape(size)
        rows, columns = (np.linspace(0, side, _SIDE + 1).astype(int) for side in size)
        for row, column in np.ndindex(_SIDE, _SIDE):
            place = slice(rows[row], rows[row + 1]), slice(columns[column], columns[column + 1])
            here, count = used[place], np.count_nonzero(used[place])
            if count < _FEWEST:
                continue
            mean = image[place][here].mean(axis=0)
            rest = np.where(here[..., None], image[place] - mean, 0.0)
            variance = np.square(rest).sum(axis=(0, 1)) / (count * (count - 1))
            total += float(np.square(rest).sum())
            along += [float((rest[1:] * rest[:-1]).sum()), float((rest[:, 1:] * rest[:, :-1]).sum())]
            squares.append(float(np.mean(np.square(mean) / np.maximum(variance, (least / _ROUNDING) ** 2))))
            means.append(float(np.mean(np.square(mean))))
            variances.append(float(np.mean(variance)))
    if not squares:
        return SystematicDifference(0.0, 0.0)
    wider = float(np.prod(1.0 + 2.0 * np.maximum(along / max(total, 1e-300), 0.0)))
    together = sum(means) / max(sum(variances), len(variances) * (least / _ROUNDING) ** 2)
    spread, ratio = 2.0 / (9.0 * len(squares)), min(float(np.mean(squares)), together) / wider
    score = (ratio ** (1.0 / 3.0) - 1.0 + spread) / math.sqrt(spread)
    return SystematicDifference(float(np.mean(means) - wider * np.mean(variances)), score)


def nearby(
    values: np.ndarray,
    weights: np.ndarray,
    sizes: Sequence[tuple[int, int]],
    axes: Sequence[int],
    earlier: np.ndarray | None = None,
) -> SystematicDifference:
    """Estimate the part of the differences that pixels at a distance of 2 share, such as differences along edges.

    Noise of references with a reconstruction filter has a correlation at a distance of 2. The score is therefore that of the products of
    two pixels minus 3 % of the product at the first one: their sum divided by its standard deviation, which correlations of adjacent pixels
    increase.

    Args:
        values, weights, earlier: see `systematic`.
        sizes: (height, width) of the images, whose pixels follow each other row by row. () for a sample of pairs: two pairs of consecutive
            pixels each, the first in a row, the second in a column.
        axes: 0 for pairs in columns, 1 for those in rows.
    """
    other = values if earlier is None else earlier
    one, two = (np.asarray(of, np.float64) * weights[:, None] for of in (values, other))

    def pairs(array: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
        return [pair for axis in axes for pair in _pairs(array, sizes, axis)]

    total = squares = shared = counted = 0.0
    for (here, _), (same, there), (weight, partner) in zip(
        pairs(one), pairs(two), pairs(weights[:, None]), strict=True
    ):
        products = (here * there).sum(axis=-1)
        beyond = products - _OF_FILTER * (here * same).sum(axis=-1)
        total, squares = total + float(beyond.sum()), squares + float(np.square(beyond).sum())
        shared, counted = shared + float(products.sum()), counted + float((weight * partner).sum())
    deviation, channels = _OF_PRODUCTS * math.sqrt(squares), values.shape[1]
    return SystematicDifference(shared / max(counted * channels, 1e-300), total / deviation if deviation > 0 else 0.0)


def _shared_with_neighbours(values: np.ndarray, sizes: Sequence[tuple[int, int]]) -> np.ndarray:
    """Return the pixels (N,) of which two at a distance of 2 have at least half the value (N,), with the same sign."""
    shared = np.zeros(len(values), np.int64)
    for part, size in zip(slices_of_images(sizes), sizes, strict=True):
        image, found = (of[part].reshape(size) for of in (values, shared))
        for axis in (0, 1):
            here, there = (of.swapaxes(0, axis) for of in (image, found))
            for one, other in ((slice(DISTANCE, None), slice(-DISTANCE)), (slice(-DISTANCE), slice(DISTANCE, None))):
                there[one] += here[one] * here[other] >= 0.5 * np.square(here[one])
    return (shared > 1) & (values != 0)


def _pairs(values: np.ndarray, sizes: Sequence[tuple[int, int]], axis: int) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return the first and the second pixels of the pairs of each image, (..., C)."""
    if not sizes:
        pairs = values[: len(values) // 4 * 4].reshape(-1, 2, 2, values.shape[1])[:, 1 - axis]
        return [(pairs[:, 0], pairs[:, 1])]
    parts = zip(slices_of_images(sizes), sizes, strict=True)
    images = [values[part].reshape(*size, -1).swapaxes(0, axis) for part, size in parts]
    return [(image[:-DISTANCE], image[DISTANCE:]) for image in images]
