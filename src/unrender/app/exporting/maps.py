"""The recovered values alone: pictures, volumes, and the small ones as text."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from unrender.app.exporting.ready_made import as_bitmap, file_name, write_bitmap
from unrender.io.volumes import write_grid
from unrender.losses.metrics import srgb

__all__ = ["write"]

FOLDER, RECORD, TABLE = "maps", "parameters.json", "parameters.csv"
_LARGEST = 64
"""Numbers of a parameter that are written out as text."""


def write(parameters: Mapping[str, np.ndarray], folder: Path) -> list[str]:
    """Write `parameters` to `folder`: parameters.json with all of them, parameters.csv with the small ones, maps/ with the large.

    Maps (H, W, C) become an EXR file with the values as they are, and a PNG file for the eye; volumes a .vol file; other large arrays
    a .npy file. Returns one line for each thing that a file does not show.
    """
    notices: list[str] = []
    record: dict[str, Any] = {}
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(["parameter", "element", "value"])
    for key, given in parameters.items():
        value = np.asarray(given, np.float32)
        entry: dict[str, Any] = {"shape": list(value.shape)}
        if value.size <= _LARGEST and value.ndim < 3:
            entry["value"] = value.tolist()
            for index in np.ndindex(value.shape):
                table.writerow([key, " ".join(map(str, index)), float(value[index])])
        else:
            entry |= _large(key, value, folder)
            if entry.get("clipped"):
                notices.append(f"{key}: {entry['clipped']} values outside [0, 1] are clipped in {entry['files'][-1]}")
        record[key] = entry
    (folder / RECORD).write_text(json.dumps(record, indent=2) + "\n", encoding="utf-8")
    (folder / TABLE).write_text(text.getvalue(), encoding="utf-8")
    return notices


def _large(key: str, value: np.ndarray, folder: Path) -> dict[str, Any]:
    (folder / FOLDER).mkdir(exist_ok=True)
    base = f"{FOLDER}/{file_name(key.removesuffix('.data'))}"
    if value.ndim == 3 and value.shape[2] in (1, 3, 4):
        write_bitmap(as_bitmap(value), folder / f"{base}.exr")
        colour = value.shape[2] >= 3 and "normalmap" not in key
        shown = np.ascontiguousarray(value[..., :3] if value.shape[2] >= 3 else value[..., 0])
        levels = np.clip(srgb(shown) if colour else shown, 0, 1)
        Image.fromarray(np.round(255 * levels).astype(np.uint8)).save(folder / f"{base}.png")
        kind = "sRGB of values clipped to [0, 1]" if colour else "values clipped to [0, 1], linear"
        clipped = int(np.sum((shown < 0) | (shown > 1)))
        return {"files": [f"{base}.exr", f"{base}.png"], "png": kind, "clipped": clipped}
    if value.ndim == 4:
        write_grid(folder / f"{base}.vol", value)
        return {"files": [f"{base}.vol"]}
    np.save(folder / f"{base}.npy", value, allow_pickle=False)
    return {"files": [f"{base}.npy"]}
