"""Preparation of photographs as views of a problem: undistortion, masks, and the held-out split.

Photographs become those of a pinhole camera with square pixels at a chosen resolution, which Mitsuba's `perspective` renders. Every
pixel of the result is divided into n x n parts, where n is the number of photograph pixels along one of its sides. Each part is
interpolated at its position under the lens model (bicubic), and the parts are averaged in linear values. Without distortion and for an
integer factor, the result is the mean of the photograph's pixels.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from unrender.app.capture import pictures
from unrender.app.capture.cameras import FISHEYE, Lens, opencv
from unrender.app.capture.capture import Capture, CapturedView, Photograph, StoredViews
from unrender.core.errors import InputError, prefixed
from unrender.core.text import printable

_EMPTY = 1e-4
_FULL_BORDER = 0.5
_LEAST_ALPHA = 1e-3
"""Alpha above which premultiplied colours are divided by it. It is less than half a level of the written masks; other colours become 0."""


def prepare(
    capture: Capture,
    resolution: int,
    scale: float | None,
    hold_out: int | None,
    progress: Callable[[int, int], None] = lambda done, count: None,
    response: str = pictures.SRGB,
    masks: bool = True,
) -> tuple[StoredViews, list[str]]:
    """Read, undistort and check all photographs, one by one. Results of the chosen resolution are stored in a temporary file.

    Args:
        capture: contents of the folder.
        resolution: maximum number of pixels along a view's longer side.
        scale: factor of each photograph's own resolution, at most 1, instead of `resolution`.
        hold_out: interval of held-out photographs, beginning with the first; 0 for none; None for the capture's own split, or 8.
        progress: function of the number of processed photographs and their total.
        response: response of files of 8 or 16 bits, see `pictures.decode`.
        masks: whether views have masks, from files or alpha. Without masks, colours are multiplied with alpha.

    Returns:
        The views in the capture's order, and notices.

    Raises:
        InputError: a photograph or mask cannot be read or does not fit its camera, some photographs have masks and others do not, or a
            mask is empty or inverted.
    """
    if scale is not None and not 0 < scale <= 1:
        raise InputError(f"--scale {scale:g}: expected more than 0 and at most 1")
    held_out = _split(capture.photographs, hold_out)
    views, looks = StoredViews(), []
    turned: list[str] = []
    for index, photograph in enumerate(capture.photographs):
        view, was_turned = _view(photograph, resolution, scale, held_out[index], response, masks)
        views.append(view)
        looks += [] if view.mask is None else [_Mask.of(view.name, view.mask)]
        turned += [photograph.name] if was_turned else []
        progress(index + 1, len(capture.photographs))
    without = [view.name for view, masked in zip(views.bare(), views.masked, strict=True) if not masked]
    if without and len(without) < len(views):
        raise InputError(f"{len(without)} of {len(views)} photographs have no mask, the first {printable(without[0])}")
    _check_masks(looks)
    notices = []
    if turned:
        notices.append(f"{len(turned)} photographs rotated by their EXIF orientation, the first {printable(turned[0])}")
    return views, notices


def _split(photographs: Sequence[Photograph], every: int | None) -> list[bool]:
    own = [photograph.held_out for photograph in photographs]
    if every is None and any(own) and not all(own):
        return [bool(held) for held in own]
    every = 8 if every is None else every
    if every == 1 or every < 0:
        raise InputError(
            f"--hold-out {every}: expected 0 for none, or at least 2: one of so many photographs is held out"
        )
    return [every > 0 and len(photographs) > every and index % every == 0 for index in range(len(photographs))]


def _view(
    photograph: Photograph, resolution: int, scale: float | None, held_out: bool, response: str, masks: bool
) -> tuple[CapturedView, bool]:
    width, height, orientation = pictures.upright(photograph.file, photograph.lens)
    with prefixed(photograph.file):
        lens = photograph.lens or Lens.of_field_of_view(photograph.field_of_view, width, height)
        lens = lens.scaled(width, height)
        target = pinhole(lens, min(1.0, resolution / max(width, height)) if scale is None else scale)
    read = pictures.read(photograph.file, orientation, response)
    if read.values.shape[:2] != (height, width):
        have = f"{read.values.shape[1]} x {read.values.shape[0]}"
        raise InputError(f"{photograph.file}: holds {have} pixels where its header says {width} x {height}")
    colours = read.values
    if read.alpha is not None and not (masks or read.premultiplied):
        colours = colours * read.alpha[..., None]
    values, shown = Resampling(lens, target).apply(colours)
    mask = None
    if masks and photograph.mask is not None:
        mask = _mask(photograph, lens, target, orientation)
    elif masks and read.alpha is not None:
        mask = Resampling(lens, target).apply(read.alpha[..., None])[0][..., 0]
        if read.premultiplied:
            values = np.divide(values, mask[..., None], out=np.zeros_like(values), where=mask[..., None] > _LEAST_ALPHA)
    view = CapturedView(photograph.name, target, photograph.camera_to_world, values, mask, shown, held_out)
    return view, orientation != 1


def _mask(photograph: Photograph, lens: Lens, target: Lens, orientation: int) -> np.ndarray:
    assert photograph.mask is not None
    values = pictures.read_mask(photograph.mask, 1)
    height, width = values.shape
    if orientation != 1 and abs(width / height - lens.width / lens.height) > 0.02 * lens.width / lens.height:
        values = pictures.read_mask(photograph.mask, orientation)  # with the photograph's orientation
        height, width = values.shape
    if abs(width * lens.height - height * lens.width) > max(lens.width, lens.height, width, height):
        has = f"{width} x {height} pixels, and its photograph {lens.width} x {lens.height}"
        raise InputError(f"{photograph.mask}: {has}: other proportions")
    return np.clip(Resampling(lens.scaled(width, height), target).apply(values[..., None])[0][..., 0], 0, 1)


@dataclass(frozen=True)
class _Mask:
    """Coverage of a mask: the fractions of the picture and of its edge."""

    name: str
    share: float
    edge: float

    @classmethod
    def of(cls, name: str, mask: np.ndarray) -> _Mask:
        edge = np.concatenate([mask[0], mask[-1], mask[:, 0], mask[:, -1]])
        return cls(name, float(mask.mean()), float(edge.mean()))


def _check_masks(masks: Sequence[_Mask]) -> None:
    empty = [mask.name for mask in masks if mask.share < _EMPTY]
    if empty:
        raise InputError(f"mask of {printable(empty[0])}: empty (black); {len(empty)} of {len(masks)} masks are so")
    full = [mask for mask in masks if mask.edge > _FULL_BORDER]
    if full:
        many = f"{len(full)} of {len(masks)} masks are so"
        what = f"white along {100 * full[0].edge:.0f} % of the picture's edge: inverted? expected white on the object"
        raise InputError(f"mask of {printable(full[0].name)}: {what}; {many}")


_MARGIN = 0.5  # maximum distance in photograph pixels of a position outside the centres of the outermost pixels
_SAMPLES = 4096
_SIDE = 8192
"""Maximum side of a tile. OpenCV's `remap` requires sides below 2^15, so larger results are computed in tiles."""


def pinhole(lens: Lens, scale: float) -> Lens:
    """Return the camera of the result: no distortion, square pixels, and `scale` times as many along each side, in (0, 1].

    The scale is exactly equal along both sides: a fractional last pixel is cropped. The focal length is the geometric mean of both. Raises
    `InputError` if no complete pixel remains along a side.
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
    """A resampling of the picture of a lens to that of a pinhole camera with square pixels, as from `pinhole`."""

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
        undistort = (cv2.fisheye if source.model == FISHEYE else cv2).initUndistortRectifyMap
        x, y = undistort(of, source.coefficients, np.eye(3), into, size, cv2.CV_32FC1)
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
    k = lens.coefficients
    if lens.model == FISHEYE:
        angle = np.arctan(r)
        image = angle * (1 + k[0] * angle**2 + k[1] * angle**4 + k[2] * angle**6 + k[3] * angle**8)
    else:
        image = r * (1 + k[0] * r**2 + k[1] * r**4 + k[4] * r**6) / (1 + k[5] * r**2 + k[6] * r**4 + k[7] * r**6)
    turns = np.flatnonzero(np.diff(image) <= 0)
    return float(r[turns[0]]) if len(turns) else math.inf
