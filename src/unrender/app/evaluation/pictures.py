"""The pictures of an evaluation: photographs next to renderings."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

from unrender.app.evaluation.measures import Measures, shown
from unrender.app.exporting import ready_made
from unrender.core.text import printable
from unrender.display.pictures import png, quantized
from unrender.losses import metrics
from unrender.losses.metrics import exposure, srgb
from unrender.scene.problem import Problem

MOST_ROWS = 48
_CELL, _LABEL, _GAP = 240, 14, 4
_BACKGROUND, _INK = (20, 20, 20), (220, 220, 220)
_WIDE = 1024


def sheet(rows: Sequence[tuple[str, Sequence[np.ndarray]]], headings: Sequence[str]) -> bytes:
    """Return a PNG with a row of pictures, (H, W, 3) in [0, 1], for each label; more than four rows form two columns."""
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
    return png(page)


def environment_picture(values: np.ndarray) -> bytes:
    """Return a PNG of an environment map (H, W, 3), exposed for all but the brightest 5 % of its texels; small maps are enlarged."""
    picture = Image.fromarray(quantized(srgb(values * exposure(values))))
    factor = max(1, _WIDE // picture.width)
    return png(picture.resize((picture.width * factor, picture.height * factor), Image.Resampling.NEAREST))


def _fitted(picture: np.ndarray) -> Image.Image:
    """Resize a picture to the width of a cell; enlarged pixels remain squares."""
    image = Image.fromarray(quantized(picture))
    scale = _CELL / max(image.size)
    size = (max(1, round(image.width * scale)), max(1, round(image.height * scale)))
    return image.resize(size, Image.Resampling.NEAREST if scale > 1 else Image.Resampling.BOX)


SHEET, FOLDER = "sheet.png", "pictures"
_DIFFERENCE = 4
_BORDER = 4


def names_of(problem: Problem) -> list[str]:
    """Return the names of the photographs: file names without extension."""
    return [
        Path(view.reference).stem if isinstance(view.reference, (str, Path)) else f"view {index}"
        for index, view in enumerate(problem.original_views)
    ]


def write(
    folder: Path,
    problem: Problem,
    images: Sequence[np.ndarray],
    relit: Sequence[np.ndarray],
    measures: Sequence[Measures],
) -> None:
    """Write sheet.png, cropped to the masks, and pictures/ with full pictures, as displayed and black outside the masks.

    Args:
        folder: an existing folder.
        images: renderings, linear (H, W, 3).
        relit: renderings under another light, with one exposure of their own; empty to show differences instead.
        measures: measures of `images` for the labels; empty if they were not measured.
    """
    (folder / FOLDER).mkdir()
    masks = [view.pixel_weights() for view in problem.views]
    level = 1.0
    if relit:
        level = metrics.exposure(np.concatenate([image[mask > 0] for image, mask in zip(relit, masks, strict=True)]))
    kinds = ("photograph", "rendering", "relit" if relit else "difference")
    rows = []
    for index, (name, view, mask) in enumerate(zip(names_of(problem), problem.views, masks, strict=True)):
        photograph = np.asarray(view.reference)
        rendered, target, _ = shown(images[index], photograph, mask)
        if relit:
            third, _, _ = shown(relit[index] * level, np.zeros_like(photograph), mask)
        else:
            third = np.clip(_DIFFERENCE * np.abs(rendered - target), 0, 1)
        cells = (target, rendered, third)
        if index < MOST_ROWS:
            box = _box(mask)
            label = _label(name, measures[index]) if measures else name
            rows.append((label, [cell[box] for cell in cells]))
        stem = f"{index:04d}-{ready_made.file_name(name)}"
        for kind, cell in zip(kinds, cells, strict=True):
            (folder / FOLDER / f"{stem}-{kind}.png").write_bytes(png(cell))
    last = "under the other light" if relit else f"difference x {_DIFFERENCE}"
    (folder / SHEET).write_bytes(sheet(rows, ["photograph", "rendering", last]))


def _label(name: str, measures: Measures) -> str:
    return f"{name}  {measures.psnr:.2f} dB" + ("" if measures.ssim is None else f"  SSIM {measures.ssim:.3f}")


def _box(mask: np.ndarray) -> tuple[slice, slice]:
    """Return the rows and columns of the bounding box of a mask, with a border."""
    slices = []
    for axis in (1, 0):
        inside = np.flatnonzero((mask > 0).any(axis))
        first, last = (inside[0], inside[-1] + 1) if len(inside) else (0, mask.shape[1 - axis])
        slices.append(slice(max(int(first) - _BORDER, 0), int(last) + _BORDER))
    return slices[0], slices[1]
