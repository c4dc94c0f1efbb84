"""Plugins that cannot be used are refused in one line that says what to do."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest

import unrender as ur
from scripts.coverage.plugins import PLUGINS
from scripts.coverage.scenes import colour, scene
from unrender.rendering.mitsuba.renderer import MitsubaRenderer
from unrender.rendering.renderer import SampleRequest


def refusal(description: Any, key: str | None = None, derivatives: bool = True) -> str:
    """The line that refuses a scene, or one of its parameters."""

    def use() -> None:
        if key is None:
            MitsubaRenderer(description, 3)
        elif derivatives:
            ur.Problem(description, [ur.Parameter(key)], [ur.View(np.zeros((16, 16, 3)))])
        else:
            MitsubaRenderer(description, 3).prepare([key], None)

    with pytest.raises(ur.InputError) as caught:
        use()
    assert "\n" not in str(caught.value)
    return str(caught.value)


def built(name: str) -> Callable[[], dict[str, Any]]:
    folder = Path(tempfile.mkdtemp())
    return lambda: PLUGINS[name].build(folder)


SPECTRA = {
    "regular": {"wavelength_min": 400.0, "wavelength_max": 700.0, "values": "1,2,3"},
    "irregular": {"wavelengths": "400,500,700", "values": "1,2,3"},
    "blackbody": {"temperature": 3000.0},
}


@pytest.mark.parametrize("kind", SPECTRA)
@pytest.mark.parametrize("slot", ["reflectance", "index of refraction", "textured light"])
def test_spectra_that_rgb_variants_cannot_evaluate_are_refused(kind: str, slot: str) -> None:
    spectrum = {"type": kind, **SPECTRA[kind]}
    ball: dict[str, Any] = {"type": "sphere"}
    if slot == "textured light":
        ball["emitter"] = {"type": "area", "radiance": {"type": "checkerboard", "color0": spectrum}}
    elif slot == "reflectance":
        ball["bsdf"] = {"type": "twosided", "b": {"type": "diffuse", "reflectance": spectrum}}
    else:
        ball["bsdf"] = {"type": "conductor", "eta": spectrum, "k": spectrum}
    assert f"cannot evaluate the plugin {kind} in the variant" in refusal(scene(ball=ball))


def test_a_timed_sky_and_a_field_of_primitives_are_refused() -> None:
    assert "give a sunsky in its place" in refusal(scene(sky={"type": "timed_sunsky"}))
    field = scene(ball=built("ellipsoids")()["ball"], integrator={"type": "volprim_rf_basic"})
    assert "volprim_rf_basic renders ellipsoids as a radiance field" in refusal(field)


@pytest.mark.parametrize("bsdf", [{"type": "diffuse", "reflectance": {"type": "bitmap"}}, {"type": "blendbsdf"}])
def test_objects_without_what_they_need_do_not_end_the_process(bsdf: dict[str, Any]) -> None:
    assert "expected " in refusal(scene(ball={"type": "sphere", "bsdf": bsdf}))


def test_hair_with_pigments_renders_and_its_pigments_change_the_picture() -> None:
    renderer = MitsubaRenderer(built("hair"), 3)
    assert "ball.bsdf.sigma_a" not in renderer.parameters()
    key = "ball.bsdf.eumelanin"
    session = renderer.prepare([key], None, False)
    states = {key: np.array([0.1, 2.0], np.float32)}
    light, dark = np.array(session.image_batch(states, SampleRequest(0, 16, 1)))
    assert np.isfinite(light).all()
    assert dark.mean() < light.mean()


@pytest.mark.parametrize(
    ("name", "key"),
    [
        ("bsplinecurve", "control_points"),
        ("linearcurve", "control_points"),
        ("ellipsoids", "data"),
        ("ellipsoidsmesh", "data"),
        ("sdfgrid", "grid"),
    ],
)
def test_outlines_of_shapes_that_are_no_meshes_are_refused(name: str, key: str) -> None:
    line = refusal(built(name), f"ball.{key}")
    assert line.endswith("recover a mesh's vertex_positions instead")
    assert ("corrupts memory" in line) == (name == "sdfgrid")


@pytest.mark.parametrize(
    ("key", "words"),
    [
        ("sun.to_world", "its pose can be: sun.rotation"),
        ("sun.translation", "a pose is sun.rotation"),
        ("beamer.to_world", "its pose can be: beamer.translation, beamer.rotation"),
        ("lamp.to_world", "its pose can be: lamp.translation, lamp.rotation, lamp.scale"),
        ("ball.center", "a pose is ball.translation, ball.rotation, ball.scale"),
        ("ball.radius", "a pose is ball.translation, ball.rotation, ball.scale"),
        ("ball.to_world", "its pose can be: ball.translation, ball.rotation, ball.scale"),
    ],
)
def test_what_has_no_pose_is_named(key: str, words: str) -> None:
    sun = {"type": "directional", "direction": [0, -1, 0], "irradiance": colour(1, 1, 1)}
    beamer = {"type": "projector", "irradiance": colour(1, 1, 1)}
    assert words in refusal(scene(sun=sun, beamer=beamer), key)


def test_a_sensor_of_a_batch_has_no_pose_of_its_own() -> None:
    line = refusal(built("batch"), "camera.left.to_world")
    assert "it places a sensor of a batch" in line
    assert "emits light" not in line


def test_phase_functions_load_without_a_word(capfd: pytest.CaptureFixture[str]) -> None:
    MitsubaRenderer(built("sggx"), 3).prepare([], None, False).image({}, SampleRequest(0, 4, 1))
    assert capfd.readouterr().err == ""


def test_a_weight_without_a_derivative_is_refused_by_name() -> None:
    weight = "ball.interior_medium.phase_function.weight.value.value"
    assert "blendphase passes no derivative to its weight" in refusal(built("blendphase"), weight, derivatives=False)


def test_an_emitter_that_no_path_finds_is_refused_and_leaves_other_scenes_alone() -> None:
    """A living one would fail the calls of every other scene's emitters."""
    assert "cannot sample a directionalarea emitter" in refusal(built("directionalarea"))
    other = MitsubaRenderer(built("projector"), 3)
    assert np.isfinite(np.array(other.prepare([], None, False).image({}, SampleRequest(0, 4, 1)).images)).all()


@pytest.mark.cpu("a GPU traces one scene, so poses cannot transform rays")
def test_a_mesh_of_ellipsoids_moves_in_perturbed_renders_only() -> None:
    assert "is not a mesh (EllipsoidsMesh)" in refusal(built("ellipsoidsmesh"), "ball.translation", derivatives=False)


@pytest.mark.parametrize("leaf", ["alpha", "eta"])
def test_what_roughplastic_tabulates_has_no_path_gradient(leaf: str) -> None:
    """Finite differences: path gradients were .2 (alpha) and -15 (eta) times what they should be."""
    line = refusal(built("roughplastic"), f"ball.bsdf.{leaf}", derivatives=False)
    assert "tabulates its transmittance from it without a derivative" in line


@pytest.mark.parametrize(
    ("name", "key"),
    [
        ("roughdielectric", "ball.bsdf.eta"),
        ("roughdielectric", "ball.bsdf.alpha.value"),
        ("roughdielectric, anisotropic", "ball.bsdf.alpha_v.value"),
        ("principledthin", "ball.bsdf.roughness.value"),
        ("sggx", "ball.interior_medium.phase_function.S.data"),
    ],
)
def test_path_gradients_that_differences_refute_are_refused(name: str, key: str) -> None:
    """Ratios: 1.06 for glass in air, -3 to .3 for air in glass, 10 for principledthin, 4 to 11 for sggx. Perturbed renders stay."""
    assert "disagree with finite differences" in refusal(built(name), key, derivatives=False)
    MitsubaRenderer(built(name), 3).prepare([key], None, False)


def test_the_sun_s_disk_has_no_path_gradient() -> None:
    """Finite differences: path gradients were .80 +- .03 times what they should be."""
    line = refusal(built("sunsky, direction"), "light.sun_direction", derivatives=False)
    assert "it moves the sun's disk, and path gradients do not support its boundary" in line


def test_normals_without_a_direction_are_refused_with_what_to_give() -> None:
    """Path gradients were 2e5 at 0.5, which stands for a vector of length 0."""
    key, views = "ball.bsdf.normalmap.data", [ur.View(np.zeros((16, 16, 3)))]
    with pytest.raises(ur.InputError, match=r"initial: 16 of 16 normals have no direction.*such as \[0.5, 0.5, 1\]"):
        ur.Problem(built("normalmap"), [ur.Parameter(key, initial=[0.5, 0.5, 0.5])], views)
    with pytest.raises(
        ur.InputError, match=r"initial: expected a colour \(3 numbers\) or an array of shape \(4, 4, 3\), got the num"
    ):
        ur.Problem(built("normalmap"), [ur.Parameter(key, initial=0.5)], views)
    ur.Problem(built("normalmap"), [ur.Parameter(key)], views)
    ur.Problem(built("normalmap"), [ur.Parameter(key, initial=[0.5, 0.5, 1.0])], views)


def test_a_constant_in_a_bump_map_is_no_error() -> None:
    """Pictures depend on its slopes alone."""
    key, views = "ball.bsdf.nested_texture.data", [ur.View(np.zeros((16, 16, 3)))]
    truth = ur.Problem(built("bumpmap"), [ur.Parameter(key)], views).initial_values()[key]
    made = ur.Problem(built("bumpmap"), [ur.Parameter(key)], views, truth={key: truth})
    assert made.parameter_error({key: truth + 3.0})[key] == pytest.approx(0.0, abs=1e-5)
    assert made.parameter_error({key: 2.0 * truth})[key] == pytest.approx(np.std(truth), rel=1e-4)


def test_texture_coordinates_that_a_mesh_does_not_have_are_refused() -> None:
    assert "it holds no values" in refusal(built("obj"), "ball.vertex_texcoords")


@pytest.mark.parametrize("kind", ["rectangle", "sphere", "with it"])
def test_an_attribute_that_a_shape_lacks_is_named(kind: str) -> None:
    """Mitsuba renders it black, in silence."""
    texture = {"type": "mesh_attribute", "name": "vertex_color"}
    material = {"type": "diffuse", "reflectance": texture}
    shape: Any = {"type": kind, "bsdf": material}
    if kind == "with it":
        properties = mi.Properties()
        properties["bsdf"] = mi.load_dict(material)
        shape = mi.Mesh("sheet", 3, 1, props=properties)
        values = mi.traverse(shape)
        values["vertex_positions"], values["faces"] = [0, 0, 0, 1, 0, 0, 0, 1, 0], [0, 1, 2]
        values.update()
        shape.add_attribute("vertex_color", 3, [0.5] * 9)
    camera = {"type": "perspective", "film": {"type": "hdrfilm", "width": 4, "height": 4}}
    described = {"type": "scene", "camera": camera, "sheet": shape, "sky": {"type": "constant"}}
    found = [line for line in MitsubaRenderer(lambda: described, 2).notices if "vertex_color" in line]
    expected = "sheet: it has no attribute vertex_color, which a texture of its material reads as 0"
    assert [line.split(";")[0] for line in found] == ([] if kind == "with it" else [expected])


@pytest.mark.parametrize(
    ("name", "x", "told"), [("vertex_color", 1.0, 1), ("vertex_color", 0.0, 0), ("face_color", 1.0, 0)]
)
def test_attributes_of_vertices_in_moved_instances_are_told(name: str, x: float, told: int, tmp_path: Path) -> None:
    """Mitsuba gives 1.2 at (0.2, 0.3) of a triangle whose red is its x coordinate, in an instance moved by 1."""
    mesh = mi.Mesh("sheet", 3, 1)
    values = mi.traverse(mesh)
    values["vertex_positions"], values["faces"] = [0, 0, 0, 1, 0, 0, 0, 1, 0], [0, 1, 2]
    values.update()
    mesh.add_attribute(name, 3, [0, 0, 0, 1, 0, 0, 0, 0, 0] if name.startswith("vertex_") else [0.2, 0, 0])
    mesh.write_ply(str(tmp_path / "sheet.ply"))
    material = {"type": "diffuse", "reflectance": {"type": "mesh_attribute", "name": name}}
    sheet = {"type": "ply", "filename": str(tmp_path / "sheet.ply"), "bsdf": material}
    copy = {
        "type": "instance",
        "to_world": mi.ScalarTransform4f().translate([x, 0, 0]),
        "group": {"type": "ref", "id": "group"},
    }
    camera = {"type": "perspective", "film": {"type": "hdrfilm", "width": 4, "height": 4}}
    parts = {"group": {"type": "shapegroup", "sheet": sheet}, "copy": copy, "sky": {"type": "constant"}}
    described = {"type": "scene", "camera": camera, **parts}
    scene: Any = mi.load_dict(described)
    si = scene.ray_intersect(mi.Ray3f(mi.Point3f(x + 0.2, 0.3, 1), mi.Vector3f(0, 0, -1)))
    assert np.array(si.bsdf().eval_diffuse_reflectance(si)).ravel()[0] == pytest.approx(0.2 + told, abs=1e-4)
    found = [line for line in MitsubaRenderer(lambda: described, 2).notices if name in line]
    assert [line.split(",")[0] for line in found] == [
        "sheet: Mitsuba interpolates vertex_color wrongly in instances with to_world"
    ] * told
