"""Pixels of one launch, either a full view or a mini-batch from all views, their numbers of samples, and the loss on them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Protocol

import numpy as np

from unrender.core import arrays
from unrender.core.arrays import Array
from unrender.core.random import Key
from unrender.rendering.renderer import SampleRequest
from unrender.scene.problem import Problem
from unrender.statistics.paired_losses import slices_of_images

_MOST_JOINED = 1 << 19
"""Maximum number of path segments of a launch of several views. Cached paths of as many take less than 36 MB."""


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
    """Rule that distributes a mean number of samples over the pixels: `least` >= 2 each, and relative shares of the rest, per view (height,
    width), >= 0, equal if all are 0. The offset of the rounding per view is uniform in [0, 1)."""

    least: int
    shares: tuple[np.ndarray, ...]
    offsets: tuple[float, ...]

    def counts(self, view: int, spp: int, array: Callable[[np.ndarray], Array]) -> SampleCounts:
        """Return the counts of one view: `spp` >= `least` times its pixels in total, rounded randomly so that each count has its share as
        expectation."""
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


@dataclass(frozen=True)
class PixelSample:
    """A mini-batch of pixels, sampled with replacement from the pixels of all views.

    Attributes:
        views: index of each pixel's view, (N,), integer array of the renderer.
        pixels: row-major index in the view's film, (N,).
        weights: 1 / (N p), (N, 1). Weighted sums over the mini-batch are unbiased estimates of sums over all pixels.
        positions: index of each pixel in the complete mini-batch, (N,), if this is a part of one; else None. See `SampleRequest`.
    """

    views: Array
    pixels: Array
    weights: Array
    positions: Array | None = None


class Frame(Protocol):
    """Pixels of the problem that one launch renders, and their part of the loss. Images are (groups, *shape) or (*shape)."""

    @property
    def pixels(self) -> int:
        """Number of pixels, with multiplicity."""
        ...

    def request(self, spp: int, seed: int, groups: int = 1) -> SampleRequest:
        """Return the request for these pixels with `spp` samples each."""
        ...

    def loss_value(self, image: Array) -> Array:
        """Return the loss of these pixels, a lazy scalar. For a mini-batch and an exact image it estimates the total without bias."""
        ...

    def loss_derivative(self, image: Array) -> Array:
        """Return ∂(total loss)/∂(pixel) times the pixel's weight."""
        ...


@dataclass(frozen=True)
class FullView:
    """All pixels of one view, with images (H, W, 3).

    With `counts`, pixels have different numbers of samples. Images and loss derivatives then have one entry per sample, (1, N, 3), in a
    single group, and each derivative is divided by its pixel's number of samples. For `emitters` see `SampleRequest`.
    """

    problem: Problem
    view: int
    counts: SampleCounts | None = None
    emitters: np.ndarray | None = None

    @property
    def memory(self) -> int:
        """Index of this frame in its step."""
        return self.view

    @property
    def pixels(self) -> int:
        height, width = self.problem.renderer.resolutions()[self.problem.views[self.view].sensor]
        return height * width

    def request(self, spp: int, seed: int, groups: int = 1) -> SampleRequest:
        sensor = self.problem.views[self.view].sensor
        if self.counts is not None:
            return SampleRequest(sensor, 1, seed, 1, self.counts.pixels, emitters=self.emitters)
        return SampleRequest(sensor, spp, seed, groups, emitters=self.emitters)

    def loss_value(self, image: Array) -> Array:
        """Return the loss of the view, without approximation."""
        return self.problem.loss_value(self.view, image)

    def loss_derivative(self, image: Array) -> Array:
        """Return ∂(total loss)/∂(pixel): (H, W, 3), or (1, N, 3) with `counts`."""
        if self.counts is None:
            return self.problem.loss_derivative(self.view, image)
        pixels = self.counts.pixels
        reference, factor = self.problem.references.at(pixels * 0 + self.view, pixels)
        return self.problem.loss.derivative(image, reference) * (factor / self.counts.spread(self.counts.divisors))

    def expand(self, image: Array) -> Array:
        """Return an image (H, W, C) in the layout of the loss derivative: with `counts`, the pixel of each sample, (1, N, C)."""
        return image if self.counts is None else self.counts.spread(image)


@dataclass(frozen=True)
class PixelBatch:
    """A mini-batch of pixels from all views, with images (N, 3). For `emitters` see `SampleRequest`."""

    problem: Problem
    sample: PixelSample
    emitters: np.ndarray | None = None

    @property
    def pixels(self) -> int:
        return int(arrays.shape(self.sample.weights)[0])

    @cached_property
    def targets(self) -> tuple[Array, Array]:
        """Reference values (N, 3), and the factor of each pixel's loss (N, 1): view weight * mask / (H * W * 3)."""
        return self.problem.references.at(self.sample.views, self.sample.pixels)

    @cached_property
    def complete_views(self) -> tuple[tuple[slice, tuple[int, int]], ...]:
        """Slice and (height, width) of each view whose pixels are all in this batch, in order, as `pixels.Views` selects them."""
        views, pixels = (arrays.numpy(x).astype(np.int64) for x in (self.sample.views, self.sample.pixels))
        sizes, complete, start = self.problem.sizes, [], 0
        while start < len(views):
            height, width = sizes[views[start]]
            stop = start + height * width
            same = views[start:stop] == views[start]
            if len(same) < height * width or not same.all() or not (np.diff(pixels[start:stop]) == 1).all():
                break
            complete.append((slice(start, stop), (height, width)))
            start = stop
        return tuple(complete)

    def request(self, spp: int, seed: int, groups: int = 1) -> SampleRequest:
        sensors = [view.sensor for view in self.problem.views]
        table = None
        if len(set(sensors)) > 1:
            table = arrays.gather(self.problem.references.sensors, self.sample.views)
        pixels, positions = self.sample.pixels, self.sample.positions
        return SampleRequest(sensors[0], spp, seed, groups, pixels, table, positions, self.emitters)

    def loss_value(self, image: Array) -> Array:
        reference, factor = self.targets
        return arrays.total(self.problem.loss.value(image, reference) * (factor * self.sample.weights))

    def loss_derivative(self, image: Array) -> Array:
        reference, factor = self.targets
        return self.problem.loss.derivative(image, reference) * (factor * self.sample.weights)


@dataclass(frozen=True)
class JoinedViews(PixelBatch):
    """All pixels of consecutive views in one launch. Each view has the random numbers of a launch of its own.

    If only some cameras have an aperture or a shutter, the others sample one too, so their random numbers are others.

    Attributes:
        memory: index of this frame in its step.
        seeds: seed of each pixel, (N,), integers.
    """

    memory: int = 0
    views: range = range(0)
    seeds: Array = None
    counts = None

    @cached_property
    def complete_views(self) -> tuple[tuple[slice, tuple[int, int]], ...]:
        sizes = self.problem.sizes[self.views.start : self.views.stop]
        return tuple(zip(slices_of_images(sizes), sizes, strict=True))

    def request(self, spp: int, seed: int, groups: int = 1) -> SampleRequest:
        return replace(super().request(spp, seed, groups), seeds=self.seeds)

    def expand(self, image: Array) -> Array:
        """Return an image (N, C) unchanged."""
        return image


class ImagesOfViews(Mapping[int, Array]):
    """{view: image (H, W, 3)}, cut from the images (N, 3) of frames when it is read."""

    def __init__(self, joined: Sequence[tuple[JoinedViews, Array]]):
        self._joined = {view: part for part in joined for view in part[0].views}

    def __getitem__(self, view: int) -> Array:
        frame, image = self._joined[view]
        rows, size = frame.complete_views[view - frame.views.start]
        return arrays.reshape(image[rows], (*size, 3))

    def __iter__(self) -> Iterator[int]:
        return iter(self._joined)

    def __len__(self) -> int:
        return len(self._joined)


def joined_views(problem: Problem, spp: int, key: Key) -> list[JoinedViews]:
    """Return the full views of a step as frames of equally many views; [] if views should be rendered one by one: a launch of few paths
    takes longer to start than to trace."""
    sizes, count = [height * width for height, width in problem.sizes], len(problem.views)
    fitting = _MOST_JOINED // (problem.max_depth * spp * max(sizes))
    several = max((n for n in range(1, min(fitting, count) + 1) if count % n == 0), default=1)
    if several == 1 or (several < count and len(set(sizes)) > 1) or not _supports_joined(problem):
        return []
    frames = []
    for first in range(0, count, several):
        views = range(first, first + several)
        own, pixels, weights = problem.references.complete(views)
        seeds = [np.full(sizes[view], key.fold(view).fold(0).uint32(), np.uint32) for view in views]
        sample = PixelSample(own, pixels, weights, pixels)
        joined = arrays.like_integers(np.concatenate(seeds), weights)
        frames.append(JoinedViews(problem, sample, None, len(frames), views, joined))
    return frames


def _supports_joined(problem: Problem) -> bool:
    """Return whether views can share launches: with a loss of pixels, several sensors, and nothing that moves."""
    if not getattr(problem.renderer, "joins_views", False) or not problem.loss.pixelwise:
        return False
    known = problem.renderer.parameters()
    moves = any(info.rigid or info.viewpoint or info.moving_mesh for info in (known[key] for key in problem.shapes()))
    several = len({view.sensor for view in problem.views}) > 1
    return several and not moves and not problem.references.in_host_memory


def full_views(
    problem: Problem, shares: SampleShares | None = None, spp: int = 1, emitters: np.ndarray | None = None
) -> list[Frame]:
    """Return one frame per view. With `shares`, pixels have different numbers of samples, `spp` on average."""
    views, array = range(len(problem.views)), problem.renderer.array
    counts = [None if shares is None else shares.counts(view, spp, array) for view in views]
    return [FullView(problem, view, counts[view], emitters) for view in views]
