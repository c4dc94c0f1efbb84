"""Maps as 8-bit pictures in the conventions of other programs, and the recovered values as files."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageDraw

from unrender.app.exporting.asset import Part
from unrender.app.exporting.ready_made import file_name
from unrender.display.pictures import quantized
from unrender.io import images
from unrender.io.resampling import upsample
from unrender.io.volumes import write_grid
from unrender.losses.metrics import srgb

FOLDER, RECORD, TABLE = "maps", "parameters.json", "parameters.csv"
_LARGEST = 64  # limit of the numbers of a parameter that are written as text


def write(
    parameters: Mapping[str, np.ndarray], folder: Path, related: Mapping[str, Mapping[str, np.ndarray]] | None = None
) -> list[str]:
    """Write parameters.json with all parameters, parameters.csv with those of at most 64 numbers, and maps/ with the others.

    Maps (H, W, C) become an EXR file with unchanged values, and a PNG file for viewing; volumes a .vol file; other large arrays a .npy
    file. Return a line for each PNG file with clipped values.

    Args:
        related: {name: {key: array}}, maps that belong to large parameters, such as standard errors: maps/<key>.<name>.exr, .vol or .npy.
    """
    notices: list[str] = []
    record: dict[str, Any] = {}
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(["parameter", "element", "value"])
    for key, values in parameters.items():
        value = np.asarray(values, np.float32)
        entry: dict[str, Any] = {"shape": list(value.shape)}
        if value.size <= _LARGEST and value.ndim < 3:
            entry["value"] = value.tolist()
            for index in np.ndindex(value.shape):
                table.writerow([key, " ".join(map(str, index)), float(value[index])])
        else:
            entry |= _large(key, value, folder)
            for name, of in (related or {}).items():
                if key in of:
                    entry[name] = _values(f"{_base(key)}.{name}", np.asarray(of[key], np.float32), folder)
            if entry.get("clipped"):
                notices.append(f"{key}: {entry['clipped']} values outside [0, 1] are clipped in {entry['files'][-1]}")
        record[key] = entry
    (folder / RECORD).write_text(json.dumps(record, indent=2) + "\n", encoding="utf-8")
    (folder / TABLE).write_text(text.getvalue(), encoding="utf-8")
    return notices


def _large(key: str, value: np.ndarray, folder: Path) -> dict[str, Any]:
    (folder / FOLDER).mkdir(exist_ok=True)
    base = _base(key)
    file = _values(base, value, folder)
    if value.ndim == 3 and value.shape[2] in (1, 3, 4):
        colour = value.shape[2] >= 3 and "normalmap" not in key
        shown = np.ascontiguousarray(value[..., :3] if value.shape[2] >= 3 else value[..., 0])
        levels = np.clip(srgb(shown) if colour else shown, 0, 1)
        Image.fromarray(np.round(255 * levels).astype(np.uint8)).save(folder / f"{base}.png")
        kind = "sRGB of values clipped to [0, 1]" if colour else "values clipped to [0, 1], linear"
        clipped = int(np.sum((shown < 0) | (shown > 1)))
        return {"files": [file, f"{base}.png"], "png": kind, "clipped": clipped}
    return {"files": [file]}


def _base(key: str) -> str:
    return f"{FOLDER}/{file_name(key.removesuffix('.data'))}"


def _values(base: str, value: np.ndarray, folder: Path) -> str:
    """Write an array as it is, and return the file's name."""
    if value.ndim == 3 and value.shape[2] in (1, 3, 4):
        images.write(value, folder / f"{base}.exr")
        return f"{base}.exr"
    if value.ndim == 4:
        write_grid(folder / f"{base}.vol", value)
        return f"{base}.vol"
    np.save(folder / f"{base}.npy", value, allow_pickle=False)
    return f"{base}.npy"


def base_colour(part: Part) -> np.ndarray:
    """Return the base colour as (H, W, 3) sRGB bytes; a constant has one texel."""
    colour = part.material.base_colour
    return quantized(srgb(colour if colour.ndim == 3 else colour.reshape(1, 1, 3)))


def grey(values: np.ndarray) -> np.ndarray:
    """Return a number or (H, W) values as (H, W) linear bytes; a constant has one texel."""
    return quantized(values if values.ndim == 2 else values.reshape(1, 1))


def metallic_roughness(part: Part) -> np.ndarray:
    """Return the map of glTF, (H, W, 3) linear bytes: red is 1, green is roughness, blue is metallic."""
    maps = [part.material.roughness, part.material.metallic]
    size = np.max([value.shape for value in maps if value.ndim == 2] or [(1, 1)], axis=0)
    large = [upsample(np.broadcast_to(x, x.shape or (1, 1))[..., None], size)[..., 0] for x in maps]
    return quantized(np.stack([np.ones(tuple(size)), *large], -1))


def normal_map(part: Part) -> np.ndarray | None:
    """Return the normal map as (H, W, 3) linear bytes; None without one.

    Green points upwards in the picture, the convention of OpenGL, glTF, OBJ and Blender. The second tangent of Mitsuba is n × ∂p/∂u;
    that of the other programs follows the picture. Therefore green is inverted where the texture coordinates of a face are mirrored.
    """
    values = part.material.normal_map
    if values is None:
        return None
    flipped = values.copy()
    mirrored = mirrored_texels(part, *values.shape[:2])
    flipped[mirrored, 1] = 1 - flipped[mirrored, 1]
    return quantized(flipped)


def mirrored_texels(part: Part, height: int, width: int) -> np.ndarray:
    """Return (H, W) booleans: whether the nearest face is mirrored, i.e. clockwise in the picture, whose origin is the upper left
    corner."""
    if part.uv is None:
        return np.zeros((height, width), bool)
    corners = (part.uv * [width, height])[part.faces]
    one, two = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    area = one[:, 0] * two[:, 1] - one[:, 1] * two[:, 0]  # v grows downwards: above 0 is clockwise on the picture
    kinds = (area > 0)[area != 0]
    if not len(kinds) or kinds.all() or not kinds.any():
        return np.full((height, width), bool(len(kinds) and kinds.all()))
    from scipy import ndimage

    picture = Image.new("L", (width, height), 0)
    draw = ImageDraw.Draw(picture)
    for triangle, value in zip(corners - 0.5, area, strict=True):
        draw.polygon([tuple(corner) for corner in triangle.tolist()], fill=2 if value > 0 else 1)
    label = np.array(picture)
    nearest: Any = ndimage.distance_transform_edt(label == 0, return_distances=False, return_indices=True)
    rows, columns = nearest
    return label[rows, columns] == 2
