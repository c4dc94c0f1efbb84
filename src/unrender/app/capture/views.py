"""Preparation of photographs as views of a problem: undistortion, masks, and the held-out split."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from unrender.app.capture import pictures
from unrender.app.capture.cameras import Lens
from unrender.app.capture.capture import Capture, CapturedView, Photograph
from unrender.app.capture.stored import StoredViews
from unrender.app.capture.undistortion import Resampling, pinhole
from unrender.core.errors import InputError
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
    try:
        lens = photograph.lens or Lens.of_field_of_view(photograph.field_of_view, width, height)
        lens = lens.scaled(width, height)
        target = pinhole(lens, min(1.0, resolution / max(width, height)) if scale is None else scale)
    except InputError as error:
        raise InputError(f"{photograph.file}: {error}") from error
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
    """Raise `InputError` for masks that are empty or inverted: the object touches more than half of the picture's edge."""
    empty = [mask.name for mask in masks if mask.share < _EMPTY]
    if empty:
        raise InputError(f"mask of {printable(empty[0])}: empty (black); {len(empty)} of {len(masks)} masks are so")
    full = [mask for mask in masks if mask.edge > _FULL_BORDER]
    if full:
        many = f"{len(full)} of {len(masks)} masks are so"
        what = f"white along {100 * full[0].edge:.0f} % of the picture's edge: inverted? expected white on the object"
        raise InputError(f"mask of {printable(full[0].name)}: {what}; {many}")
