"""Views whose pixels have different numbers of samples."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from unrender.core import arrays
from unrender.core.arrays import Array


@dataclass(frozen=True)
class SampleCounts:
    """Number of samples of each of the P pixels of a view. The N samples are sorted by pixel in row-major order.

    Attributes:
        shape: (height, width) of the view.
        pixels: pixel index of each sample, (N,), integers.
        starts: index of the first sample of each pixel, (P,), integers.
        numbers: number of samples n of each pixel, (P,), integers, >= 2.
        divisors: n of each pixel, (height, width, 1), floats.
    """

    shape: tuple[int, int]
    pixels: Array
    starts: Array
    numbers: Array
    divisors: Array

    @classmethod
    def of(cls, numbers: np.ndarray, array: Callable[[np.ndarray], Array]) -> SampleCounts:
        """Build the counts from the number of samples of each pixel, (height, width); `array` makes arrays of the renderer."""
        shape = (int(numbers.shape[0]), int(numbers.shape[1]))
        flat = numbers.ravel()
        divisors = array(numbers[..., None].astype(np.float64))
        pixels, starts = np.repeat(np.arange(flat.size), flat), np.concatenate([[0], np.cumsum(flat)[:-1]])
        pixels, starts, flat = (arrays.like_integers(x, divisors) for x in (pixels, starts, flat))
        return cls(shape, pixels, starts, flat, divisors)

    def means(self, samples: Array) -> Array:
        """Return the mean of each pixel's samples: (1, N, 3) -> (height, width, 3)."""
        sums = arrays.segment_sums(arrays.rows(samples), self.starts, self.numbers)
        return arrays.reshape(sums, (*self.shape, 3)) / self.divisors

    def spread(self, image: Array) -> Array:
        """Return the pixel value of each sample: (height, width, C) -> (1, N, C)."""
        return arrays.add_first_axis(arrays.gather_rows(arrays.rows(image), self.pixels))

    def others(self, samples: Array) -> Array:
        """Return, for each sample, the mean of the other samples of its pixel: (1, N, 3) -> (1, N, 3)."""
        number = self.spread(self.divisors)
        return (self.spread(self.means(samples)) * number - samples) / (number - 1.0)

    def variance_of_mean(self, samples: Array) -> Array:
        """Return the variance of `means`, (height, width, 3), from the spread of each pixel's samples."""
        mean, square = self.means(samples), self.means(samples * samples)
        return arrays.maximum(square - mean * mean, 0.0) / (self.divisors - 1.0)


@dataclass(frozen=True)
class SampleShares:
    """Rule that distributes a mean number of samples over the pixels: `least` each, and a share of the rest.

    Attributes:
        least: minimum number of samples per pixel, >= 2.
        shares: relative share of the rest, per view (height, width), any scale, >= 0; equal shares if all are 0.
        offsets: random offset of the rounding per view, uniform in [0, 1).
    """

    least: int
    shares: tuple[np.ndarray, ...]
    offsets: tuple[float, ...]

    def counts(self, view: int, spp: int, array: Callable[[np.ndarray], Array]) -> SampleCounts:
        """Return the counts of one view: `spp` times its pixels in total, rounded randomly so that each count has its share as expectation.

        Args:
            view: index of the view.
            spp: mean samples per pixel, at least `least`.
            array: function that makes arrays of the renderer.
        """
        return SampleCounts.of(rounded(self.shares[view], spp, self.least, self.offsets[view]), array)


def rounded(shares: np.ndarray, spp: int, least: int, offset: float) -> np.ndarray:
    """Round shares of samples to integers, of the shape of `shares`.

    A pixel gets `least` + ⌊C_p + u⌋ − ⌊C_{p−1} + u⌋, with the cumulative shares C and u = `offset` for all pixels.
    """
    rest = (spp - least) * shares.size
    sums = np.cumsum(shares.ravel(), dtype=np.float64)
    if not (sums[-1] > 0 and np.isfinite(sums[-1])):
        sums = np.arange(1.0, shares.size + 1)
    ends = np.minimum(np.floor(sums * (rest / sums[-1]) + offset), rest).astype(np.int64)
    ends[-1] = rest
    return (np.diff(ends, prepend=0) + least).reshape(shares.shape)
