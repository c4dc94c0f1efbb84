"""An exported scene, rendered by plain Mitsuba, is the run's own picture within noise."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from zscores import agree

import unrender as ur
from tiers import quick
from unrender.gallery import meshes
from unrender.io import images
from unrender.scene.problem import Problem

RUNS, SPP = 24, 32
LEFT_OUT = (
    "exponential",
    "quad",
    "nerf-volume",
    "sphere-to-bunny",
    "shadow-art",
    "statue",
    "relief",
    "one-jar",
    "two-posters",
)  # three as sphere-to-mesh; the views of the next two are of worlds, and the export is of the problem's scene; see test_ties.py
RENDERED = [name for name in ur.gallery.names() if name not in LEFT_OUT]


def elsewhere(problem: Problem, share: float = 0.2) -> dict[str, np.ndarray]:
    """Values that are neither the start nor the truth."""
    rng = np.random.default_rng(1)
    found = {}
    for key, start in problem.initial().items():
        value = np.array(start.numpy())
        low, high = problem.unknowns[key].bounds
        moved = value * (1 + share * rng.uniform(-1, 1, value.shape)) + (0.03 if low is None else 0) * rng.normal(
            size=value.shape
        )
        found[key] = np.clip(moved, low, high).astype(np.float32)
    return found


def ours(problem: Problem, parameters: dict[str, np.ndarray], view: int) -> np.ndarray:
    return np.stack([ur.render(problem, parameters, view, SPP, seed) for seed in range(RUNS)])


def theirs(path: Path | None, sensor: int) -> np.ndarray:
    scene: Any = mi.load_file(str(path))
    images = np.stack(
        [np.array(mi.render(scene, sensor=sensor, spp=SPP, seed=mi.UInt32(1000 + seed))) for seed in range(RUNS)]
    )
    # Pixels that have no noise of their own differ by what a film rounds: noise a good deal above that, and far below any fault.
    return images + 1e-4 * images.mean() * np.random.default_rng(2).normal(size=images.shape)


def small(name: str) -> Problem:
    options: dict[str, Any] = {"resolution": 8, "reference_spp": 1}
    if any(option.name == "texture_resolution" for option in ur.gallery.options(name)):
        options["texture_resolution"] = 8
    return ur.gallery.problem(name, **options)


@pytest.mark.slow
def test_of_an_emissive_medium_there_are_the_grids(tmp_path: Path) -> None:
    problem = small("nerf-volume")
    parameters = elsewhere(problem)
    for overwrite in (False, True):
        done = ur.app.export((problem, parameters), tmp_path / "out", overwrite=overwrite)
    assert done.scene is None
    assert any("plain Mitsuba has no emissive medium" in notice for notice in done.notices)
    for key, value in parameters.items():
        grid = np.array(mi.VolumeGrid(str(done.folder / "maps" / f"{key.removesuffix('.data')}.vol")))
        np.testing.assert_array_equal(grid.reshape(value.shape), value)


@pytest.mark.slow
def test_the_numbers_of_a_homogeneous_medium(tmp_path: Path) -> None:
    def scene() -> dict[str, Any]:
        rgb = lambda *x: {"type": "rgb", "value": list(x)}  # noqa: E731
        return {
            "type": "scene",
            "camera": {"type": "perspective", "fov": 40.0, "film": {"type": "hdrfilm", "width": 8, "height": 8},
                       "to_world": mi.ScalarTransform4f().look_at([0, 0, 4], [0, 0, 0], [0, 1, 0])},
            "sky": {"type": "constant"},
            "lamp": {"type": "point", "position": [0, 3, 2], "intensity": rgb(9, 9, 9)},
            "ball": {"type": "sphere", "bsdf": {"type": "null"}, "interior": {
                "type": "homogeneous", "scale": 2.0, "sigma_t": rgb(0.9, 0.7, 0.5), "albedo": 0.8,
                "phase": {"type": "hg", "g": 0.4}}},
        }  # fmt: skip

    keys = ["ball.interior_medium.albedo.value.value", "ball.interior_medium.phase_function.g"]
    problem = ur.Problem(scene, [ur.Parameter(key) for key in keys], [ur.View(np.zeros((8, 8, 3)))], max_depth=5)
    parameters = elsewhere(problem)
    done = ur.app.export((problem, parameters), tmp_path / "out")
    assert done.scene is not None
    assert agree(ours(problem, parameters, 0), theirs(done.scene, 0), size=2)


@pytest.mark.parametrize("name", quick(RENDERED, "mug"))
def test_plain_mitsuba_renders_the_runs_picture(name: str, tmp_path: Path) -> None:
    problem = small(name)
    parameters = elsewhere(problem)
    done = ur.app.export((problem, parameters), tmp_path / "scene")
    view = len(problem.views) - 1
    assert agree(ours(problem, parameters, view), theirs(done.scene, problem.views[view].sensor), size=2)
    assert not done.notices


def test_a_wrong_texture_is_seen(tmp_path: Path) -> None:
    """The test above can fail: a quarter of the texels of an exported texture a fifth brighter."""
    problem = small("poster")
    parameters = elsewhere(problem)
    done = ur.app.export((problem, parameters), tmp_path / "scene")
    (texture,) = (done.folder / "textures").iterdir()
    pixels = images.read(texture).values
    pixels[:4, :4] *= 1.2
    mi.Bitmap(pixels).write(str(texture))
    assert not agree(ours(problem, parameters, 0), theirs(done.scene, 0), size=2)


@pytest.mark.slow
def test_the_tutorials_cornell_box(assets: Path, tmp_path: Path) -> None:
    """XML that others wrote: colours, an emitter on a mesh, vertices, a mirror's metal, the camera's angle; posed shapes apart."""
    text = (assets / "tutorials/cbox.xml").read_text().replace('"meshes/', f'"{assets / "tutorials/meshes"}/')
    path = tmp_path / "room" / "scene.xml"
    path.parent.mkdir()
    path.write_text(text.replace('name="res" value="256"', 'name="res" value="8"'))
    black = [ur.View(np.zeros((8, 8, 3)))]
    for number, keys in enumerate(
        (
            [
                "red.reflectance.value",
                "light.emitter.radiance.value",
                "floor.vertex_positions",
                "mirror.eta.value",
                "sensor.x_fov",
            ],
            ["glasssphere.translation", "glasssphere.scale", "redwall.rotation.y", "sensor.rotation.z"],
        )
    ):
        problem = ur.Problem(path, [ur.Parameter(key) for key in keys], black, max_depth=4)
        parameters = elsewhere(problem, 0.1)
        done = ur.app.export((problem, parameters), tmp_path / f"exported-{number}")
        assert agree(ours(problem, parameters, 0), theirs(done.scene, 0), size=2)
        assert not done.notices


def still_life() -> dict[str, Any]:
    """Ready-made objects, shared materials, every kind of emitter that has parameters, an attribute of vertices."""
    grey = mi.load_dict({"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.4, 0.5, 0.6]}})
    points, faces = meshes.icosphere(1)
    ball = meshes.triangles(
        "ball",
        0.5 * points,
        faces,
        {"type": "diffuse", "reflectance": {"type": "mesh_attribute", "name": "vertex_color"}},
    )
    ball.add_attribute("vertex_color", 3, dr.linspace(mi.Float, 0.1, 0.9, 3 * len(points)))
    pixels = np.random.default_rng(0).uniform(0.1, 0.9, (4, 6, 3)).astype(np.float32)
    eight = mi.Bitmap((255 * pixels).astype(np.uint8))
    to = mi.ScalarTransform4f
    return {
        "type": "scene",
        "camera": {
            "type": "thinlens",
            "aperture_radius": 0.05,
            "focus_distance": 4.0,
            "fov": 45.0,
            "to_world": to().look_at([0, 1.2, 4], [0, 0.2, 0], [0, 1, 0]),
            "film": {"type": "hdrfilm", "width": 12, "height": 10,
                     "crop_width": 8, "crop_height": 8, "crop_offset_x": 3, "crop_offset_y": 1},
        },
        "sky": {"type": "envmap", "bitmap": mi.Bitmap(pixels), "scale": 0.7},
        "spot": {"type": "point", "position": [1.0, 2.0, 1.5], "intensity": {"type": "rgb", "value": [3.0, 2.0, 1.0]}},
        "ball": ball,
        "floor": {"type": "rectangle", "to_world": to().translate([0, -0.5, 0]).rotate([1, 0, 0], -90).scale(3), "bsdf": grey},
        "left": {"type": "cube", "to_world": to().translate([-1.3, 0, 0]).scale(0.4), "bsdf": grey},
        "right": {
            "type": "sphere", "center": [1.3, 0, 0], "radius": 0.5,
            "bsdf": {"type": "blendbsdf", "weight": 0.3,
                     "a": {"type": "roughconductor", "material": "Cu", "alpha": 0.3},
                     "b": {"type": "diffuse", "reflectance": {"type": "bitmap", "bitmap": eight,
                                                             "format": "variant", "filter_type": "nearest"}}},
        },
    }  # fmt: skip


KEYS = [
    "sky.scale", "sky.data", "spot.intensity.value", "ball.vertex_color", "floor.bsdf.reflectance.value", "right.bsdf.weight.value",
    "right.bsdf.bsdf_0.alpha.value", "right.bsdf.bsdf_0.k.value", "right.bsdf.bsdf_1.reflectance.data", "left.vertex_positions",
    "spot.position", "camera.x_fov",
]  # fmt: skip


@pytest.fixture(scope="module")
def still() -> tuple[Problem, dict[str, np.ndarray]]:
    problem = ur.Problem(still_life, [ur.Parameter(key) for key in KEYS], [ur.View(np.zeros((8, 8, 3)))], max_depth=4)
    parameters = elsewhere(problem)
    # Mitsuba keeps the first column once more behind the last, and the last before the first.
    sky = parameters["sky.data"]
    sky[:, 0], sky[:, -1] = sky[:, -2], sky[:, 1]
    return problem, parameters


@pytest.mark.slow
def test_ready_made_objects_and_parameters_of_every_kind(still: Any, tmp_path: Path) -> None:
    problem, parameters = still
    done = ur.app.export(still, tmp_path / "scene")
    assert agree(ours(problem, parameters, 0), theirs(done.scene, 0), size=2)


@pytest.mark.slow
def test_an_exported_scene_exports_as_itself(still: Any, tmp_path: Path) -> None:
    """Its XML is a problem's scene with the same keys and values; exported once more, meshes and pictures are the same."""
    first = ur.app.export(still, tmp_path / "first").folder
    names = dict(notice.split(" is called ") for notice in ur.app.export(still, tmp_path / "again").notices)
    keys = [names[key].removesuffix(" in the exported scene") if key in names else key for key in KEYS]
    again = ur.Problem(
        first / "scene.xml", [ur.Parameter(key) for key in keys], [ur.View(np.zeros((8, 8, 3)))], max_depth=4
    )
    read = {key: np.array(value.numpy()) for key, value in again.renderer.values(keys).items()}
    for key, (own, value) in zip(keys, still[1].items(), strict=True):
        np.testing.assert_allclose(read[key], value, rtol=1e-5, atol=1e-6, err_msg=own)
    second = ur.app.export((again, read), tmp_path / "second").folder
    for name in ("left.ply", "ball.ply"):
        files = (str(parent / "meshes" / name) for parent in (first, second))
        shapes: Any = [mi.traverse(mi.load_dict({"type": "ply", "filename": file})) for file in files]
        for key in ("faces", "vertex_positions", "vertex_normals"):
            np.testing.assert_allclose(*(np.array(mesh[key]) for mesh in shapes), rtol=1e-5, atol=1e-6)
    assert len(list(first.rglob("*.*"))) == len(list(second.rglob("*.*")))
    scenes: Any = [mi.load_file(str(parent / "scene.xml")) for parent in (first, second)]
    a, b = (np.array(mi.render(scene, spp=16, seed=mi.UInt32(3))) for scene in scenes)
    np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-5)
