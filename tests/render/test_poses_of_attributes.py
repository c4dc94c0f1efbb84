"""Poses of meshes whose colours are attributes: those of vertices are refused, those of faces move with the mesh."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest

import unrender as ur

pytestmark = pytest.mark.mitsuba
_SHIFT = 0.3


def _scene(file: Path, name: str, shift: float = 0.0) -> dict[str, Any]:
    bsdf = {"type": "diffuse", "reflectance": {"type": "mesh_attribute", "name": name}}
    place = mi.ScalarTransform4f().translate([shift, 0, 0])
    to_world = mi.ScalarTransform4f().look_at([0, 0, 4], [0, 0, 0], [0, 1, 0])
    film = {"type": "hdrfilm", "width": 16, "height": 16, "rfilter": {"type": "box"}}
    return {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 3},
        "quad": {"type": "ply", "filename": str(file), "face_normals": True, "to_world": place, "bsdf": bsdf},
        "sky": {"type": "constant"},
        "sensor": {"type": "perspective", "fov": 40, "to_world": to_world, "film": film},
    }


def _file(folder: Path, name: str) -> Path:
    """Write two triangles with a colour for each vertex or face."""
    mesh: Any = mi.Mesh("quad", vertex_count=4, face_count=2, has_vertex_texcoords=False)
    values = mi.traverse(mesh)
    values["vertex_positions"] = [-1, -1, 0, 1, -1, 0, 1, 1, 0, -1, 1, 0]
    values["faces"] = [0, 1, 2, 0, 2, 3]
    values.update()
    colours = np.linspace(0.1, 0.9, 12 if name.startswith("vertex_") else 6).astype(np.float32)
    mesh.add_attribute(name, 3, colours)
    mesh.write_ply(str(folder / "quad.ply"))
    return folder / "quad.ply"


def test_a_mesh_with_colours_per_vertex_has_no_pose(tmp_path: Path) -> None:
    """Mitsuba interpolates them where the mesh was loaded: pictures differed from the moved mesh's by ten times their noise."""
    scene = _scene(_file(tmp_path, "vertex_color"), "vertex_color")
    problem = ur.Problem(scene, [ur.Parameter("quad.translation.x", initial=0.0)], [ur.View(np.zeros((16, 16, 3)))])
    with pytest.raises(ur.InputError, match=r"quad: .*vertex_color cannot be posed; use quad\.vertex_positions"):
        ur.render(problem, {"quad.translation.x": np.array(_SHIFT, np.float32)}, spp=4)


def test_colours_per_face_move_with_the_mesh(tmp_path: Path) -> None:
    file = _file(tmp_path, "face_color")
    unknown = ur.Parameter("quad.translation.x", initial=0.0)
    problem = ur.Problem(_scene(file, "face_color"), [unknown], [ur.View(np.zeros((16, 16, 3)))])
    ours = np.asarray(ur.render(problem, {"quad.translation.x": np.array(_SHIFT, np.float32)}, spp=256))
    moved = mi.load_dict(_scene(file, "face_color", _SHIFT))
    one, other = (np.array(mi.render(moved, spp=256, seed=mi.UInt32(seed))) for seed in (1, 2))
    noise = np.sqrt(np.mean((one - other) ** 2))
    assert np.sqrt(np.mean((ours - one) ** 2)) < 1.3 * noise
    still = np.array(mi.render(mi.load_dict(_scene(file, "face_color")), spp=256))
    assert np.sqrt(np.mean((still - one) ** 2)) > 5 * noise
