"""Triangle meshes as PLY and OBJ files. Texture coordinates are Mitsuba's, v downwards; in the files v grows upwards."""

from __future__ import annotations

import numpy as np

__all__ = ["obj", "ply", "rows", "upwards"]


def ply(
    vertices: np.ndarray, faces: np.ndarray, normals: np.ndarray | None = None, uv: np.ndarray | None = None
) -> bytes:
    """Binary, little-endian: float32 coordinates, with normals and s, t where they are given.

    Args:
        vertices: (V, 3).
        faces: (F, 3), numbers of vertices.
        normals: (V, 3), unit.
        uv: (V, 2).
    """
    columns = [("xyz", vertices)]
    columns += [] if normals is None else [(("nx", "ny", "nz"), normals)]
    columns += [] if uv is None else [(("s", "t"), upwards(uv))]
    names = [name for group, _ in columns for name in group]
    table = np.concatenate([values for _, values in columns], 1).astype("<f4")
    corners = np.empty(len(faces), [("count", "u1"), ("corners", "<i4", 3)])
    corners["count"], corners["corners"] = 3, faces
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {len(table)}"]
    lines += [f"property float {name}" for name in names]
    lines += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header", ""]
    return "\n".join(lines).encode() + table.tobytes() + corners.tobytes()


def obj(vertices: np.ndarray, faces: np.ndarray, uv: np.ndarray | None = None) -> bytes:
    """Vertices, texture coordinates where they are given, and faces, as text with every bit of float32. Arguments as of `ply`."""
    lines = ["# written by unrender", *rows("v", vertices)]
    lines += [] if uv is None else rows("vt", upwards(uv))
    corners = faces.astype(np.int64) + 1
    words = corners.astype(str)
    words = words if uv is None else np.char.add(np.char.add(words, "/"), words)
    lines += ["f " + " ".join(corner) for corner in words.tolist()]
    return ("\n".join(lines) + "\n").encode()


def rows(kind: str, values: np.ndarray) -> list[str]:
    """Lines of an OBJ file."""
    return [f"{kind} " + " ".join(f"{x:.9g}" for x in row) for row in values.tolist()]


def upwards(uv: np.ndarray) -> np.ndarray:
    """Texture coordinates whose v grows the other way."""
    return np.stack([uv[:, 0], 1 - uv[:, 1]], 1)
