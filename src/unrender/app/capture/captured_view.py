"""One photograph as the view of a problem, and several of them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from unrender.app.capture.cameras import Lens

__all__ = ["CapturedView", "CapturedViews"]


@dataclass(frozen=True)
class CapturedView:
    """One photograph, ready to be compared with a render.

    Attributes:
        name: of the photograph.
        lens: a pinhole with square pixels.
        camera_to_world: (4, 4), axes right, up, backwards.
        values: (H, W, 3) float32, linear.
        mask: (H, W) in [0, 1], which part of each pixel the object covers; None where there is no mask.
        shown: (H, W) in [0, 1], which part of each pixel the photograph shows: less than 1 where undistorting leaves the picture.
        held_out: whether it is for judging alone.
    """

    name: str
    lens: Lens
    camera_to_world: np.ndarray
    values: np.ndarray
    mask: np.ndarray | None
    shown: np.ndarray
    held_out: bool


class CapturedViews(Protocol):
    """A list of views, or `StoredViews`, which reads each when it is asked for: take one at a time."""

    def __len__(self) -> int: ...

    def __getitem__(self, index: int, /) -> CapturedView: ...

    def __iter__(self) -> Iterator[CapturedView]: ...
