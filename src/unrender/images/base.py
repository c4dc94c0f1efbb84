"""What an image estimator is: it makes the image that the loss sees."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Protocol

from unrender import arrays
from unrender.arrays import Array
from unrender.keys import Key
from unrender.problem.problem import Problem
from unrender.rendering.port import Space
from unrender.trees import Tree


@dataclass(frozen=True)
class ImageEstimate:
    """The image of one view at one step.

    Attributes:
        images: (groups, H, W, 3), one estimate per group of samples, made without the other groups' samples.
        paths: the renderer's own, to replay these samples.
        info: for people, e.g. {"control_weight": array}.
        previous: `images` of the previous step's parameters, from the same samples; None where they were not rendered.
    """

    images: Array
    paths: Any
    info: Mapping[str, Any] = field(default_factory=dict)
    previous: Array | None = None

    def mean(self) -> Array:
        """The image of all samples together, (H, W, 3)."""
        return arrays.mean_first(self.images)

    def others(self) -> Array:
        """For each group, the image of all other groups' samples, (groups, H, W, 3); of its own where it is alone."""
        return _others(self.images)

    def previous_others(self) -> Array:
        """`others()` of the previous step's parameters."""
        return _others(self.previous)


def _others(images: Array) -> Array:
    groups = images.shape[0]
    return images if groups == 1 else (arrays.mean_first(images) * groups - images) / (groups - 1)


@dataclass(frozen=True)
class Beside:
    """The state that is to be rendered beside the current one, from the same samples.

    Attributes:
        previous: the parameters of the last step that the estimator took.
        space: where to share samples, for image estimators without a space of their own.
    """

    previous: Tree
    space: Space


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
        self,
        problem: Problem,
        parameters: Tree,
        state: Any,
        view: int,
        spp: int,
        groups: int,
        key: Key,
        beside: Beside | None = None,
    ) -> tuple[ImageEstimate, Any]:
        """The image of one view, and what is to be kept of it; with `beside`, that of the previous parameters too."""
        ...

    def advance(self, parameters: Tree, state: Any, kept: tuple[Any, ...]) -> Any:
        """The state after a step at `parameters`, from what was kept of each view."""
        ...
