"""The pictures of a judgement: photographs beside renderings."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from unrender.app.evaluation import sheets
from unrender.app.evaluation.measures import Measures, shown
from unrender.app.exporting import ready_made
from unrender.losses import metrics
from unrender.scene.problem import Problem
from unrender.scene.view import View

__all__ = ["FOLDER", "SHEET", "mask_of", "names_of", "write"]

SHEET, FOLDER = "sheet.png", "pictures"
_DIFFERENCE = 4
_BORDER = 4


def mask_of(view: View) -> np.ndarray:
    """(H, W), above 0 where pixels count, of a view that was read."""
    return np.ones(np.asarray(view.reference).shape[:2], np.float32) if view.mask is None else np.asarray(view.mask)


def names_of(problem: Problem) -> list[str]:
    """Of the photographs: their files' without endings."""
    return [
        Path(view.reference).stem if isinstance(view.reference, (str, Path)) else f"view {index}"
        for index, view in enumerate(problem.given_views)
    ]


def write(
    folder: Path,
    problem: Problem,
    images: Sequence[np.ndarray],
    relit: Sequence[np.ndarray],
    measures: Sequence[Measures],
) -> None:
    """Write sheet.png, cropped to the masks, and pictures/ with whole pictures, as displayed and black outside the masks.

    Args:
        folder: exists.
        problem: whose views the pictures are of.
        images: to stand beside the photographs, linear (H, W, 3).
        relit: under another light, shown at one exposure of their own; none for differences in their place.
        measures: of `images`, for the labels; none where they were not measured.
    """
    (folder / FOLDER).mkdir()
    masks = [mask_of(view) for view in problem.views]
    level = 1.0
    if relit:
        level = metrics.exposure(np.concatenate([image[mask > 0] for image, mask in zip(relit, masks, strict=True)]))
    kinds = ("photograph", "rendering", "relit" if relit else "difference")
    rows = []
    for index, (name, view, mask) in enumerate(zip(names_of(problem), problem.views, masks, strict=True)):
        photograph = np.asarray(view.reference)
        rendered, wanted, _ = shown(images[index], photograph, mask)
        if relit:
            third, _, _ = shown(relit[index] * level, np.zeros_like(photograph), mask)
        else:
            third = np.clip(_DIFFERENCE * np.abs(rendered - wanted), 0, 1)
        cells = (wanted, rendered, third)
        if index < sheets.MOST_ROWS:
            box = _box(mask)
            label = _label(name, measures[index]) if measures else name
            rows.append((label, [cell[box] for cell in cells]))
        stem = f"{index:04d}-{ready_made.file_name(name)}"
        for kind, cell in zip(kinds, cells, strict=True):
            (folder / FOLDER / f"{stem}-{kind}.png").write_bytes(sheets.plain(cell))
    last = "under the other light" if relit else f"difference x {_DIFFERENCE}"
    (folder / SHEET).write_bytes(sheets.sheet(rows, ["photograph", "rendering", last]))


def _label(name: str, measures: Measures) -> str:
    return f"{name}  {measures.psnr:.2f} dB" + ("" if measures.ssim is None else f"  SSIM {measures.ssim:.3f}")


def _box(mask: np.ndarray) -> tuple[slice, slice]:
    """Rows and columns about a mask."""
    found = []
    for axis in (1, 0):
        inside = np.flatnonzero((mask > 0).any(axis))
        first, last = (inside[0], inside[-1] + 1) if len(inside) else (0, mask.shape[1 - axis])
        found.append(slice(max(int(first) - _BORDER, 0), int(last) + _BORDER))
    return found[0], found[1]
