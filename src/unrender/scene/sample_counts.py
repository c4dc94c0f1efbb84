"""Whole views whose pixels have different numbers of samples."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from unrender.core import arrays
from unrender.core.arrays import Array


@dataclass(frozen=True)
class SampleCounts:
    """How many samples each of the P pixels of a view has. The N samples are sorted by pixel, row by row.

    Attributes:
        shape: (height, width) of the view.
        pixels: the pixel of each sample, (N,), integers.
        starts: the first sample of each pixel, (P,), integers.
        numbers: n of each pixel, (P,), integers, >= 2.
        divisors: n of each pixel, (height, width, 1), floats.
    """

    shape: tuple[int, int]
    pixels: Array
    starts: Array
    numbers: Array
    divisors: Array

    @classmethod
    def of(cls, numbers: np.ndarray, array: Callable[[np.ndarray], Array]) -> SampleCounts:
        """From n of each pixel, (height, width); `array` makes the renderer's arrays."""
        shape = (int(numbers.shape[0]), int(numbers.shape[1]))
        flat = numbers.ravel()
        divisors = array(numbers[..., None].astype(np.float64))
        pixels, starts = np.repeat(np.arange(flat.size), flat), np.concatenate([[0], np.cumsum(flat)[:-1]])
        pixels, starts, flat = (arrays.like_integers(x, divisors) for x in (pixels, starts, flat))
        return cls(shape, pixels, starts, flat, divisors)

    def means(self, samples: Array) -> Array:
        """The mean of each pixel's samples: (1, N, 3) to (height, width, 3)."""
        sums = arrays.segment_sums(arrays.rows(samples), self.starts, self.numbers)
        return arrays.reshape(sums, (*self.shape, 3)) / self.divisors

    def spread(self, image: Array) -> Array:
        """The pixel of each sample: (height, width, C) to (1, N, C)."""
        return arrays.add_first_axis(arrays.gather_rows(arrays.rows(image), self.pixels))

    def others(self, samples: Array) -> Array:
        """For each sample, the mean of all others of its pixel: (1, N, 3), likewise."""
        number = self.spread(self.divisors)
        return (self.spread(self.means(samples)) * number - samples) / (number - 1.0)

    def variance_of_mean(self, samples: Array) -> Array:
        """The variance of `means`, (height, width, 3), from what a pixel's samples differ by."""
        mean, square = self.means(samples), self.means(samples * samples)
        return arrays.maximum(square - mean * mean, 0.0) / (self.divisors - 1.0)


@dataclass(frozen=True)
class SampleShares:
    """From how many samples a pixel has on average to how many each has: `least`, and of the rest a share each.

    Attributes:
        least: samples of each pixel, >= 2.
        shares: of the rest, per view (height, width), any scale, >= 0; equal where all are 0.
        offsets: per view, uniform in [0, 1): which pixels are rounded up.
    """

    least: int
    shares: tuple[np.ndarray, ...]
    offsets: tuple[float, ...]

    def counts(self, view: int, spp: int, array: Callable[[np.ndarray], Array]) -> SampleCounts:
        """Those of one view: `spp` times its pixels in all, rounded so that each number is expected to be its share.

        Args:
            view: its index.
            spp: samples per pixel on average, at least `least`.
            array: makes the renderer's arrays.
        """
        return SampleCounts.of(rounded(self.shares[view], spp, self.least, self.offsets[view]), array)


def rounded(shares: np.ndarray, spp: int, least: int, offset: float) -> np.ndarray:
    """Whole numbers of samples, of the shape of `shares`: beyond `least`, ⌊C_p + u⌋ − ⌊C_{p−1} + u⌋ with the cumulative shares C and one u
    for all pixels, `offset`."""
    rest = (spp - least) * shares.size
    sums = np.cumsum(shares.ravel(), dtype=np.float64)
    if not (sums[-1] > 0 and np.isfinite(sums[-1])):
        sums = np.arange(1.0, shares.size + 1)
    ends = np.minimum(np.floor(sums * (rest / sums[-1]) + offset), rest).astype(np.int64)
    ends[-1] = rest
    return (np.diff(ends, prepend=0) + least).reshape(shares.shape)
