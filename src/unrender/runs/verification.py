"""Whether the pictures of a run agree with its references, and the control variates in its state."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np

from unrender.core.arrays import Array
from unrender.core.trees import Tree
from unrender.display import formatting
from unrender.statistics import paired_losses

__all__ = ["DIFFERS", "Misfit", "Remembering", "misfit", "remembered"]

DIFFERS = "the final picture differs from the references"
"""First words of warnings about images that do not agree with the references."""
_FEW_PIXELS, _OF_FEW = 96, 0.2
"""Number of pixels below which the difference is also judged pixel by pixel, which includes the references' noise; its smallest size
relative to the image in this case."""


@dataclass(frozen=True)
class Misfit:
    """A difference of pictures from their references that noise does not explain.

    Attributes:
        error: its root mean square.
        size: root mean square of the references.
        noise: root mean square of the rest of the first picture's difference.
        by_pixel: whether pixels were judged one by one, so that the references' noise counts.
    """

    error: float
    size: float
    noise: float
    by_pixel: bool = False

    def describe(self) -> str:
        """Return the first words of a warning."""
        times = f"{self.error / self.noise:.1f} times its noise" if self.noise > 0.0 else ""
        share = f"{self.error / self.size:.0%} of the picture" if self.size > 0.0 else ""
        parts = ", ".join(filter(None, (share, times)))
        return f"{DIFFERS} by {formatting.number(self.error)}" + (f" ({parts})" if parts else "")


def misfit(
    residuals: np.ndarray,
    others: np.ndarray,
    references: np.ndarray,
    weights: np.ndarray,
    least: float,
    fresh: np.ndarray | None = None,
) -> Misfit | None:
    """Return the difference from the references that two pictures share; None if it may be noise or is small.

    Noise of the references does not count, since neighbouring pixels do not share it.

    Args:
        residuals: differences of K independent images from the references, (K, N, 3), in an order that mostly keeps neighbours adjacent.
        others: those of another picture, whose noise may depend on the first one's at the same pixel, (K, N, 3).
        references: references, (N, 3).
        weights: weight of each pixel, (N,), in [0, 1].
        least: smallest difference relative to the references.
        fresh: differences of K >= 2 images with independent noise, (K, N, 3). With these, few pixels are also judged one by one.
    """
    one, other = residuals.mean(axis=0), others.mean(axis=0)
    if not (np.isfinite(one).all() and np.isfinite(other).all()):
        return None
    size, total = (math.sqrt(paired_losses.mean_square(x, weights)) for x in (references, one))

    def significant(shared: paired_losses.SystematicDifference, smallest: float, by_pixel: bool) -> Misfit | None:
        error = math.sqrt(max(shared.mean_square, 0.0))
        beyond = shared.score > paired_losses.SIGNIFICANT and error > smallest * size
        return Misfit(error, size, math.sqrt(max(total**2 - error**2, 0.0)), by_pixel) if beyond else None

    found = significant(paired_losses.systematic(one, weights, other), least, False)
    if found or fresh is None or np.count_nonzero(weights) >= _FEW_PIXELS:
        return found
    return significant(paired_losses.repeated(residuals, fresh, weights), _OF_FEW, True)


@runtime_checkable
class Remembering(Protocol):
    """An estimator's state, or a part of it, with control variates of images."""

    def remembered(self) -> tuple[Tree, Sequence[Array]] | None:
        """Return the parameters of the images, and the image (H, W, 3) of each view; None before the first step."""
        ...


def remembered(state: Any) -> Iterator[tuple[Tree, Sequence[Array]]]:
    """Yield the control variates in all parts of an estimator's state."""
    if isinstance(state, Remembering):
        if (images := state.remembered()) is not None:
            yield images
    elif dataclasses.is_dataclass(state) and not isinstance(state, type):
        for field in dataclasses.fields(state):
            yield from remembered(getattr(state, field.name))
    elif isinstance(state, Mapping):
        for part in state.values():
            yield from remembered(part)
    elif isinstance(state, (list, tuple)):
        for part in state:
            yield from remembered(part)
