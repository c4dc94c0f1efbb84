"""Mesh files from the user as an option of gallery problems, normalised in size and position."""

from __future__ import annotations

from dataclasses import field
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

from unrender.core.errors import InputError
from unrender.rendering.mitsuba.description import load

_KINDS = (".ply", ".obj")


def option(about: str) -> Any:
    """Return a dataclass field: the path of a PLY or OBJ file, or "" for none."""
    return field(default="", metadata={"kind": str, "about": about, "check": _check})


def standing(path: str, bsdf: dict[str, Any]) -> dict[str, Any]:
    """Return the file as a Mitsuba dictionary: longest side 1, lowest point at y = 0, centred over the origin.

    Raises `InputError` if it cannot be read or has no extent.
    """
    low, high = _extent(path)
    scale = 1 / float(np.max(high - low))
    foot = np.array([(low[0] + high[0]) / 2, low[1], (low[2] + high[2]) / 2])
    return _placed(path, bsdf, scale, foot)


def centred(path: str, bsdf: dict[str, Any]) -> dict[str, Any]:
    """Return the file as a Mitsuba dictionary: longest side 2, centre of its bounding box at the origin.

    Raises `InputError` if it cannot be read or has no extent.
    """
    low, high = _extent(path)
    return _placed(path, bsdf, 2 / float(np.max(high - low)), (low + high) / 2)


def _placed(path: str, bsdf: dict[str, Any], scale: float, origin: np.ndarray) -> dict[str, Any]:
    to_world = mi.ScalarTransform4f().scale(scale) @ mi.ScalarTransform4f().translate((-origin).tolist())
    return {"type": _kind(path), "filename": path, "to_world": to_world, "bsdf": bsdf}


def _extent(path: str) -> tuple[np.ndarray, np.ndarray]:
    try:
        box = load({"type": _kind(path), "filename": path}).bbox()
    except Exception as error:
        reason = " ".join(str(error).split()).removeprefix(f"{path}: ")[:300]
        raise InputError(f"mesh {path}: Mitsuba could not read it: {reason}") from error
    low, high = (np.array(corner, float).reshape(3) for corner in (box.min, box.max))
    if not np.isfinite([low, high]).all() or np.max(high - low) <= 0:
        raise InputError(f"mesh {path}: expected vertices with some extent, got none")
    return low, high


def _kind(path: str) -> str:
    return Path(path).suffix.lower().removeprefix(".")


def _check(owner: str, name: str, value: Any) -> str:
    if not isinstance(value, (str, Path)):
        raise InputError(f"{owner}: {name} must be the path of a {' or '.join(_KINDS)} file, got {value!r}")
    if value == "":
        return ""
    if Path(value).suffix.lower() not in _KINDS:
        raise InputError(f"{owner}: {name} must be the path of a {' or '.join(_KINDS)} file, got {str(value)!r}")
    if not Path(value).is_file():
        raise InputError(f"{owner}: {name}: {value}: no such file")
    return str(value)
