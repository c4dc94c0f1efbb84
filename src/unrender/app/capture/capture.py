"""Contents of a folder of posed photographs, independent of the program that wrote it; conventions of camera axes; prepared views.

| name | x | y | z | written by |
|---|---|---|---|---|
| opengl | right | up | backwards | NeRF, instant-ngp, nerfstudio, Blender |
| opencv | right | down | forwards | COLMAP, OpenCV |
| llff | down | right | backwards | LLFF's `poses_bounds.npy` |
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from unrender.app.capture.cameras import Lens, rigid
from unrender.core.errors import InputError
from unrender.io.stored_pictures import PictureStore, StoredPicture

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


_NONE = np.zeros(0, np.float32)


class StoredViews:
    """Views in a temporary file, each read on access, so that memory does not grow with their number. Names, poses and lenses stay in
    memory."""

    def __init__(self, views: Iterable[CapturedView] = ()):
        self._store = PictureStore()
        self._views: list[tuple[CapturedView, StoredPicture, StoredPicture | None, StoredPicture]] = []
        for view in views:
            self.append(view)

    def append(self, view: CapturedView) -> None:
        add = self._store.add
        mask = None if view.mask is None else add(view.mask)
        bare = replace(view, values=_NONE, mask=None, shown=_NONE)
        self._views.append((bare, add(view.values), mask, add(view.shown)))

    def of(self, held_out: bool) -> StoredViews:
        """Return the held-out or the other views, which share the stored arrays."""
        subset = object.__new__(StoredViews)
        subset._store, subset._views = self._store, [each for each in self._views if each[0].held_out == held_out]
        return subset

    def bare(self) -> list[CapturedView]:
        """Return all views without masks, and with empty arrays in place of values and coverage."""
        return [view for view, *_ in self._views]

    @property
    def masked(self) -> list[bool]:
        return [mask is not None for _, _, mask, _ in self._views]

    def __len__(self) -> int:
        return len(self._views)

    def __getitem__(self, index: int) -> CapturedView:
        view, values, mask, shown = self._views[index]
        read = None if mask is None else np.asarray(mask)
        return replace(view, values=np.asarray(values), mask=read, shown=np.asarray(shown))

    def __iter__(self) -> Iterator[CapturedView]:
        return (self[index] for index in range(len(self)))


CapturedViews = list[CapturedView] | StoredViews
"""Views: process one at a time."""


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
    """Posed photographs, at least one, of a format. `axes` are the camera axes in the files, a key of `conventions.AXES`, whose matrices
    are inverse poses if `world_to_camera`."""

    folder: Path
    kind: str
    photographs: tuple[Photograph, ...]
    axes: str
    world_to_camera: bool
    notices: tuple[str, ...] = field(default=())


AXES = {
    "opengl": np.eye(3),
    "opencv": np.diag([1.0, -1.0, -1.0]),
    "llff": np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]),
}
"""Columns x, y and z of each convention, in the axes right, up, backwards."""


def pose(matrix: object, axes: str, world_to_camera: bool, where: str) -> tuple[np.ndarray, float]:
    """Return the matrix of a file as camera-to-world, (4, 4), with the axes right, up, backwards, and the removed scale of its axes.

    For a world-to-camera matrix [sR | t], the camera is at -Rᵀ t / s. Raises `InputError`.
    """
    camera, scale = rigid(matrix, where)
    if world_to_camera:
        with np.errstate(over="ignore"):
            camera[:3, 3] /= scale
        if not np.isfinite(camera).all():
            raise InputError(f"{where}: its axes are too short for its position")
        camera = _inverse(camera)
    camera[:3, :3] = camera[:3, :3] @ AXES[axes].T
    return camera, scale


def reinterpreted(capture: Capture, axes: str, world_to_camera: bool) -> Capture:
    """Return the capture for another convention of its files. Raise `InputError` for an unknown name of axes."""
    if axes not in AXES:
        raise InputError(f"axes: expected one of {', '.join(AXES)}, got {axes!r}")
    photographs = []
    for photograph in capture.photographs:
        stored = photograph.camera_to_world.copy()
        stored[:3, :3] = stored[:3, :3] @ AXES[capture.axes]
        if capture.world_to_camera:
            stored = _inverse(stored)
            stored[:3, 3] *= photograph.scale
        stored[:3, :3] *= photograph.scale
        moved, _ = pose(stored, axes, world_to_camera, photograph.name)
        photographs.append(replace(photograph, camera_to_world=moved))
    return replace(capture, photographs=tuple(photographs), axes=axes, world_to_camera=world_to_camera)


def _inverse(matrix: np.ndarray) -> np.ndarray:
    inverse = np.eye(4)
    inverse[:3, :3] = matrix[:3, :3].T
    inverse[:3, 3] = -matrix[:3, :3].T @ matrix[:3, 3]
    return inverse
