"""Poses of meshes whose colours are attributes of vertices or faces, which move with the mesh."""

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


@pytest.mark.parametrize("name", ["vertex_color", "face_color"])
def test_colours_move_with_the_mesh(name: str, tmp_path: Path) -> None:
    """Mitsuba interpolates those of vertices where the mesh was loaded: such pictures differ by ten times their noise."""
    file, key = _file(tmp_path, name), "quad.translation.x"
    problem = ur.Problem(_scene(file, name), [ur.Parameter(key, initial=0.0)], [ur.View(np.zeros((16, 16, 3)))])
    ours = np.asarray(ur.render(problem, {key: np.array(_SHIFT, np.float32)}, spp=256))
    moved = mi.load_dict(_scene(file, name, _SHIFT))
    one, other = (np.array(mi.render(moved, spp=256, seed=mi.UInt32(seed))) for seed in (1, 2))
    noise = np.sqrt(np.mean((one - other) ** 2))
    assert np.sqrt(np.mean((ours - one) ** 2)) < 1.3 * noise
    still = np.array(mi.render(mi.load_dict(_scene(file, name)), spp=256))
    assert np.sqrt(np.mean((still - one) ** 2)) > 5 * noise


@pytest.mark.slow
def test_a_place_and_colours_of_vertices_are_recovered(tmp_path: Path) -> None:
    """Perturbed renders and path gradients evaluate the colours of the moved mesh. The reference is Mitsuba's."""
    file, key = _file(tmp_path, "vertex_color"), "quad.translation.x"
    reference = np.array(mi.render(mi.load_dict(_scene(file, "vertex_color", _SHIFT)), spp=1024))
    unknown = [ur.Parameter(key, initial=0.2), ur.Parameter("quad.vertex_color", initial=0.5)]
    problem = ur.Problem(_scene(file, "vertex_color"), unknown, [ur.View(reference)], max_depth=3)
    result = ur.optimize(problem, "hybrid", steps=60, progress=False)
    error = np.abs(np.ravel(result.parameters["quad.vertex_color"]) - np.linspace(0.1, 0.9, 12))
    assert abs(float(result.parameters[key]) - _SHIFT) < 0.03
    assert error.mean() < 0.03, error.mean()  # 0.014, and 0.043 with colours at the place as loaded


def test_attributes_of_vertices_beside_a_volume_have_no_pose(tmp_path: Path) -> None:
    """Mitsuba evaluates both at the interaction's point: the volume's is in the world, that of the attribute at the mesh as loaded."""
    scene = _scene(_file(tmp_path, "vertex_color"), "vertex_color")
    volume = {"type": "volume", "volume": {"type": "constvolume", "value": {"type": "rgb", "value": 0.5}}}
    rough = {"type": "diffuse", "reflectance": volume}
    scene["quad"]["bsdf"] = {"type": "blendbsdf", "weight": 0.5, "one": scene["quad"]["bsdf"], "other": rough}
    problem = ur.Problem(scene, [ur.Parameter("quad.translation.x", initial=0.0)], [ur.View(np.zeros((16, 16, 3)))])
    with pytest.raises(ur.InputError, match=r"quad: .* attributes of vertices and a volume cannot be posed"):
        ur.render(problem, {"quad.translation.x": np.array(_SHIFT, np.float32)}, spp=4)
