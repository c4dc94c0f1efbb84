"""Mesh keys and arrays are those of Mitsuba 3.9 also where a mesh has the layout of 3.10: tensors, shared positions, other names."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from unrender.rendering.mitsuba import mesh_layout
from unrender.rendering.mitsuba.edges import edges_of
from unrender.rendering.mitsuba.parameters import is_of_vertices, normals_key
from unrender.rendering.mitsuba.scene_graph import ObjectGraph

SOURCE = Path(mesh_layout.__file__).parents[2]
# Two triangles of a square whose diagonal is a seam: six vertices, four positions.
POINTS = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], np.float32)
INDEX = np.array([0, 1, 2, 0, 2, 3], np.uint32)
CORNERS = np.array([[0, 1, 2], [3, 4, 5]], np.uint32)


def new_mesh() -> Any:
    """A mesh that has what Mitsuba 3.10 shows of one, and nothing of 3.9."""
    base: Any = mi.Object

    class NewMesh(base):
        def __init__(self) -> None:
            super().__init__()
            self.held = {
                "positions": mi.TensorXf(POINTS),
                "normals": mi.TensorXf(np.tile(np.array([0, 0, 1], np.float32), (6, 1))),
                "texcoords": mi.TensorXf(np.linspace(0, 1, 12, dtype=np.float32).reshape(6, 2)),
                "faces": mi.TensorXu(CORNERS),  # pyright: ignore[reportCallIssue]
                "position_index": mi.UInt32(INDEX),
                "vertex_color": mi.TensorXf(np.linspace(0, 1, 18, dtype=np.float32).reshape(6, 3)),
            }
            self.changed: list[set[str]] = []

        def traverse(self, callback: Any) -> None:
            for name, value in self.held.items():
                fixed = name in ("faces", "position_index")
                callback.put(name, value, mi.ParamFlags.NonDifferentiable if fixed else mi.ParamFlags.Differentiable)

        def parameters_changed(self, keys: Any) -> None:
            self.changed.append(set(keys))

        def positions(self) -> Any:
            return self.held["positions"]

        def geometric_faces(self) -> Any:
            return mi.TensorXu(INDEX[CORNERS.ravel()].reshape(-1, 3))  # pyright: ignore[reportCallIssue]

        def position_index(self) -> Any:
            return self.held["position_index"]

        def has_normals(self) -> bool:
            return True

        def has_texcoords(self) -> bool:
            return True

        def has_face_normals(self) -> bool:
            return False

    return NewMesh()


def holder(mesh: Any) -> Any:
    base: Any = mi.Object

    class Holder(base):
        def __init__(self) -> None:
            super().__init__()
            self.mesh = mesh

        def traverse(self, callback: Any) -> None:
            callback.put("square", self.mesh, mi.ParamFlags.Differentiable)

        def parameters_changed(self, keys: Any) -> None:
            del keys

    return Holder()


def test_keys_and_arrays_of_the_new_layout_are_those_of_the_old() -> None:
    found = ObjectGraph(holder(new_mesh())).parameters()
    names = ("vertex_positions", "vertex_normals", "vertex_texcoords", "faces", "position_index", "vertex_color")
    assert list(found.keys()) == [f"square.{name}" for name in names]
    sizes = {key.removeprefix("square."): dr.width(found[key]) for key in found.keys()}  # noqa: SIM118
    assert sizes == dict(zip(names, (12, 18, 12, 6, 6, 18), strict=True))
    assert isinstance(found["square.vertex_positions"], mi.Float)
    np.testing.assert_array_equal(np.array(found["square.vertex_positions"]), POINTS.ravel())
    assert is_of_vertices(found, "square.vertex_positions")
    assert is_of_vertices(found, "square.vertex_color")
    assert normals_key("square.vertex_positions") in found


def test_what_is_written_reaches_the_mesh_as_a_tensor_under_its_own_name_with_its_derivative() -> None:
    mesh = new_mesh()
    found = ObjectGraph(holder(mesh)).parameters()
    leaf = mi.Float(2 * POINTS.ravel())
    dr.enable_grad(leaf)
    found["square.vertex_positions"] = 3 * leaf
    found.update()
    assert mesh.changed == [{"positions"}]
    held = mesh.held["positions"]
    assert held.shape == (4, 3)
    np.testing.assert_allclose(held.numpy(), 6 * POINTS)
    dr.backward(dr.sum(held.array))
    np.testing.assert_array_equal(np.array(dr.grad(leaf)), np.full(12, 3.0))
    found["square.vertex_positions"] = mi.Float(np.zeros(15, np.float32))  # remeshed
    assert mesh.held["positions"].shape == (5, 3)


def test_what_a_mesh_of_the_new_layout_has() -> None:
    mesh = new_mesh()
    np.testing.assert_array_equal(np.array(mesh_layout.positions(mesh)), POINTS.ravel())
    np.testing.assert_array_equal(np.array(mesh_layout.faces(mesh)), [0, 1, 2, 0, 2, 3])
    np.testing.assert_array_equal(np.array(mesh_layout.vertex_positions(mesh)).reshape(-1, 3), POINTS[INDEX])
    assert mesh_layout.has_normals(mesh)
    assert mesh_layout.has_texcoords(mesh)
    edges = edges_of(mesh, None)
    assert len(edges.always) == 5
    assert edges.always.sum() == 4, "the seam of the texture is no border of the mesh"


def test_a_mesh_is_built_by_the_constructor_of_either_layout(monkeypatch: pytest.MonkeyPatch) -> None:
    texcoords, bsdf = POINTS[:, :2], mi.load_dict({"type": "diffuse"})
    faces = INDEX.reshape(2, 3)
    old = mesh_layout.build("square", POINTS, faces, None, texcoords, bsdf)
    values = mesh_layout.traverse(old)
    np.testing.assert_allclose(np.array(values["vertex_positions"]).reshape(-1, 3), POINTS)
    np.testing.assert_allclose(np.array(values["vertex_normals"]).reshape(-1, 3), [[0, 0, 1]] * 4, atol=1e-6)
    made: dict[str, Any] = {}

    class Recorder:
        geometric_faces = None

        def __init__(self, name: str, **arrays: Any):
            made.update(arrays, name=name)

        def set_bsdf(self, given: Any) -> None:
            made["bsdf"] = given

    monkeypatch.setattr(mi, "Mesh", Recorder)
    mesh_layout.build("square", POINTS, faces, None, texcoords, bsdf)
    assert (made["name"], made["bsdf"]) == ("square", bsdf)
    assert {name: value.shape for name, value in made.items() if dr.is_tensor_v(value)} == {
        "faces": (2, 3),
        "positions": (4, 3),
        "texcoords": (4, 2),
    }


def test_no_other_file_knows_the_layout() -> None:
    layout = re.compile(
        r'"vertex_(positions|normals|texcoords)"|(vertex|face)\w*_buffer\(\)|\.has_vertex_\w+\(|\bmi\.Mesh\(|geometric_faces'
    )
    others = [path for path in SOURCE.rglob("*.py") if path != Path(mesh_layout.__file__)]
    assert [path.name for path in others if layout.search(path.read_text())] == []
    assert layout.search(Path(mesh_layout.__file__).read_text())
