"""What a step looks at in one launch, and what the loss makes of it: a whole view, or pixels drawn from all views."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

from unrender.core import arrays
from unrender.core.arrays import Array
from unrender.problem.problem import Problem
from unrender.rendering.renderer import SampleRequest


@dataclass(frozen=True)
class PixelSample:
    """Pixels drawn with replacement from the pixels of all views.

    Attributes:
        views: index of the view of each, (N,), whole numbers as the renderer's arrays have them.
        pixels: flat index (row-major) within the view's film, (N,).
        weights: 1 / (N p), (N, 1): sums over the draw times these are unbiased sums over all pixels.
    """

    views: Array
    pixels: Array
    weights: Array


class Frame(Protocol):
    """Some of the problem's pixels, and their share of the loss. Images are (groups, *shape) or (*shape)."""

    @property
    def name(self) -> int:
        """What to call it in `info`: the view's index, or -1 for pixels of several views."""
        ...

    @property
    def pixels(self) -> int:
        """How many there are, those drawn twice counted twice."""
        ...

    def request(self, spp: int, seed: int, groups: int = 1) -> SampleRequest:
        """These pixels, with so many samples each."""
        ...

    def loss_value(self, image: Array) -> Array:
        """An unbiased estimate of their share of the loss where the image is exact, a lazy scalar."""
        ...

    def loss_derivative(self, image: Array) -> Array:
        """∂(total loss)/∂(pixel), times the pixel's weight."""
        ...


@dataclass(frozen=True)
class WholeView:
    """All pixels of one view: images (H, W, 3)."""

    problem: Problem
    view: int

    @property
    def name(self) -> int:
        """The view's index."""
        return self.view

    @property
    def pixels(self) -> int:
        """See `Frame.pixels`."""
        height, width = self.problem.renderer.resolutions()[self.problem.views[self.view].sensor]
        return height * width

    def request(self, spp: int, seed: int, groups: int = 1) -> SampleRequest:
        """See `Frame.request`."""
        return SampleRequest(self.problem.views[self.view].sensor, spp, seed, groups)

    def loss_value(self, image: Array) -> Array:
        """The view's share of the loss, exactly."""
        return self.problem.loss_value(self.view, image)

    def loss_derivative(self, image: Array) -> Array:
        """See `Frame.loss_derivative`."""
        return self.problem.loss_derivative(self.view, image)


@dataclass(frozen=True)
class PixelBatch:
    """Pixels drawn from all views: images (N, 3)."""

    problem: Problem
    draw: PixelSample

    @property
    def name(self) -> int:
        """-1: of several views."""
        return -1

    @property
    def pixels(self) -> int:
        """See `Frame.pixels`."""
        return int(arrays.shape(self.draw.weights)[0])

    @cached_property
    def targets(self) -> tuple[Array, Array]:
        """Their reference values (N, 3), and the factor of each one's loss (N, 1): view weight * mask / (H * W * 3)."""
        return self.problem.references.at(self.draw.views, self.draw.pixels)

    def request(self, spp: int, seed: int, groups: int = 1) -> SampleRequest:
        """See `Frame.request`."""
        sensors = [view.sensor for view in self.problem.views]
        if len(set(sensors)) == 1:
            return SampleRequest(sensors[0], spp, seed, groups, self.draw.pixels)
        table = self.problem.references.sensors
        return SampleRequest(sensors[0], spp, seed, groups, self.draw.pixels, arrays.gather(table, self.draw.views))

    def loss_value(self, image: Array) -> Array:
        """See `Frame.loss_value`."""
        reference, factor = self.targets
        return arrays.total(self.problem.loss.value(image, reference) * (factor * self.draw.weights))

    def loss_derivative(self, image: Array) -> Array:
        """See `Frame.loss_derivative`."""
        reference, factor = self.targets
        return self.problem.loss.derivative(image, reference) * (factor * self.draw.weights)


def whole_views(problem: Problem) -> list[Frame]:
    """Every pixel of every view."""
    return [WholeView(problem, view) for view in range(len(problem.views))]
