"""Products of derivative images over pixels, from two independent halves, for Gauss-Newton matrices."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from unrender.core.arrays import Array
from unrender.statistics import scores

MOST_AVERAGED = 1 << 19
"""Largest number of pixels, times elements for derivative images, of images that are averaged over steps. Both halves take 12 MiB."""
_RESIDUAL_ERRORS = 2.0  # standard errors of the sum of squared residuals from which on references have noise
_VALUES = 1 << 22  # maximum number of image values that are converted to double precision at once
_MEMORY, _CHANNEL_MEMORY = 0.3, 0.1
"""Weight of the latest image in the running mean of the variance of a pixel, and of one of its channels, which has more noise itself."""
LAUNCH = 1 << 13
"""Time of starting a render, in that of paths: 4,000 to 19,000 on two cores, for four scenes of `suite.numbers`."""
_WEAK, _LONGEST, _MOST_WEAK = 0.1, 4.0, 16
"""Eigenvalue, relative to the mean one, below which a direction is weak; length of its differences in widths; most weak directions."""
_GROWTH = 1.0  # weights of derivative images in their mean grow as this power of their number


@dataclass(frozen=True)
class HalvedImage:
    """Image of a view, (H, W, 3): the mean of two independent halves of the samples, the variance of its noise, and the halves."""

    mean: Array
    variance: Array
    one: Array
    other: Array


@dataclass(frozen=True)
class LossWeights:
    """Derivatives ℓ' and ℓ'' of the loss by the pixels at the image, and ℓ' at two independent halves of it, (H, W, 3) each."""

    first: np.ndarray
    second: np.ndarray
    one: np.ndarray
    other: np.ndarray

    def times(self, factor: np.ndarray) -> LossWeights:
        """Return the weights times a factor per pixel (H, W, 1), or per channel (H, W, 3)."""
        return LossWeights(self.first * factor, self.second * factor, self.one * factor, self.other * factor)


def next_weight(count: float, moved: float) -> tuple[float, float]:
    """Return the weight of one more image in a mean of `count` images, and the next count, see `HalvesMean.and_one`."""
    usual = (1.0 + _GROWTH) / (count + 1.0 + _GROWTH)
    weight = max(usual, moved * moved / (1.0 + moved * moved))
    return weight, (1.0 + _GROWTH) * (1.0 / weight - 1.0) + 1.0


@dataclass(frozen=True)
class HalvesMean:
    """Weighted mean of images of a view over steps, in two independent halves.

    Derivative images: the gradient Jᵀ r has the noise of r times J, and that of r times the noise of J. The mean makes the second one
    small for elements that hardly change the picture. It adds no bias, since r is of images that are independent of J.

    Derivatives of the loss: their mean has less of the renderings' noise, so that the references' noise shows.

    Attributes:
        one, other: halves, (m, H, W, 3) or (H, W, 3).
        count: number of images, reduced by long steps.
    """

    one: np.ndarray
    other: np.ndarray
    count: float = 1.0

    def is_finite(self) -> bool:
        """Return whether all values are finite."""
        return bool(np.isfinite(self.one).all() and np.isfinite(self.other).all())

    def and_one(self, new: HalvesMean, moved: float) -> HalvesMean:
        """Return the mean with one more image, if it is finite, after a step of length `moved` in units of the differences' widths."""
        if not new.is_finite():
            return self
        if not self.is_finite():
            return new
        weight, count = next_weight(self.count, moved)
        one, other = (
            (a + np.float32(weight) * (b - a)).astype(np.float32)
            for a, b in ((self.one, new.one), (self.other, new.other))
        )
        return HalvesMean(one, other, count)

    def shared(self) -> tuple[float, float]:
        """Return the sum of squares of images (H, W, 3) without noise, and its variance.

        For halves s + a and s + b, a − b and the mean are independent if noise is Gaussian. The square of their product has the variance of
        the product of both halves as its mean. Channels share their noise.
        """
        one, other = self.one.astype(np.float64), self.other.astype(np.float64)
        terms = (0.5 * (one + other) * (one - other)).sum(axis=-1)
        return float((one * other).sum()), float(np.square(terms).sum())

    def plus(self, change: np.ndarray) -> HalvesMean:
        return replace(self, one=(self.one + change).astype(np.float32), other=(self.other + change).astype(np.float32))


@dataclass
class Products:
    """Sums over pixels and channels, for m elements.

    Attributes:
        gradient: Σ J ℓ', (m,).
        hessian: Σ J ℓ'' Jᵀ, (m, m).
        noise: Σ N ℓ'' Nᵀ with the noise N of the mean of the halves, (m, m).
        gradient_noise: covariance of Σ J ℓ' from the noise of images and derivative images, (m, m).
        scores: covariance of Σ J ℓ' from the references' noise, (m, m), see `statistics.scores`.
        squares: diagonal of Σ J Jᵀ, (m,).
    """

    gradient: np.ndarray
    hessian: np.ndarray
    noise: np.ndarray
    gradient_noise: np.ndarray
    scores: np.ndarray
    squares: np.ndarray

    @classmethod
    def zero(cls, m: int) -> Products:
        """Return sums of 0."""
        return cls(np.zeros(m), *(np.zeros((m, m)) for _ in range(4)), squares=np.zeros(m))

    def add(self, other: Products, elements: np.ndarray) -> None:
        """Add sums of some elements, given by their indices."""
        for name, values in vars(other).items():
            vars(self)[name][elements if values.ndim == 1 else np.ix_(elements, elements)] += values


def noise_weights(variance: np.ndarray, limit: float) -> np.ndarray:
    """Return the weight 1 / (1 + σ² / (c m)) of each pixel or channel, c = `limit`, m the median variance above 0; 1 without noise."""
    noisy = variance[variance > 0.0]
    return 1.0 / (1.0 + variance / (limit * float(np.median(noisy)))) if noisy.size else np.ones_like(variance)


def running_mean(before: tuple[np.ndarray, ...], view: int, variance: np.ndarray, by_channel: bool) -> np.ndarray:
    """Return the running mean of a view's variance, (H, W, 3) by channel or (H, W, 1), from those of all views and a new one (H, W, 3)."""
    new = variance.astype(np.float64)
    new = new if by_channel else new.mean(axis=-1, keepdims=True)
    return before[view] + (_CHANNEL_MEMORY if by_channel else _MEMORY) * (new - before[view]) if before else new


def needs_derivatives(noise: float, images: float, derivatives: float, image: int, derivative: int) -> bool:
    """Return whether another derivative image reduces the error more than images for the same time would.

    With N images and K derivative images the variance is proportional to (1 + ν / K) / N. The time that a derivative image takes reduces
    it by ν / K² or, with images, by c / N, for the ratio c of the two times.

    Args:
        noise: noise of the mean derivative images relative to the derivatives, ν / K.
        images, derivatives: effective numbers of both, N and K.
        image, derivative: time of an image, and of all renders of differences, see `cost`.
    """
    return noise * images * image > derivatives * derivative


def cost(paths: int, renders: int) -> int:
    """Return the time that some renders take, in that of paths."""
    return paths + renders * LAUNCH


def mean_residuals(
    before: HalvesMean | None, weights: LossWeights, derivatives: HalvesMean, step: np.ndarray, moved: float
) -> HalvesMean:
    """Return the mean of ℓ' over steps, (H, W, 3), at the present parameters.

    ℓ'' J s of the last step s (m,), of length `moved` in widths of the differences, is added to earlier residuals. Otherwise the descent's
    own change would count as noise of the references.
    """
    now = HalvesMean(weights.one.astype(np.float32), weights.other.astype(np.float32))
    if before is None:
        return now
    slopes = 0.5 * (derivatives.one + derivatives.other)
    return before.plus(weights.second * np.tensordot(step, slopes, axes=1)).and_one(now, moved)


def secant_products(
    before: HalvesMean, now: HalvesMean, derivatives: HalvesMean, step: np.ndarray, weights: np.ndarray
) -> np.ndarray:
    """Return Σ p y, Σ p² and the variance of their difference, (3,), over a view's pixels (H, W, 3) with weights, such as ℓ''.

    y is the change of the image by a step (m,), and p = J s the change that derivative images predict. Noise biases neither sum.
    """
    one, other = (np.tensordot(step, half.astype(np.float64), axes=1) for half in (derivatives.one, derivatives.other))
    changes = now.one - before.one, now.other - before.other
    mean, noise = 0.5 * (one + other), 0.5 * (one - other)
    factors = (
        (mean, 0.5 * (changes[0] + changes[1])), (one, other),
        (mean, 0.5 * (changes[0] - changes[1])), (mean, noise), (noise, noise),
    )  # fmt: skip
    measured, squares, *scatters = ((weights * a * b).sum(axis=-1) for a, b in factors)
    return np.array([measured.sum(), squares.sum(), sum(np.square(x).sum() for x in scatters)])


def references_have_noise(residuals: Iterable[HalvesMean]) -> bool:
    """Return whether the mean residuals of all views are more than the noise of renderings, which is all that exact references leave."""
    squares = np.array([mean.shared() for mean in residuals]).reshape(-1, 2).sum(axis=0)
    return bool(squares[0] > _RESIDUAL_ERRORS * math.sqrt(squares[1]))


def squared_slope(halves: list[np.ndarray]) -> float:
    """Return the sum of squared differences of neighbouring pixels of the mean image, averaged over both directions. It is unbiased by
    noise, since it uses two independent halves (B, H, W, 3)."""
    one, other = (half.mean(axis=0, dtype=np.float64) for half in halves)
    return 0.5 * sum(float((np.diff(one, axis=axis) * np.diff(other, axis=axis)).sum()) for axis in (0, 1))


def directions(hessian: np.ndarray | None, widths: np.ndarray, largest: np.ndarray) -> np.ndarray:
    """Return the directions of central differences, one per row, (m, m): widths of single elements, or weak directions in their place.

    Elements that change the pictures almost alike have weak directions, along which they cancel, such as a move along the light that casts
    a shadow. Differences of single elements do not tell how pictures change along them, since each has another error of its own. So
    there, the last element of the largest share moves together with the others.

    Args:
        hessian: Gauss-Newton matrix (m, m); None if it is unknown.
        widths: widths of differences by single elements, (m,).
        largest: largest change of each element, (m,); infinite for no limit.
    """
    rows = np.diag(widths)
    if hessian is None or not np.isfinite(hessian).all():
        return rows
    changes = widths[:, None] * hessian * widths
    if not (np.diag(changes) > 0.0).all():
        return rows
    _, values, vectors = scores.scaled_eigh(changes)
    weak = np.flatnonzero(values < _WEAK)[:_MOST_WEAK]
    if not weak.size:
        return rows
    from scipy.linalg import qr

    replaced = qr(vectors[:, weak].T, mode="r", pivoting=True)[-1][: weak.size]
    units = np.sqrt(np.diag(changes))
    moves = (vectors[:, weak] / units[:, None]).T * units.mean() * widths
    moves /= np.sqrt(np.maximum(values[weak], _LONGEST**-2))[:, None]
    rows[replaced] = moves / np.maximum(np.abs(moves / largest).max(axis=1, keepdims=True), 1.0)
    return rows


def differences(images: np.ndarray, moves: np.ndarray) -> np.ndarray:
    """Return derivative images (m, H, W, 3) from images (2 m, H, W, 3), first those of one end of each move, then those of the other.

    Args:
        moves: differences of the elements between both ends, one move per row, (m, m). A row with a single element gives the derivative by
            this element. Other rows give it together with these. An element that does not move has none.
    """
    changes = images[: len(moves)].astype(np.float64) - images[len(moves) :]
    single = np.count_nonzero(moves, axis=1) <= 1
    own = np.diag(moves)
    over = np.divide(1.0, own, out=np.zeros(own.size), where=single & (own != 0.0))
    derivatives = changes * over[:, None, None, None]
    if not single.all():
        rest = changes[~single] - np.tensordot(moves[np.ix_(~single, single)], derivatives[single], axes=1)
        derivatives[~single] = np.tensordot(np.linalg.pinv(moves[np.ix_(~single, ~single)]), rest, axes=1)
    return derivatives.astype(np.float32)


def products(
    halves: list[np.ndarray],
    weights: LossWeights | None,
    residuals: HalvesMean | None = None,
    block: int = 1,
    shared: bool = False,
    inverse: np.ndarray | None = None,
) -> Products:
    """Return the products of two independent halves of J, (m, H, W, 3) each.

    Args:
        halves: derivative images.
        weights: derivatives of the loss; None if only `squares` is needed.
        residuals: mean of ℓ' over steps, for `scores`; None for no scores.
        block: side of the blocks of pixels over which all but `squares` are summed.
        shared: whether all steps share the derivative images. Their noise times that of the references then moves the solution, and
            `scores` include it.
        inverse: inverse of the Hessian, (m, m). `scores` then contain the residuals that each pixel would have in a fit without it, see
            `scores.without_own_pixel`. None for the residuals themselves, which are less than the noise where few pixels decide the fit.
    """
    m = len(halves[0])
    total = Products.zero(m)
    for rows in _rows(halves[0], max(block, 1)):
        one, other = (half[:, rows].astype(np.float64) for half in halves)
        total.squares += (one * other).sum(axis=(1, 2, 3))
        if weights is None:
            continue
        means = () if residuals is None else (residuals.one, residuals.other)
        first, second, *at = (
            x[rows].astype(np.float64) for x in (weights.first, weights.second, weights.one, weights.other, *means)
        )
        if block > 1:
            one, other, first, *at = (_pooled(x, block) for x in (one, other, first, *at))
            second = _pooled(second, block) / _pooled(np.ones_like(second), block)
        if residuals is not None and inverse is not None:
            at[2:] = _without_own_pixel(at[2:], one, other, inverse, second)
        both = [0.5 * (one + other)] * 2 if shared else [one, other]
        of_halves = [(part * of).sum(axis=3) for part, of in zip((one, other, *both), at, strict=False)]
        if residuals is not None:
            total.scores += scores.covariance(of_halves[2], of_halves[3])
        half = 0.5 * (of_halves[0] - of_halves[1]).reshape(m, -1)
        total.gradient_noise += half @ half.T
        noise_of_halves = 0.5 * (one - other)
        total.gradient += 0.5 * ((one + other).reshape(m, -1) @ first.reshape(-1))
        total.hessian += (one * second).reshape(m, -1) @ other.reshape(m, -1).T
        total.noise += (noise_of_halves * second).reshape(m, -1) @ noise_of_halves.reshape(m, -1).T
    total.hessian = 0.5 * (total.hessian + total.hessian.T)
    return total


def _without_own_pixel(
    residuals: list[np.ndarray], one: np.ndarray, other: np.ndarray, inverse: np.ndarray, second: np.ndarray
) -> Iterator[np.ndarray]:
    """Yield two residuals (H, W, 3) as fits without each pixel would leave them, see `scores.without_own_pixel`."""
    flat = [x.reshape(*x.shape[:-3], -1, x.shape[-1]) for x in (np.stack(residuals), one, other, second)]
    left = scores.without_own_pixel(flat[0], flat[1], flat[2], inverse, flat[3])
    yield from left.reshape(2, *second.shape)


def _pooled(images: np.ndarray, block: int) -> np.ndarray:
    """Return sums over blocks of pixels, divided by the square root of their size, of images (..., H, W, 3)."""
    for axis in (-3, -2):
        starts = np.arange(0, images.shape[axis], block)
        sizes = np.diff(np.append(starts, images.shape[axis]))
        shape = [1] * images.ndim
        shape[axis] = -1
        images = np.add.reduceat(images, starts, axis=axis) / np.sqrt(sizes).reshape(shape)
    return images


def _rows(images: np.ndarray, block: int) -> Iterator[slice]:
    """Yield slices of full blocks of rows, with at most `_VALUES` values of all images if possible."""
    height = images.shape[1]
    step = max(_VALUES // max(images[:, :1].size * block, 1), 1) * block
    for start in range(0, height, step):
        yield slice(start, start + step)
