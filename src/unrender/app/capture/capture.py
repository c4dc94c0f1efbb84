"""What a folder of posed photographs holds, whatever program wrote it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

import numpy as np

from unrender.app.capture.cameras import Lens


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


@dataclass(frozen=True)
class Photograph:
    """One photograph and its camera.

    Attributes:
        name: as the capture calls it, for messages.
        file: where it is.
        lens: of the camera, None where the size of the file decides (`field_of_view`).
        camera_to_world: (4, 4), axes of the camera as `cameras` says: x right, y up, z backwards; rotation and position alone.
        mask: a file, None for none.
        held_out: whether it is for judging alone; None where the capture does not say.
        field_of_view: horizontal, in radians, where there is no lens.
        scale: of the axes of the matrix in the file, which `camera_to_world` is without.
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
        folder: where they are.
        kind: the name of the format.
        photographs: at least one.
        axes: of the cameras in the files, a key of `conventions.AXES`.
        world_to_camera: whether the files hold the inverse of a camera's pose.
        notices: one line for each thing that was left out or changed.
    """

    folder: Path
    kind: str
    photographs: tuple[Photograph, ...]
    axes: str
    world_to_camera: bool
    notices: tuple[str, ...] = field(default=())
