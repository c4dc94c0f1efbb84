"""Pictures side by side on a sheet."""

from __future__ import annotations

import io
from collections.abc import Sequence

import numpy as np
from PIL import Image, ImageDraw

from unrender.core.text import printable
from unrender.losses.metrics import exposure, srgb

__all__ = ["MOST_ROWS", "environment_picture", "plain", "sheet"]

MOST_ROWS = 48
_CELL, _LABEL, _GAP = 240, 14, 4
_BACKGROUND, _INK = (20, 20, 20), (220, 220, 220)
_WIDE = 1024


def sheet(rows: Sequence[tuple[str, Sequence[np.ndarray]]], headings: Sequence[str]) -> bytes:
    """PNG: a row of pictures, (H, W, 3) in [0, 1], for each label; two rows side by side where there are many."""
    groups = 2 if len(rows) > 4 else 1
    count = len(headings)
    lines = -(-len(rows) // groups)
    width = groups * (count * (_CELL + _GAP) + 2 * _GAP)
    cells = [[_fitted(picture) for picture in pictures] for _, pictures in rows]
    tall = max(cell.height for line in cells for cell in line)
    page = Image.new("RGB", (width, _LABEL + _GAP + lines * (tall + _LABEL + _GAP)), _BACKGROUND)
    draw = ImageDraw.Draw(page)
    for group in range(groups):
        for column, heading in enumerate(headings):
            left = group * (width // groups) + column * (_CELL + _GAP)
            draw.text((left + 3, 1), heading, fill=_INK)
    for place, ((label, _), line) in enumerate(zip(rows, cells, strict=True)):
        top = _LABEL + _GAP + place // groups * (tall + _LABEL + _GAP)
        left = place % groups * (width // groups)
        draw.text((left + 3, top), printable(label).encode("latin-1", "replace").decode("latin-1"), fill=_INK)
        for column, cell in enumerate(line):
            page.paste(cell, (left + column * (_CELL + _GAP), top + _LABEL))
    return _encoded(page)


def environment_picture(values: np.ndarray) -> bytes:
    """PNG of an environment map (H, W, 3), exposed so that all but its brightest twentieth is seen; small ones enlarged."""
    picture = Image.fromarray(_bytes(srgb(values * exposure(values))))
    factor = max(1, _WIDE // picture.width)
    return _encoded(picture.resize((picture.width * factor, picture.height * factor), Image.Resampling.NEAREST))


def plain(picture: np.ndarray) -> bytes:
    """PNG of a picture (H, W, 3) in [0, 1]."""
    return _encoded(Image.fromarray(_bytes(picture)))


def _encoded(picture: Image.Image) -> bytes:
    buffer = io.BytesIO()
    picture.save(buffer, "PNG")
    return buffer.getvalue()


def _fitted(picture: np.ndarray) -> Image.Image:
    """As wide as a cell, pixels as squares where it is enlarged."""
    found = Image.fromarray(_bytes(picture))
    scale = _CELL / max(found.size)
    size = (max(1, round(found.width * scale)), max(1, round(found.height * scale)))
    return found.resize(size, Image.Resampling.NEAREST if scale > 1 else Image.Resampling.BOX)


def _bytes(picture: np.ndarray) -> np.ndarray:
    return (np.clip(picture, 0, 1) * 255 + 0.5).astype(np.uint8)
