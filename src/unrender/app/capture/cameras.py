"""Cameras: lens models, and the projection of world points to pictures.

A camera's axes are x right, y up, z backwards (it looks along -z), right-handed, as in OpenGL. Positions in a picture are in pixels
from its upper left corner, x to the right and y down, so that the middle of the first pixel is (0.5, 0.5). In coordinates x/z, y/z of a
camera that looks along +z with y down, OpenCV's models of distortion apply.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from unrender.core.errors import InputError
from unrender.core.text import printable

RADIAL_TANGENTIAL, FISHEYE = "radial-tangential", "fisheye"
MODELS = (RADIAL_TANGENTIAL, FISHEYE)
_MOST_COEFFICIENTS = {RADIAL_TANGENTIAL: 8, FISHEYE: 4}
_NARROWEST, _WIDEST = 1e-3, 1e6
_LONGEST_SIDE = 1 << 31
_LAST_ROW = 1e-6


@dataclass(frozen=True)
class Lens:
    """A perspective camera with OpenCV's distortion.

    Attributes:
        width, height: size of the picture in pixels.
        fx, fy: focal lengths in pixels.
        cx, cy: principal point, in pixels from the upper left corner.
        model: "radial-tangential" (k1, k2, p1, p2, k3, k4, k5, k6) or "fisheye" (k1, k2, k3, k4).
        distortion: coefficients of the model; missing ones are 0.

    Raises `InputError` for a value out of range.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    model: str = RADIAL_TANGENTIAL
    distortion: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        numbers = (self.fx, self.fy, self.cx, self.cy, *self.distortion)
        if not all(math.isfinite(number) for number in numbers):
            raise InputError("camera: expected finite numbers")
        if not all(1 <= side <= _LONGEST_SIDE for side in (self.width, self.height)):
            got = f"{str(self.width)[:20]} x {str(self.height)[:20]}"
            raise InputError(f"camera: expected a width and height of 1 to {_LONGEST_SIDE} pixels, got {got}")
        for name, value, side in (("fx", self.fx, self.width), ("fy", self.fy, self.height)):
            if not _NARROWEST < value / side < _WIDEST:
                raise InputError(f"camera: {name}: expected a focal length in pixels, got {value:g} for {side} pixels")
        if self.model not in MODELS:
            raise InputError(f"camera: model: expected one of {', '.join(MODELS)}, got {self.model!r}")
        if len(self.distortion) > _MOST_COEFFICIENTS[self.model]:
            raise InputError(f"camera: at most {_MOST_COEFFICIENTS[self.model]} coefficients of a {self.model} lens")

    @property
    def distorts(self) -> bool:
        """True if straight lines are curved in the picture."""
        return self.model == FISHEYE or any(self.distortion)

    @property
    def coefficients(self) -> np.ndarray:
        """All coefficients of the model in OpenCV's order, (8,) or (4,) of a fisheye."""
        return np.array([*self.distortion, *[0.0] * 8][: _MOST_COEFFICIENTS[self.model]], float)

    def scaled(self, width: int, height: int) -> Lens:
        """Return the lens of the same picture at another size of the same aspect ratio."""
        x, y = width / self.width, height / self.height
        return replace(self, width=width, height=height, fx=self.fx * x, fy=self.fy * y, cx=self.cx * x, cy=self.cy * y)

    @classmethod
    def of_field_of_view(cls, radians: float, width: int, height: int) -> Lens:
        """Return a lens with square pixels, a centred principal point, and a horizontal field of view in radians."""
        if not 1 / _WIDEST < radians < math.pi:
            limits = f"more than {1 / _WIDEST:g} and less than π radians"
            raise InputError(f"camera: expected a horizontal angle of view of {limits}, got {radians:g}")
        focal = width / (2 * math.tan(radians / 2))
        return cls(width, height, focal, focal, width / 2, height / 2)


def project(lens: Lens, camera_to_world: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return positions (N, 2) in pixels and depths (N,) in front of the camera of world points. Positions behind it are undefined."""
    local = (np.asarray(points, float) - camera_to_world[:3, 3]) @ camera_to_world[:3, :3]
    depth = -local[:, 2]
    safe = np.where(depth > 0, depth, 1.0)
    normalised = np.stack([local[:, 0] / safe, -local[:, 1] / safe], 1)
    focal, centre = np.array([lens.fx, lens.fy]), np.array([lens.cx, lens.cy])
    if not lens.distorts:
        return normalised * focal + centre, depth
    cv2 = opencv()
    matrix = np.array([[lens.fx, 0, lens.cx], [0, lens.fy, lens.cy], [0, 0, 1.0]])
    if lens.model == FISHEYE:
        return cv2.fisheye.distortPoints(normalised[None], matrix, lens.coefficients)[0], depth
    rays = np.concatenate([normalised, np.ones((len(normalised), 1))], 1)
    none = np.zeros(3)
    return cv2.projectPoints(rays, none, none, matrix, lens.coefficients)[0].reshape(-1, 2), depth


def rigid(matrix: Any, where: str) -> tuple[np.ndarray, float]:
    """Return [R | t], (4, 4), and the scale s of a 3 x 4 or 4 x 4 matrix [sR | t]. A last row of 0 0 0 w divides all others by w.

    Raises:
        InputError: the matrix is not finite, its axes are not orthogonal and of equal length within 2 %, it is mirrored, or its last row
            is different.
    """
    try:
        array = np.asarray(matrix, float)
    except (TypeError, ValueError, OverflowError) as error:
        raise InputError(f"{where}: expected a matrix of numbers") from error
    if array.shape not in ((3, 4), (4, 4)):
        got = "missing" if matrix is None else f"got shape {array.shape}"
        raise InputError(f"{where}: expected a matrix of 3 x 4 or 4 x 4 numbers, {got}")
    if not np.isfinite(array).all():
        raise InputError(f"{where}: expected a matrix of finite numbers, got {array[~np.isfinite(array)][0]}")
    if len(array) == 4:
        *rest, last = array[3]
        if not np.abs(rest).max() <= _LAST_ROW * abs(last) or not last:
            raise InputError(f"{where}: its last row is {printable(array[3].tolist())}, expected 0 0 0 1")
        with np.errstate(over="ignore"):
            array = array / last
    largest = float(np.abs(array[:3, :3]).max())
    if not 0 < largest < math.inf or not np.isfinite(array).all():
        raise InputError(f"{where}: its first three columns are not a rotation")
    axes = array[:3, :3] / largest  # avoids overflow in products
    determinant = float(np.linalg.det(axes))
    length = abs(determinant) ** (1 / 3)
    if length == 0 or np.abs(axes.T @ axes / length**2 - np.eye(3)).max() > 0.02:
        raise InputError(f"{where}: its first three columns are not a rotation")
    if determinant < 0:
        raise InputError(f"{where}: its axes are left-handed (determinant {determinant:.3g}): one axis is mirrored")
    u, _, v = np.linalg.svd(axes)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = u @ v, array[:3, 3]
    return pose, length * largest


def opencv() -> Any:
    """Return the module `cv2`. Raise `InputError` with installation instructions if it is missing."""
    try:
        import cv2
    except ImportError as error:
        raise InputError(f"photographs need OpenCV ({error}): pip install 'unrender[capture]'") from error
    return cv2
