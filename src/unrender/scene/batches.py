"""The pixels that one launch renders, a whole view or a mini-batch from all views, and the loss on them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np

from unrender.core import arrays
from unrender.core.arrays import Array
from unrender.rendering.renderer import SampleRequest
from unrender.scene.problem import Problem
from unrender.scene.sample_counts import SampleCounts, SampleShares


@dataclass(frozen=True)
class PixelSample:
    """A mini-batch of pixels, drawn with replacement from the pixels of all views.

    Attributes:
        views: index of the view of each, (N,), integer array of the renderer.
        pixels: row-major index within the view's film, (N,).
        weights: 1 / (N p), (N, 1): weighted sums over the mini-batch are unbiased sums over all pixels.
        positions: of each in the mini-batch that this is a part of, (N,); None for a whole one. See `SampleRequest`.
    """

    views: Array
    pixels: Array
    weights: Array
    positions: Array | None = None


class Frame(Protocol):
    """Some pixels of the problem, and their part of the loss. Images are (groups, *shape) or (*shape)."""

    @property
    def pixels(self) -> int:
        """How many there are, with multiplicity."""
        ...

    def request(self, spp: int, seed: int, groups: int = 1) -> SampleRequest:
        """The request for these pixels with `spp` samples each."""
        ...

    def loss_value(self, image: Array) -> Array:
        """Their part of the loss, a lazy scalar; for a mini-batch an unbiased estimate of the total where the image is exact."""
        ...

    def loss_derivative(self, image: Array) -> Array:
        """∂(total loss)/∂(pixel), times the pixel's weight."""
        ...


@dataclass(frozen=True)
class WholeView:
    """All pixels of one view: images (H, W, 3).

    With `counts` each pixel has a number of samples of its own. These are images of one group then, (1, N, 3), and so are the
    derivatives, each divided by its pixel's number of samples. `emitters`: see `SampleRequest`.
    """

    problem: Problem
    view: int
    counts: SampleCounts | None = None
    emitters: np.ndarray | None = None

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
        """The view's part of the loss, exactly."""
        return self.problem.loss_value(self.view, image)

    def loss_derivative(self, image: Array) -> Array:
        """See `Frame.loss_derivative`; with `counts`, of (1, N, 3)."""
        if self.counts is None:
            return self.problem.loss_derivative(self.view, image)
        pixels = self.counts.pixels
        reference, factor = self.problem.references.at(pixels * 0 + self.view, pixels)
        return self.problem.loss.derivative(image, reference) * (factor / self.counts.spread(self.counts.divisors))

    def laid(self, image: Array) -> Array:
        """An image (H, W, C) as the loss derivative takes it; with `counts`, the pixel of each sample, (1, N, C)."""
        return image if self.counts is None else self.counts.spread(image)


@dataclass(frozen=True)
class PixelBatch:
    """A mini-batch of pixels of all views: images (N, 3). `emitters`: see `SampleRequest`."""

    problem: Problem
    sample: PixelSample
    emitters: np.ndarray | None = None

    @property
    def pixels(self) -> int:
        return int(arrays.shape(self.sample.weights)[0])

    @cached_property
    def targets(self) -> tuple[Array, Array]:
        """Their reference values (N, 3), and the factor of each one's loss (N, 1): view weight * mask / (H * W * 3)."""
        return self.problem.references.at(self.sample.views, self.sample.pixels)

    @cached_property
    def whole(self) -> tuple[tuple[slice, tuple[int, int]], ...]:
        """Of views all of whose pixels are here one after the other, as of `pixels.Views`: where they are, and (height, width)."""
        views, pixels = (arrays.numpy(x).astype(np.int64) for x in (self.sample.views, self.sample.pixels))
        sizes, found, start = self.problem.sizes, [], 0
        while start < len(views):
            height, width = sizes[views[start]]
            stop = start + height * width
            of_one = views[start:stop] == views[start]
            if len(of_one) < height * width or not of_one.all() or not (np.diff(pixels[start:stop]) == 1).all():
                break
            found.append((slice(start, stop), (height, width)))
            start = stop
        return tuple(found)

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


def whole_views(
    problem: Problem, shares: SampleShares | None = None, spp: int = 1, emitters: np.ndarray | None = None
) -> list[Frame]:
    """One frame per view; with `shares`, each pixel has a number of samples of its own, `spp` on average."""
    views, array = range(len(problem.views)), problem.renderer.array
    counts = [None if shares is None else shares.counts(view, spp, array) for view in views]
    return [WholeView(problem, view, counts[view], emitters) for view in views]
