"""Meshes made in code: a sheet of quadrilaterals over a grid, flat, bulged or turned on a lathe."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np


def sheet(name: str, positions: np.ndarray, bsdf: dict[str, Any], closed: bool = False) -> Any:
    """A smooth mesh through a grid of points.

    Args:
        name: the mesh's id.
        positions: (rows, columns, 3); u runs from 0 to 1 along columns, v from 0 to 1 along rows. The front is where
            columns × rows points to.
        bsdf: its material.
        closed: whether the last column lies on the first one (with u = 1 there).

    Returns:
        `mitsuba.Mesh` with normals and texture coordinates; an entry of a scene dictionary.
    """
    rows, columns = positions.shape[:2]
    v, u = np.meshgrid(np.linspace(0, 1, rows), np.linspace(0, 1, columns), indexing="ij")
    number = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = number[:-1, :-1], number[:-1, 1:], number[1:, 1:], number[1:, :-1]
    faces = np.concatenate([np.stack([a, b, c], -1).reshape(-1, 3), np.stack([a, c, d], -1).reshape(-1, 3)])
    properties = mi.Properties()
    properties["bsdf"] = mi.load_dict(bsdf)
    mesh = mi.Mesh(name, rows * columns, len(faces), properties, has_vertex_normals=True, has_vertex_texcoords=True)
    parameters = mi.traverse(mesh)
    parameters["faces"] = mi.UInt32(faces.ravel().astype(np.uint32))
    parameters["vertex_positions"] = mi.Float(positions.ravel().astype(np.float32))
    parameters["vertex_texcoords"] = mi.Float(np.stack([u, v], -1).ravel().astype(np.float32))
    parameters.update()
    # In a second update: Mitsuba replaces the normals, with a crease at the seam, whenever positions change.
    parameters["vertex_normals"] = mi.Float(_normals(positions, closed).ravel().astype(np.float32))
    parameters.update()
    return mesh


def lathe(radius: np.ndarray, height: np.ndarray, columns: int) -> np.ndarray:
    """The points of a profile turned about the y axis: (rows, columns + 1, 3), closed, facing away from the axis.

    Args:
        radius, height: (rows,), of the profile, from bottom to top.
        columns: how many steps around; u = 0.5 looks towards +z, u = 0.75 towards +x, and the seam towards -z.
    """
    angle = np.linspace(-np.pi, np.pi, columns + 1)
    return np.stack(
        [
            radius[:, None] * np.sin(angle),
            np.broadcast_to(height[:, None], (len(height), columns + 1)),
            radius[:, None] * np.cos(angle),
        ],
        axis=-1,
    )


def _normals(positions: np.ndarray, closed: bool) -> np.ndarray:
    along_rows = np.gradient(positions, axis=0)
    if closed:
        around = np.concatenate([positions[:, -2:-1], positions, positions[:, 1:2]], axis=1)
        along_columns = np.gradient(around, axis=1)[:, 1:-1]
    else:
        along_columns = np.gradient(positions, axis=1)
    normals = np.cross(along_columns, along_rows)
    return normals / np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-12)
