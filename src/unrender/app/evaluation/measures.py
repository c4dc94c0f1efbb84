"""Error measures and pictures of renderings against photographs inside a mask of the object."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageDraw

from unrender.app.exporting import ready_made
from unrender.core.errors import InputError
from unrender.core.text import printable
from unrender.display.pictures import png, quantized
from unrender.losses import metrics
from unrender.losses.metrics import exposure, srgb
from unrender.scene.problem import Problem

_WINDOW = 7


@dataclass(frozen=True)
class Measures:
    """The measures of one photograph.

    Attributes:
        psnr: peak signal-to-noise ratio in dB over the pixels of the mask, as displayed; infinite for equal pictures.
        ssim: mean over the mask of the structural similarity with windows of 7 pixels, black outside the mask; None for pictures smaller
            than a window.
        lpips: LPIPS of the bounding box of the mask, black outside the mask; None if the network is missing or the box is too small.
        exposure: factor before the sRGB curve: 1 for photographs within [0, 1], otherwise that of `metrics.exposure`.
    """

    psnr: float
    ssim: float | None
    lpips: float | None
    exposure: float


@dataclass(frozen=True)
class Albedo:
    """The errors of a recovered base colour against the true one, over all pixels of the masks of all views.

    Light and base colour are determined only up to a factor for each channel. Therefore there are two errors: without and with the best
    factors.

    Attributes:
        rmse: root mean square error.
        scaled_rmse: root mean square error after multiplication by the factors.
        factors: factors of the channels by least squares.
    """

    rmse: float
    scaled_rmse: float
    factors: tuple[float, ...]


def shown(image: np.ndarray, photograph: np.ndarray, mask: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """Return both (H, W, 3) pictures as displayed, in [0, 1] and black outside the mask; and the exposure."""
    inside = mask[..., None] > 0
    counted = photograph[mask > 0]
    factor = 1.0 if counted.max(initial=0.0) <= 1 else metrics.exposure(counted)
    with np.errstate(over="ignore", invalid="ignore"):
        one, two = (metrics.srgb(np.where(inside, x, 0.0) * factor) for x in (image, photograph))
    return one, two, factor


def measure(image: np.ndarray, photograph: np.ndarray, mask: np.ndarray) -> Measures:
    """Return the measures of a rendering against a photograph, both linear (H, W, 3), with a mask (H, W) that is positive inside.

    Raises `InputError` if the mask is empty.
    """
    if not (mask > 0).any():
        raise InputError("a mask without a pixel")
    one, two, factor = shown(image, photograph, mask)
    error = float(np.mean((one - two)[mask > 0] ** 2))
    psnr = 10 * math.log10(1 / error) if error > 0 else math.inf
    rows, columns = np.nonzero(mask > 0)
    box = slice(rows.min(), rows.max() + 1), slice(columns.min(), columns.max() + 1)
    return Measures(psnr, _ssim(one, two, mask), metrics.distance(one[box], two[box]), factor)


def _ssim(one: np.ndarray, two: np.ndarray, mask: np.ndarray) -> float | None:
    from skimage.metrics import structural_similarity

    if min(mask.shape) < _WINDOW:
        return None
    similarity: Any = structural_similarity(two, one, data_range=1.0, channel_axis=2, win_size=_WINDOW, full=True)
    return float(similarity[1][mask > 0].mean())


def mean(measures: list[Measures]) -> dict[str, float | None]:
    """Return {name: mean over photographs}; None where a value is missing."""
    columns = {name: [asdict(each)[name] for each in measures] for name in ("psnr", "ssim", "lpips")}
    return {name: None if None in values else float(np.mean(values)) for name, values in columns.items()}


def best_factors(values: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Return the least squares factors (3,) of the channels that bring `values` (N, 3) closest to `truth`; 1 for a black channel."""
    squares = (values**2).sum(0)
    return np.where(squares > 0, (values * truth).sum(0) / np.maximum(squares, 1e-30), 1.0)


def compare_albedo(values: np.ndarray, truth: np.ndarray) -> Albedo:
    """Return the errors of the base colour of N pixels, (N, 3) in [0, 1]."""
    factors = best_factors(values, truth)
    rmse, scaled = (float(np.sqrt(np.mean((x - truth) ** 2))) for x in (values, values * factors))
    return Albedo(rmse, scaled, tuple(float(x) for x in factors))


MOST_ROWS = 48
_CELL, _LABEL, _GAP, _LETTERS = 240, 14, 4, 38
"""Sizes in pixels: width of a cell, height of a label, gaps; letters of a label that fit over a cell."""
_BACKGROUND, _INK = (20, 20, 20), (220, 220, 220)
_WIDE = 1024


def sheet(rows: Sequence[tuple[str, Sequence[Image.Image]]], headings: Sequence[str], groups: int) -> bytes:
    """Return a PNG of pictures of `fitted`: a row of as many as there are headings for each label, in `groups` columns of rows."""
    count = len(headings)
    lines = -(-len(rows) // groups)
    width = groups * (count * (_CELL + _GAP) + 2 * _GAP)
    tall = max(cell.height for _, line in rows for cell in line)
    page = Image.new("RGB", (width, _LABEL + _GAP + lines * (tall + _LABEL + _GAP)), _BACKGROUND)
    draw = ImageDraw.Draw(page)
    for column, heading in enumerate([*headings] * (groups if count > 1 else 1)):
        draw.text((column // count * (width // groups) + column % count * (_CELL + _GAP) + 3, 1), heading, fill=_INK)
    for place, (label, line) in enumerate(rows):
        top = _LABEL + _GAP + place // groups * (tall + _LABEL + _GAP)
        left = place % groups * (width // groups)
        text = printable(label).encode("latin-1", "replace").decode("latin-1")[: count * _LETTERS]
        draw.text((left + 3, top), text, fill=_INK)
        for column, cell in enumerate(line):
            page.paste(cell, (left + column * (_CELL + _GAP), top + _LABEL))
    return png(page)


def environment_picture(values: np.ndarray) -> bytes:
    """Return a PNG of an environment map (H, W, 3), exposed for all but the brightest 5 % of its texels; small maps are enlarged."""
    picture = Image.fromarray(quantized(srgb(values * exposure(values))))
    factor = max(1, _WIDE // picture.width)
    return png(picture.resize((picture.width * factor, picture.height * factor), Image.Resampling.NEAREST))


def fitted(picture: np.ndarray) -> Image.Image:
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


def write_pictures(
    folder: Path,
    problem: Problem,
    images: Sequence[np.ndarray],
    relit: Sequence[np.ndarray],
    measures: Sequence[Measures],
) -> None:
    """Write sheet.png, cropped to the masks, and pictures/ with full pictures, as displayed and black outside the masks.

    All renderings are linear (H, W, 3). Those under another light have one exposure of their own; without any, differences are shown.
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
            of = measures[index] if measures else None
            ssim = f"  SSIM {of.ssim:.3f}" if of is not None and of.ssim is not None else ""
            rows.append(
                (name if of is None else f"{name}  {of.psnr:.2f} dB{ssim}", [fitted(cell[box]) for cell in cells])
            )
        stem = f"{index:04d}-{ready_made.file_name(name)}"
        for kind, cell in zip(kinds, cells, strict=True):
            (folder / FOLDER / f"{stem}-{kind}.png").write_bytes(png(cell))
    last = "under the other light" if relit else f"difference x {_DIFFERENCE}"
    (folder / SHEET).write_bytes(sheet(rows, ["photograph", "rendering", last], 2 if len(rows) > 4 else 1))


def _box(mask: np.ndarray) -> tuple[slice, slice]:
    """Return the rows and columns of the bounding box of a mask, with a border."""
    slices = []
    for axis in (1, 0):
        inside = np.flatnonzero((mask > 0).any(axis))
        first, last = (inside[0], inside[-1] + 1) if len(inside) else (0, mask.shape[1 - axis])
        slices.append(slice(max(int(first) - _BORDER, 0), int(last) + _BORDER))
    return slices[0], slices[1]
