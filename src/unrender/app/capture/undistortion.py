"""Undistortion of photographs to a pinhole camera with square pixels, at a chosen resolution: what Mitsuba's `perspective` renders.

Every pixel of the result is divided into n x n parts, where n is the number of photograph pixels along one of its sides. Each part is
interpolated at its position under the lens model (bicubic), and the parts are averaged in linear values. Without distortion and for an
integer factor, the result is the mean of the photograph's pixels.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from unrender.app.capture.cameras import FISHEYE, Lens, opencv
from unrender.core.errors import InputError

_MARGIN = 0.5
"""Maximum distance in photograph pixels of a position outside the centres of the outermost pixels."""
_SAMPLES = 4096
_SIDE = 8192
"""Maximum side of a tile. OpenCV's `remap` requires sides below 2^15, so larger results are computed in tiles."""


def pinhole(lens: Lens, scale: float) -> Lens:
    """Return the camera of the result: no distortion, square pixels, and `scale` times as many along each side, in (0, 1].

    The scale is exactly equal along both sides: a fractional last pixel is cropped. The focal length is the geometric mean of both.

    Raises:
        InputError: no complete pixel remains along a side.
    """
    width, height = (math.floor(scale * side + 1e-9) for side in (lens.width, lens.height))
    if min(width, height) < 1:
        raise InputError(
            f"{lens.width} x {lens.height} pixels at a scale of {scale:.3g} leave less than one along a side"
        )
    focal = scale * math.sqrt(lens.fx * lens.fy)
    return Lens(width, height, focal, focal, scale * lens.cx, scale * lens.cy)


@dataclass(frozen=True)
class Resampling:
    """A resampling of the picture of a lens to that of a pinhole camera.

    Attributes:
        target: pinhole of the result, with square pixels, as from `pinhole`.
    """

    source: Lens
    target: Lens

    @property
    def parts(self) -> int:
        """The number n of sub-pixels along each side of a pixel of the result."""
        return max(
            1, math.ceil(self.source.fx / self.target.fx - 1e-6), math.ceil(self.source.fy / self.target.fy - 1e-6)
        )

    @property
    def _has_integer_blocks(self) -> bool:
        """True if each pixel of the result consists of n x n pixels of the photograph."""
        focal = self.parts * self.target.fx
        same = math.isclose(self.source.fx, focal, rel_tol=1e-9) and math.isclose(self.source.fy, focal, rel_tol=1e-9)
        return same and not self.source.distorts

    def apply(self, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the result (h, w, C) of a picture (H, W, C), clamped to at least 0, and the fraction of each pixel inside the
        photograph, (h, w)."""
        height, width, n = self.target.height, self.target.width, self.parts
        if self._has_integer_blocks:
            blocks = values[: n * height, : n * width].reshape(height, n, width, n, -1)
            return blocks.mean((1, 3), dtype=np.float32), np.ones((height, width), np.float32)
        result = np.empty((height, width, values.shape[2]), np.float32)
        shown = np.empty((height, width), np.float32)
        rows = max(1, _SIDE // self.parts)
        columns = max(1, 4 * _SIDE // self.parts - 1)
        for top in range(0, height, rows):
            for left in range(0, width, columns):
                here = slice(top, min(top + rows, height)), slice(left, min(left + columns, width))
                result[here], shown[here] = self._part(values, here)
        return result, shown

    def _part(self, values: np.ndarray, here: tuple[slice, slice]) -> tuple[np.ndarray, np.ndarray]:
        cv2, n = opencv(), self.parts
        x, y, valid = self._map(*here)
        parts = cv2.remap(values, x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
        parts = np.maximum(parts.reshape(*x.shape, -1), 0) * valid[..., None]
        shape = x.shape[0] // n, n, x.shape[1] // n, n
        shown = valid.reshape(shape).mean((1, 3), dtype=np.float32)
        total = parts.reshape(*shape, -1).mean((1, 3))
        return total / np.maximum(shown, 1e-6)[..., None], shown

    def _map(self, rows: slice, columns: slice) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the positions of the parts of these pixels in the photograph, and whether they are inside it. As in OpenCV, the centre
        of the first pixel is 0."""
        cv2, n, source, target = opencv(), self.parts, self.source, self.target
        size = ((columns.stop - columns.start) * n, (rows.stop - rows.start) * n)
        into = np.array(
            [
                [n * target.fx, 0, n * (target.cx - columns.start) - 0.5],
                [0, n * target.fy, n * (target.cy - rows.start) - 0.5],
                [0, 0, 1],
            ]
        )
        of = np.array([[source.fx, 0, source.cx - 0.5], [0, source.fy, source.cy - 0.5], [0, 0, 1]])
        if source.model == FISHEYE:
            coefficients = np.array([*source.distortion, 0, 0, 0, 0][:4], float)
            x, y = cv2.fisheye.initUndistortRectifyMap(of, coefficients, np.eye(3), into, size, cv2.CV_32FC1)
        else:
            coefficients = np.array(source.distortion or (0.0,) * 4, float)
            coefficients = np.concatenate([coefficients, np.zeros(max(0, 8 - len(coefficients)))])
            x, y = cv2.initUndistortRectifyMap(of, coefficients, np.eye(3), into, size, cv2.CV_32FC1)
        inside = (
            (x >= -_MARGIN) & (x <= source.width - 1 + _MARGIN) & (y >= -_MARGIN) & (y <= source.height - 1 + _MARGIN)
        )
        if source.distorts:
            column = (np.arange(size[0]) + 0.5) / n + columns.start
            row = (np.arange(size[1]) + 0.5) / n + rows.start
            radius = np.hypot((column - target.cx) / target.fx, ((row - target.cy) / target.fy)[:, None])
            inside &= radius < _farthest(source, float(radius.max()))
        return x, y, inside


def _farthest(lens: Lens, within: float) -> float:
    """Return the tangent of the maximum angle to the axis, at most `within`, up to which the lens's radial mapping increases.

    A polynomial lens model decreases somewhere outside its picture, and would show the picture a second time there.
    """
    r = np.linspace(0, within, _SAMPLES)
    k = [*lens.distortion, *[0.0] * 8]
    if lens.model == FISHEYE:
        angle = np.arctan(r)
        image = angle * (1 + k[0] * angle**2 + k[1] * angle**4 + k[2] * angle**6 + k[3] * angle**8)
    else:
        image = r * (1 + k[0] * r**2 + k[1] * r**4 + k[4] * r**6) / (1 + k[5] * r**2 + k[6] * r**4 + k[7] * r**6)
    turns = np.flatnonzero(np.diff(image) <= 0)
    return float(r[turns[0]]) if len(turns) else math.inf
