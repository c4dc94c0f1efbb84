# Dr.Jit's stubs know less than its functions return.
# pyright: reportArgumentType=false, reportAttributeAccessIssue=false

"""Path gradients of sensors that move, turn and zoom, against finite differences of renders."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np
import pytest
from test_boundary import LIMIT, SIZE, block, differences, gradients, scores, weights

import unrender as ur
from unrender.core.errors import InputError
from unrender.rendering.mitsuba.integrators.flat_mirrors import FlatMirrors
from unrender.rendering.mitsuba.renderer import MitsubaRenderer
from unrender.rendering.renderer import SampleRequest


def transform() -> Any:
    return mi.ScalarTransform4f()


def glowing() -> dict[str, Any]:
    """Two pictures that shine, one before the other: no noise but at edges."""
    y, x = np.mgrid[0:16, 0:16] / 16
    picture = np.stack([0.5 + 0.4 * np.sin(6 * x), 0.5 + 0.4 * np.cos(5 * y), x * y], -1).astype(np.float32)

    def shining(place: Any, scale: float) -> dict[str, Any]:
        radiance = {"type": "bitmap", "data": mi.TensorXf(scale * picture), "raw": True}
        return {"type": "rectangle", "to_world": place, "emitter": {"type": "area", "radiance": radiance}}

    film = {"type": "hdrfilm", "width": SIZE, "height": SIZE, "rfilter": {"type": "box"}}
    place = transform().look_at([0, 0, 4], [0, 0, 0], [0, 1, 0])
    return {
        "type": "scene",
        "sensor": {"type": "perspective", "fov": 39.3, "to_world": place, "film": film},
        "back": shining(transform().translate([0, 0, -1]).rotate([0, 1, 0], 20).scale(2), 1.0),
        "front": shining(
            transform().translate([0.2, -0.1, 1]).rotate([0, 1, 0], -30).rotate([0, 0, 1], 25).scale(0.4), 2.0
        ),
    }


def screened() -> dict[str, Any]:
    """A sheet before the near clipping plane, which nobody sees, hides half of the pictures from the camera itself."""
    described = glowing()
    described["sensor"]["near_clip"] = 1.0
    sheet = transform().translate([0.25, 0, 3.4]).scale([0.25, 0.5, 1])
    return described | {"sheet": {"type": "rectangle", "to_world": sheet}}


def sunlit(**more: Any) -> dict[str, Any]:
    """A block in half a room, seen from aslant."""
    described = block()
    for name in ("light", "ceiling", "green-wall"):
        del described[name]
    described["sensor"]["to_world"] = transform().look_at([0.4, 0.3, 3.2], [0.05, -0.15, 0], [0.15, 1, 0.1])
    described["sun"] = {
        "type": "directional", "direction": [0.35, -0.6, -0.8], "irradiance": {"type": "rgb", "value": 3.0},
    }  # fmt: skip
    return described | more


def round_things() -> dict[str, Any]:
    """A ball, a disc and a cylinder, whose silhouettes are no edges, and a ball's shadow."""
    clay = {"type": "twosided", "inner": {"type": "diffuse"}}
    disc = transform().translate([0.5, 0.4, 0.2]).rotate([1, 0, 0], 30).scale(0.25)
    return sunlit(
        ball={"type": "sphere", "radius": 0.25, "center": [-0.1, -0.2, 0.6]},
        disc={"type": "disk", "to_world": disc, "bsdf": clay},
        pillar={"type": "cylinder", "p0": [-0.6, -0.9, 0.9], "p1": [-0.3, -0.5, 1.0], "radius": 0.12, "bsdf": clay},
    )


def mirrored() -> dict[str, Any]:
    place = transform().translate([-0.6, -0.1, -0.3]).rotate([0, 1, 0], 35).scale(0.6)
    glass = {"type": "twosided", "inner": {"type": "conductor"}}
    return sunlit(mirror={"type": "rectangle", "to_world": place, "bsdf": glass})


def glossy() -> dict[str, Any]:
    described = sunlit(sky={"type": "constant", "radiance": 0.3})
    described["floor"]["bsdf"] = {"type": "twosided", "inner": {"type": "roughconductor", "alpha": 0.2}}
    described["back"]["bsdf"] = {"type": "twosided", "inner": {"type": "roughplastic", "alpha": 0.25}}
    return described


def lamplit() -> dict[str, Any]:
    described = sunlit()
    del described["sun"]
    place = transform().translate([0, 0.3, 3.6]).rotate([1, 0, 0], 180).scale(0.4)
    light = {"type": "area", "radiance": {"type": "rgb", "value": 12.0}}
    return described | {"lamp": {"type": "rectangle", "to_world": place, "emitter": light}}


@pytest.mark.slow
def test_a_camera_that_turns_and_a_planted_fault_of_three_per_cent() -> None:
    found, expected = (f(glowing, "sensor.rotation.y", 1, spp) for f, spp in ((gradients, 96), (differences, 1024)))
    assert np.abs(scores(found, expected)).max() < LIMIT
    assert np.abs(scores(1.03 * found, expected)).max() > LIMIT


@pytest.mark.slow
@pytest.mark.parametrize(
    ("description", "key", "depth", "step"),
    [
        (glowing, "sensor.translation", 1, 0.01),
        (screened, "sensor.translation", 1, 0.01),
        (glowing, "sensor.x_fov", 1, 0.2),
        (glowing, "sensor.principal_point_offset_x", 1, 0.01),
        (round_things, "sensor.translation.x", 2, 0.01),
        (mirrored, "sensor.translation.x", 3, 0.01),
        (glossy, "sensor.translation.x", 2, 0.01),
        (lamplit, "sensor.translation.z", 4, 0.01),
    ],
)
def test_cameras_in_several_scenes(description: Any, key: str, depth: int, step: float) -> None:
    # Where rare bright paths are most of the noise, errors of few samples are underestimated.
    spp, reference_spp = (96, 1024) if description is glossy else (32, 512)
    found = gradients(description, key, depth, spp)
    expected = differences(description, key, depth, reference_spp, step)
    assert np.abs(scores(found, expected)).max() < LIMIT, (found.mean(axis=0), expected.mean(axis=0))


@pytest.mark.slow
def test_a_sphere_that_moves_is_a_mesh() -> None:
    """Against the sphere itself, moved by what `smoothed` moves it by."""

    def scene() -> dict[str, Any]:
        return sunlit(ball={"type": "sphere", "radius": 0.3, "center": [-0.1, -0.2, 0.6]})

    renderer = MitsubaRenderer(scene, 2, ["ball.translation.x"])
    assert any("ball" in notice for notice in renderer.notices)
    found = gradients(scene, "ball.translation.x", 2, 48)
    assert np.abs(scores(found, differences(scene, "ball.translation.x", 2, 512))).max() < LIMIT


def test_what_is_set_is_taken_back() -> None:
    renderer = MitsubaRenderer(sunlit, 2)

    def image(key: str, shift: float) -> np.ndarray:
        value = np.array(renderer.values([key])[key], np.float32) + np.float32(shift)
        session = renderer.prepare([key], None)
        return np.array(session.image({key: renderer.array(value)}, SampleRequest(0, 1, 5, groups=1)).images)

    before = image("back.translation.z", 0)
    assert not np.array_equal(image("sensor.translation.x", 0.2), before)
    assert not np.array_equal(image("back.translation.x", 0.3), before)
    assert np.array_equal(image("sensor.x_fov", 0), before)


def test_sensors_that_cannot_move_are_named() -> None:
    def scene() -> dict[str, Any]:
        described = sunlit()
        described["wide"] = dict(described["sensor"], type="thinlens", aperture_radius=0.1)
        return described

    renderer = MitsubaRenderer(scene, 2)
    renderer.prepare(["moving.translation.x"], None)  # an unused sensor of another kind is no obstacle
    with pytest.raises(InputError, match=r"wide.*ThinLens"):
        renderer.prepare(["wide.translation"], None)


@pytest.mark.slow
def test_a_material_s_gradient_is_the_same_beside_a_camera() -> None:
    """Path replay has it whole: of how a glossy material is seen from elsewhere, only the camera's part is added."""
    renderer = MitsubaRenderer(glossy, 2)

    def gradient(*keys: str) -> np.ndarray:
        values = renderer.values(list(keys))
        session = renderer.prepare(list(keys), None)
        paths = session.image(values, SampleRequest(0, 4, 5, groups=1)).paths
        return np.array(
            session.adjoint(values, paths, renderer.array(weights()[None]))["floor.bsdf.brdf_0.alpha.value"]
        )

    alone = gradient("floor.bsdf.brdf_0.alpha.value")
    np.testing.assert_allclose(gradient("floor.bsdf.brdf_0.alpha.value", "sensor.translation"), alone, rtol=1e-3)


@pytest.mark.slow
def test_a_camera_in_a_scene_without_meshes() -> None:
    def scene() -> dict[str, Any]:
        described = {"type": "scene", "sensor": sunlit()["sensor"], "ball": {"type": "sphere", "radius": 0.4}}
        return described | {"sky": {"type": "constant"}}

    renderer = MitsubaRenderer(scene, 2)
    values, session = renderer.values(["sensor.translation"]), renderer.prepare(["sensor.translation"], None)
    paths = session.image(values, SampleRequest(0, 4, 5, groups=1)).paths
    found = session.adjoint(values, paths, renderer.array(weights()[None]))
    assert np.isfinite(np.array(found["sensor.translation"])).all()
    assert np.abs(np.array(found["sensor.translation"])).max() > 0


def test_two_sides_of_a_plane_are_one_mirror() -> None:
    def sides() -> dict[str, Any]:
        glass = {"type": "conductor"}
        place = transform().translate([0, 0.2, 0]).rotate([1, 0, 0], 25)
        turned = place @ transform().rotate([0, 1, 0], 180)
        return {
            "type": "scene",
            "one": {"type": "rectangle", "to_world": place, "bsdf": glass},
            "other": {"type": "rectangle", "to_world": turned, "bsdf": glass},
        }

    assert FlatMirrors(mi.load_dict(sides(), optimize=False)).count == 2  # with none


def test_the_stock_loop_names_cameras_that_it_cannot_move() -> None:
    problem = ur.Problem(sunlit(), [ur.Parameter("sensor.translation")], [ur.View(np.ones((SIZE, SIZE, 3)))])
    with pytest.raises(InputError, match=r"sensor\.translation: Mitsuba's loop has no gradient"):
        ur.optimize(problem, "stock", steps=1)


def test_pixels_by_the_variance_of_camera_gradients_are_refused_with_what_to_do() -> None:
    problem = ur.gallery.problem("camera", resolution=8, reference_spp=16)
    with pytest.raises(
        ur.InputError, match=r"adaptive pixel sampling does not support .*; use --method plain, or .*scheme = uniform"
    ):
        ur.optimize(problem, "adaptive", steps=1, progress=False)


@pytest.mark.slow
def test_auto_finds_cameras() -> None:
    """Three of 2 degrees and 2 % off, from pictures of 24² pixels. A fifth of what is asked of larger ones."""
    problem = ur.gallery.problem("camera", resolution=24, reference_spp=1024)
    result = ur.optimize(problem, "auto", steps=8, seed=2)
    for name, distance in (("left", 2.94), ("middle", 2.98), ("right", 2.74)):
        assert np.degrees(np.linalg.norm(result.parameters[f"{name}.rotation"])) < 0.25
        assert np.linalg.norm(result.parameters[f"{name}.translation"]) < 0.005 * distance


def test_a_sensor_does_not_move_by_path_gradients_beside_shapes_without_silhouette_curves() -> None:
    side = np.linspace(-0.5, 0.5, 6)
    distance = np.sqrt(sum(np.square(axis) for axis in np.meshgrid(side, side, side)))[..., None] - 0.3
    described = {
        "type": "scene",
        "eye": {"type": "perspective", "film": {"type": "hdrfilm", "width": 4, "height": 4}},
        "blob": {"type": "sdfgrid", "grid": mi.TensorXf(distance.astype(np.float32)), "normals": "smooth"},
    }
    info = MitsubaRenderer(described, 2).parameters()
    assert info["eye.rotation.x"].differentiable
    assert not info["eye.translation.x"].differentiable
    assert "boundary derivatives do not support the silhouettes of SDFGrid" in info["eye.translation.x"].reason
