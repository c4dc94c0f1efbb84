"""What an image estimator is: it makes the image that the loss sees."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Protocol

from unrender.arrays import Array
from unrender.keys import Key
from unrender.problem.problem import Problem
from unrender.rendering.port import Space
from unrender.trees import Tree


@dataclass(frozen=True)
class ImageEstimate:
    """The image of one view at one step.

    Attributes:
        images: (H, W, 3) per group of samples; the estimate made without the other groups' samples.
        paths: the renderer's own, to replay these samples.
        info: for people, e.g. {"control_weight": array}.
    """

    images: tuple[Array, ...]
    paths: Any
    info: Mapping[str, Any] = field(default_factory=dict)

    def mean(self) -> Array:
        """The image of all samples together."""
        result = self.images[0]
        for image in self.images[1:]:
            result = result + image
        return result / len(self.images)


class ImageEstimator(Protocol):
    """Immutable; all that changes is in the state."""

    @property
    def space(self) -> Space | None:
        """Where samples are shared between two states, or None if they are not."""
        ...

    def init(self, problem: Problem, parameters: Tree) -> Any:
        """The state before the first step."""
        ...

    def estimate(
        self, problem: Problem, parameters: Tree, state: Any, view: int, spp: int, groups: int, key: Key
    ) -> tuple[ImageEstimate, Any]:
        """The image of one view, and what is to be kept of it."""
        ...

    def advance(self, parameters: Tree, state: Any, kept: tuple[Any, ...]) -> Any:
        """The state after a step at `parameters`, from what was kept of each view."""
        ...
