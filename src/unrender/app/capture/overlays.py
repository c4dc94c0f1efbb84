"""Overlays to check a capture: the mesh, its edges and the outline of the mask over each photograph."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from PIL import Image, ImageDraw

from unrender.app.capture.capture import CapturedView
from unrender.app.capture.silhouettes import Silhouettes
from unrender.core.text import printable
from unrender.display.pictures import png, quantized
from unrender.losses.metrics import srgb

LEGEND = "orange: the mesh and its edges; blue: the outline of the mask; dimmed: outside the mesh"
_MESH, _MASK = np.array([1.0, 0.55, 0.05]), np.array([0.1, 0.55, 1.0])
_SMALLEST = 320
"""Minimum number of pixels along the shorter side of an overlay."""
_TINT = 0.3
_CREASE = math.cos(math.radians(50))
_LARGEST_SHEET = 48
_CELL = 240
_LABEL = 14


def overlay(view: CapturedView, silhouettes: Silhouettes) -> np.ndarray:
    """Return an overlay (h, w, 3) in [0, 1], sRGB, enlarged by an integer factor for small views."""
    factor = max(1, math.ceil(_SMALLEST / max(1, min(view.lens.width, view.lens.height))))
    lens = view.lens.scaled(factor * view.lens.width, factor * view.lens.height)
    normals, distances = silhouettes.normals(lens, view.camera_to_world)
    inside = np.any(normals != 0, -1)
    photograph = np.repeat(np.repeat(srgb(view.values * _exposure(view)), factor, 0), factor, 1)
    shading = 0.35 + 0.65 * np.clip(np.abs(normals[..., 2:]), 0, 1)
    tinted = (1 - _TINT) * photograph + _TINT * shading * _MESH
    picture = np.where(inside[..., None], tinted, 0.6 * photograph)
    picture[_creases(normals, distances, inside)] *= 0.55
    picture[_outline(inside)] = _MESH
    if view.mask is not None:
        picture[_outline(_enlarged(view.mask, factor) > 0.5)] = _MASK
    return np.clip(picture, 0, 1)


def chosen(count: int) -> list[int]:
    """Return the indices of at most 48 evenly spaced pictures for a contact sheet."""
    return np.unique(np.linspace(0, count - 1, min(count, _LARGEST_SHEET)).round().astype(int)).tolist()


def thumbnail(picture: np.ndarray) -> Image.Image:
    """Return a picture with values in [0, 1] as an 8-bit thumbnail."""
    small = Image.fromarray(quantized(picture))
    small.thumbnail((_CELL - 4, _CELL - 4), Image.Resampling.BOX)
    return small


def contact_sheet(thumbnails: Sequence[Image.Image], labels: Sequence[str]) -> bytes:
    """Return the pictures with their labels as a PNG file."""
    columns = min(8, math.ceil(math.sqrt(len(thumbnails))))
    rows = math.ceil(len(thumbnails) / columns)
    sheet = Image.new("RGB", (columns * _CELL, rows * (_CELL + _LABEL) + _LABEL), (20, 20, 20))
    draw = ImageDraw.Draw(sheet)
    draw.text((3, 1), LEGEND, fill=(220, 220, 220))
    for place, (small, label) in enumerate(zip(thumbnails, labels, strict=True)):
        left, top = place % columns * _CELL, place // columns * (_CELL + _LABEL) + _LABEL
        sheet.paste(small, (left + 2, top + _LABEL))
        draw.text((left + 3, top + 1), _latin(label), fill=(220, 220, 220))
    return png(sheet)


def _exposure(view: CapturedView) -> float:
    level = float(np.percentile(view.values if view.mask is None else view.values[view.mask > 0.5], 97))
    return min(0.8 / level, 16.0) if level > 0 else 1.0


def _enlarged(mask: np.ndarray, factor: int) -> np.ndarray:
    return np.repeat(np.repeat(mask, factor, 0), factor, 1)


def _outline(inside: np.ndarray) -> np.ndarray:
    """Return the pixels inside that have a neighbour outside."""
    padded = np.pad(inside, 1, mode="edge")
    surrounded = padded[:-2, 1:-1] & padded[2:, 1:-1] & padded[1:-1, :-2] & padded[1:-1, 2:]
    return inside & ~surrounded


def _creases(normals: np.ndarray, distances: np.ndarray, inside: np.ndarray) -> np.ndarray:
    """Return the pixels where, from one pixel to the next, normals change by more than 50° or depth is discontinuous."""
    edges = np.zeros(inside.shape, bool)
    for axis in (0, 1):
        here, there = [slice(None)] * 2, [slice(None)] * 2
        here[axis], there[axis] = slice(0, -1), slice(1, None)
        a, b = tuple(here), tuple(there)
        both = inside[a] & inside[b]
        edges[a] |= both & ((normals[a] * normals[b]).sum(-1) < _CREASE)
        edges[a] |= both & (np.abs(distances[a] - distances[b]) > 0.06)
    return edges


def _latin(text: str) -> str:
    return printable(text).encode("latin-1", "replace").decode("latin-1")[:38]
