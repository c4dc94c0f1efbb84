"""Contents of a folder of posed photographs, independent of the program that wrote it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

import numpy as np

from unrender.app.capture.cameras import Lens

INSIDE = 0.999
"""Fraction of a pixel inside the photograph or the mask from which the whole pixel counts as inside."""


@dataclass(frozen=True)
class CapturedView:
    """One photograph, prepared for comparison with a render.

    Attributes:
        lens: a pinhole with square pixels.
        camera_to_world: (4, 4), axes right, up, backwards.
        values: (H, W, 3) float32, linear.
        mask: (H, W) in [0, 1], coverage of each pixel by the object; None without a mask.
        shown: (H, W) in [0, 1], fraction of each pixel inside the photograph: less than 1 where undistortion leaves the picture.
        held_out: whether it is for evaluation only.
    """

    name: str
    lens: Lens
    camera_to_world: np.ndarray
    values: np.ndarray
    mask: np.ndarray | None
    shown: np.ndarray
    held_out: bool


class CapturedViews(Protocol):
    """A list of views, or `StoredViews`, which reads each view on access: process one at a time."""

    def __len__(self) -> int: ...

    def __getitem__(self, index: int, /) -> CapturedView: ...

    def __iter__(self) -> Iterator[CapturedView]: ...


@dataclass(frozen=True)
class Photograph:
    """One photograph and its camera.

    Attributes:
        name: name in the capture, for messages.
        lens: lens of the camera; None if it depends on the size of the file (`field_of_view`).
        camera_to_world: (4, 4), camera axes as in `cameras`: x right, y up, z backwards; rotation and position only.
        held_out: whether it is for evaluation only; None if the capture does not specify it.
        field_of_view: horizontal field of view in radians, if there is no lens.
        scale: scale of the axes of the matrix in the file, which `camera_to_world` does not include.
    """

    name: str
    file: Path
    lens: Lens | None
    camera_to_world: np.ndarray
    mask: Path | None = None
    held_out: bool | None = None
    field_of_view: float = 0.0
    scale: float = 1.0


@dataclass(frozen=True)
class Capture:
    """Posed photographs.

    Attributes:
        kind: name of the format.
        photographs: at least one.
        axes: camera axes in the files, a key of `conventions.AXES`.
        world_to_camera: whether the files contain the inverse of a camera's pose.
        notices: one line for each omission or change.
    """

    folder: Path
    kind: str
    photographs: tuple[Photograph, ...]
    axes: str
    world_to_camera: bool
    notices: tuple[str, ...] = field(default=())
