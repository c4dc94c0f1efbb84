"""Panels of rotating meshes: start, result and truth side by side, by WebGL, or as a picture without WebGL."""

from __future__ import annotations

import base64
from dataclasses import dataclass

import numpy as np

from unrender.core.rotations import rotation
from unrender.display import formatting
from unrender.display.pictures import data_uri
from unrender.runs.folder.reader import RunFolder
from unrender.scene.surfaces import area_normals

MOST_FACES = 200_000
"""Limit of the faces of all meshes of a panel; larger meshes are not shown."""
_STEPS = (1 << 16) - 1
"""Number of quantisation steps of the positions along each side of the bounding cube of all meshes."""
_SIZE = 280
"""Width and height of each mesh in the picture, in pixels."""
_TURN, _TILT = 0.6, 0.35
"""Angles of the picture and of the first view, in radians: about the vertical, and downwards."""


@dataclass(frozen=True)
class Solid:
    """A mesh in the encoding of the page.

    Attributes:
        label: name of the mesh: "Start", "Recovered" or "Truth".
        positions: base64 of uint16 (V, 3), little-endian: 0 to 65535 along each side of the bounding cube that all meshes share.
        faces: base64 of uint32 (F, 3).
    """

    label: str
    positions: str
    faces: str


@dataclass(frozen=True)
class ShapePanel:
    """Meshes that rotate together.

    Attributes:
        title, note: text above the meshes.
        solids: meshes from left to right; empty if they are too large or not finite.
        picture: data URI of a PNG of all meshes side by side, from the first point of view.
        width, height: size of the picture.
    """

    title: str
    note: str
    solids: tuple[Solid, ...]
    picture: str = ""
    width: int = 0
    height: int = 0


def panel(run: RunFolder, key: str) -> ShapePanel:
    """Return the panel of a mesh whose vertex positions are a parameter: start, result and, where it is known, truth."""
    mesh = run.meshes[key]
    shown = {"Start": (run.initial[key], mesh.first_faces), "Recovered": (run.parameters[key], mesh.faces)}
    if mesh.truth is not None:
        shown["Truth"] = (mesh.truth.vertices, mesh.truth.faces)
    solids = {label: (np.asarray(x, np.float64).reshape(-1, 3), faces) for label, (x, faces) in shown.items()}
    count = f"{len(run.parameters[key]) // 3} vertices, {len(mesh.faces)} faces"
    if sum(len(faces) for _, faces in solids.values()) > MOST_FACES:
        return ShapePanel(key, f"{count}: too large to be shown here; see meshes/", ())
    if not all(np.isfinite(vertices).all() for vertices, _ in solids.values()):
        return ShapePanel(key, f"{count}; not finite", ())
    before, after = run.error_before.get(key), run.error_after.get(key)
    if before is not None and after is not None:
        count += (
            f"; distance from the truth {formatting.number(after)}, from {formatting.number(before)} (root mean square)"
        )
    every = np.concatenate([vertices for vertices, _ in solids.values()])
    low, high = every.min(axis=0), every.max(axis=0)
    middle, half = (low + high) / 2, max(float((high - low).max()) / 2, 1e-12)
    placed = {label: ((vertices - middle) / half, faces) for label, (vertices, faces) in solids.items()}
    packed = tuple(
        Solid(label, _packed((vertices + 1) / 2 * _STEPS + 0.5, "<u2"), _packed(faces, "<u4"))
        for label, (vertices, faces) in placed.items()
    )
    return ShapePanel(key, count, packed, _picture(list(placed.values())), _SIZE * len(placed), _SIZE)


def _packed(values: np.ndarray, kind: str) -> str:
    return base64.b64encode(np.ascontiguousarray(values).astype(kind).tobytes()).decode("ascii")


def _picture(solids: list[tuple[np.ndarray, np.ndarray]]) -> str:
    from PIL import Image, ImageDraw

    image = Image.new("RGBA", (_SIZE * len(solids), _SIZE))
    draw = ImageDraw.Draw(image)
    turn = rotation((1, 0, 0), _TILT) @ rotation((0, 1, 0), -_TURN)
    for number, (vertices, faces) in enumerate(solids):
        rotated = vertices @ turn.T
        normals = area_normals(rotated, faces)
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
        shade = 0.25 + 0.65 * np.abs(normals @ np.array([0.36, 0.48, 0.8]))
        at = _SIZE * (0.5 + rotated[:, :2] * [0.29, -0.29]) + [_SIZE * number, 0]
        for face in np.argsort(rotated[faces][:, :, 2].sum(axis=1)):  # painter's algorithm: the farthest face first
            grey = int(255 * shade[face])
            draw.polygon([tuple(p) for p in at[faces[face]].tolist()], fill=(grey, grey, grey, 255))
    return data_uri(image)
