"""Exports from Python: what has no description, what stays when something goes wrong, poses as matrices."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest

import unrender as ur
from unrender.app.exporting import scene_folder as exporting
from unrender.rendering.mitsuba import poses
from unrender.rendering.mitsuba.description import load_described
from unrender.rendering.mitsuba.poses import Pose
from unrender.rendering.mitsuba.renderer import MitsubaRenderer

MADE_BEFORE: list[Any] = []


def scene(bsdf: Any) -> dict[str, Any]:
    return {
        "type": "scene",
        "camera": {"type": "perspective", "film": {"type": "hdrfilm", "width": 4, "height": 4}},
        "sky": {"type": "constant"},
        "ball": {"type": "sphere", "center": [0, 0, 3], "bsdf": bsdf},
    }


def problem(description: Any, key: str = "sky.radiance.value") -> ur.Problem:
    return ur.Problem(description, [ur.Parameter(key)], [ur.View(np.ones((4, 4, 3)))])


def start(asked: ur.Problem) -> dict[str, np.ndarray]:
    return {key: np.array(value.numpy()) for key, value in asked.initial().items()}


def test_a_material_that_tells_no_description_is_one_line(tmp_path: Path) -> None:
    MADE_BEFORE.append(mi.load_dict({"type": "roughconductor"}))
    for description in (scene(MADE_BEFORE[0]), lambda: scene(MADE_BEFORE[0])):
        asked = problem(description)
        with pytest.raises(ur.InputError, match=r"^ball\.bsdf: a ready-made .*, which has no description"):
            ur.app.export((asked, start(asked)), tmp_path / "out")
        assert not list(tmp_path.iterdir())
    MADE_BEFORE.clear()


def test_materials_made_by_load_described_are_exported(tmp_path: Path) -> None:
    """Also those whose settings are not all parameters."""

    def description() -> dict[str, Any]:
        return scene(load_described({"type": "roughconductor", "distribution": "ggx", "alpha": 0.25}))

    asked = problem(description, "ball.bsdf.alpha.value")
    done = ur.app.export((asked, {"ball.bsdf.alpha.value": np.array(0.5)}), tmp_path / "out")
    assert done.scene is not None
    assert 'value="ggx"' in done.scene.read_text()


def test_diffuse_materials_made_by_mitsuba_are_read_off_the_object(tmp_path: Path) -> None:
    """One object in two shapes stays one material."""

    def description() -> dict[str, Any]:
        shared = mi.load_dict({"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": 0.25}})
        return scene(shared) | {"other": {"type": "sphere", "center": [0, 2, 3], "bsdf": shared}}

    loader = mi.load_dict
    asked = problem(description, "ball.bsdf.brdf_0.reflectance.value")
    done = ur.app.export((asked, {"ball.bsdf.brdf_0.reflectance.value": np.array(0.75)}), tmp_path / "out")
    assert mi.load_dict is loader
    found: Any = mi.load_file(str(done.scene))
    shapes = [shape for shape in found.shapes() if shape.bsdf() is not None]
    assert shapes[0].bsdf() == shapes[1].bsdf()
    (name,) = (key for key in mi.traverse(found).keys() if key.endswith("reflectance.value"))  # noqa: SIM118
    np.testing.assert_allclose(np.array(mi.traverse(found)[name]), 0.75)
    assert name == "ball.bsdf.brdf_0.reflectance.value"
    assert not done.notices


def test_a_texture_of_the_scene_that_two_materials_share_is_one_parameter_and_is_exported(tmp_path: Path) -> None:
    values = np.random.default_rng(2).uniform(0.2, 0.9, (4, 4, 3)).astype(np.float32)

    def description() -> dict[str, Any]:
        paint = {"type": "ref", "id": "paint"}
        return {
            "paint": {"type": "bitmap", "id": "paint", "raw": True, "bitmap": mi.Bitmap(values)},
            **scene({"type": "diffuse", "reflectance": paint}),
            "other": {"type": "sphere", "center": [2, 0, 5], "bsdf": {"type": "diffuse", "reflectance": paint}},
        }

    asked = problem(description, "ball.bsdf.reflectance.data")
    assert "other.bsdf.reflectance.data" not in asked.renderer.parameters()
    done = ur.app.export((asked, {"ball.bsdf.reflectance.data": 0.5 * values}), tmp_path / "out")
    again = MitsubaRenderer(done.scene)
    keys = [key for key in again.parameters() if key.endswith("reflectance.data")]
    for key in keys:
        np.testing.assert_allclose(np.array(again.values([key])[key]), 0.5 * values, atol=1e-5)
    assert keys


def test_values_that_do_not_fit_are_refused(tmp_path: Path) -> None:
    asked = problem(scene({"type": "diffuse"}))
    with pytest.raises(ur.InputError, match="expected"):
        ur.app.export((asked, {}), tmp_path / "out")
    with pytest.raises(ur.InputError, match="shape"):
        ur.app.export((asked, {"sky.radiance.value": np.zeros((2, 2))}), tmp_path / "out")
    assert not list(tmp_path.iterdir())


def test_a_scene_with_other_values_than_asked_for_is_not_left(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Loading what was written, and holding it to its values, is what stands between a fault here and a wrong scene."""
    sound = exporting.store

    def faulty(graph: Any, place: Any, value: Any, *more: Any) -> None:
        sound(graph, place, value * 1.01, *more)

    monkeypatch.setattr(exporting, "store", faulty)
    asked = problem(scene({"type": "diffuse"}))
    with pytest.raises(ur.InputError, match=r"parameter sky\.radiance\.value cannot be exported: .* another value"):
        ur.app.export((asked, start(asked)), tmp_path / "out")
    assert not list(tmp_path.iterdir())


def test_an_export_that_died_is_set_right_by_the_next(tmp_path: Path) -> None:
    """One that died between two renames, on a system that cannot exchange names, and one that died before."""
    problem = ur.gallery.problem("lamp", resolution=8, reference_spp=4)
    values = {key: np.asarray(value) for key, value in problem.initial().items()}
    ur.app.export((problem, values), tmp_path / "out")
    dead = 2**22 + 1
    (tmp_path / "out").rename(tmp_path / f".out.{dead}.old")
    (tmp_path / f".out.{dead}.part").mkdir()
    (tmp_path / f".out.{dead}.part" / "scene.xml").write_text("half")
    with pytest.raises(ur.InputError, match="holds an earlier export"):  # it is back
        ur.app.export((problem, values), tmp_path / "out")
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


def test_posed_matrices_are_the_renderers_poses() -> None:
    """The matrix takes points where the renderer's rays see them."""
    loaded = mi.load_dict(scene({"type": "diffuse"}), parallel=False, optimize=False)
    values = {
        "ball.translation": np.array([0.1, -0.2, 0.3], np.float32),
        "ball.rotation.y": np.float32(0.7),
        "ball.scale": np.float32(1.3),
        "camera.rotation": np.array([0.1, 0.2, -0.3], np.float32),
    }
    found = poses.matrices(loaded, values)
    assert set(found) == {"ball", "camera"}
    point = np.array([0.4, 0.5, 2.0])
    ball = Pose([0.0, 0.0, 3.0], [0.1, -0.2, 0.3], [0.0, 0.7, 0.0], 1.3)
    camera = Pose([0.0, 0.0, 0.0], [0.0, 0.0, 0.0], [0.1, 0.2, -0.3], 1.0)
    for name, pose in (("ball", ball), ("camera", camera)):
        expected = np.array(pose.point(mi.Point3f(*map(float, point)))).reshape(-1)
        np.testing.assert_allclose((found[name] @ [*point, 1])[:3], expected, rtol=1e-5)


@pytest.mark.parametrize(("axis", "words"), [([1, 1, 0], "sky: to_world: cannot be exported"), ([0.577] * 3, "")])
def test_a_rotation_about_an_axis_of_another_length_is_refused(axis: list[float], words: str, tmp_path: Path) -> None:
    """Mitsuba takes the transposed matrix for its inverse, so the lit scene is not that of the matrix, which a file holds."""
    turned = mi.ScalarTransform4f().rotate(axis=axis, angle=50)
    sky = {"type": "envmap", "bitmap": mi.Bitmap(np.ones((2, 4, 3), np.float32)), "to_world": turned}
    asked = problem(scene({"type": "diffuse"}) | {"sky": sky}, "ball.bsdf.reflectance.value")
    if not words:
        assert ur.app.export((asked, start(asked)), tmp_path / "out").scene is not None
        return
    with pytest.raises(ur.InputError, match=words):
        ur.app.export((asked, start(asked)), tmp_path / "out")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("axis", [[0.58] * 3, [0.71, 0.71, 0]])
def test_a_mesh_rotated_about_an_axis_of_two_digits_is_exported(axis: list[float], tmp_path: Path) -> None:
    """It was refused, although its picture hardly depends on the inverse. That of an environment map does."""
    turned = mi.ScalarTransform4f().rotate(axis=axis, angle=180)
    wall = {"type": "rectangle", "to_world": turned}
    asked = problem(scene({"type": "diffuse"}) | {"wall": wall}, "ball.bsdf.reflectance.value")
    assert ur.app.export((asked, start(asked)), tmp_path / "out").scene is not None
    sky = {"type": "envmap", "bitmap": mi.Bitmap(np.ones((2, 4, 3), np.float32)), "to_world": turned}
    asked = problem(scene({"type": "diffuse"}) | {"sky": sky}, "ball.bsdf.reflectance.value")
    with pytest.raises(ur.InputError, match="sky: to_world: cannot be exported"):
        ur.app.export((asked, start(asked)), tmp_path / "other")
