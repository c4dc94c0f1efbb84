"""What an image estimator is: it makes the image that the loss sees."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Protocol

from unrender.core import arrays
from unrender.core.arrays import Array
from unrender.core.random import Key
from unrender.core.trees import Tree
from unrender.problem.batches import Frame
from unrender.problem.problem import Problem
from unrender.rendering.renderer import Space


@dataclass(frozen=True)
class ImageEstimate:
    """The image of one frame at one step: of a view, (H, W, 3), or of N drawn pixels, (N, 3).

    Attributes:
        images: (groups, H, W, 3) or (groups, N, 3), one estimate per group of samples, made without the other groups' samples.
        paths: the renderer's own, to replay these samples.
        info: for people, e.g. {"control_weight": array}.
        previous: `images` of the previous step's parameters, from the same samples; None where they were not rendered.
        clean: what is done to an image (H, W, 3) before the loss sees it; None for nothing.
    """

    images: Array
    paths: Any
    info: Mapping[str, Any] = field(default_factory=dict)
    previous: Array | None = None
    clean: Callable[[Array], Array] | None = None

    def mean(self) -> Array:
        """The image of all samples together, (H, W, 3) or (N, 3)."""
        whole = arrays.mean_first(self.images)
        return whole if self.clean is None else self.clean(whole)

    def others(self) -> Array:
        """For each group, the image of all other groups' samples; of its own where it is alone."""
        return self._cleaned(_others(self.images))

    def previous_others(self) -> Array:
        """`others()` of the previous step's parameters."""
        return self._cleaned(_others(self.previous))

    def _cleaned(self, images: Array) -> Array:
        if self.clean is None:
            return images
        return arrays.concatenated([arrays.stacked(self.clean(images[group])) for group in range(images.shape[0])])


def _others(images: Array) -> Array:
    groups = images.shape[0]
    return images if groups == 1 else (arrays.mean_first(images) * groups - images) / (groups - 1)


@dataclass(frozen=True)
class PairRequest:
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

    @property
    def pixelwise(self) -> bool:
        """Whether it can estimate drawn pixels without all others."""
        ...

    def init(self, problem: Problem, parameters: Tree) -> Any:
        """The state before the first step."""
        ...

    def estimate(
        self,
        problem: Problem,
        parameters: Tree,
        state: Any,
        frame: Frame,
        spp: int,
        groups: int,
        key: Key,
        pair_request: PairRequest | None = None,
    ) -> tuple[ImageEstimate, Any]:
        """The image of one frame, and what is to be kept of it; with `pair_request`, that of the previous parameters too."""
        ...

    def needs_whole_views(self, parameters: Tree, state: Any, batches: int) -> bool:
        """Whether the next step must look at whole views, where `batches` steps of drawn pixels came after the last that did."""
        ...

    def prepare(self, problem: Problem, state: Any) -> Any:
        """The state after a step that looked at whole views, made ready for drawn pixels."""
        ...

    def advance(self, parameters: Tree, state: Any, kept: tuple[Any, ...]) -> Any:
        """The state after a step at `parameters` that looked at whole views, from what was kept of each."""
        ...
