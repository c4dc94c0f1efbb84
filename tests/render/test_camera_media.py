# Dr.Jit's stubs know less than its functions return.
# pyright: reportArgumentType=false, reportAttributeAccessIssue=false, reportReturnType=false, reportCallIssue=false

"""Cameras inside media: told by the scene or found, some inside and some outside, in media that scatter and in media that emit."""

from __future__ import annotations

import logging
from typing import Any

import mitsuba as mi
import numpy as np
import pytest

import unrender as ur
from tiers import quick
from unrender.rendering.mitsuba import camera_media as camera_media_module
from unrender.rendering.mitsuba.camera_media import camera_media, unbounded_notices
from unrender.rendering.mitsuba.renderer import MitsubaRenderer
from unrender.rendering.renderer import SampleRequest

SIZE = 6
INSIDE, OUTSIDE = [0.1, -0.5, 0.2], [0, -5, 2.2]


def grid(values: np.ndarray) -> dict[str, Any]:
    place = mi.ScalarTransform4f().translate([-1, -1, -1]).scale(2)
    return {
        "type": "gridvolume",
        "grid": mi.VolumeGrid(np.float32(values)),
        "raw": True,
        "to_world": place,
    }


def glow() -> dict[str, Any]:
    rng = np.random.default_rng(3)
    return {
        "type": "emissive",
        "sigma_t": grid(rng.uniform(0.2, 2, (4, 4, 4, 1))),
        "emission": grid(rng.uniform(0.2, 0.9, (4, 4, 4, 3))),
    }


def cloud() -> dict[str, Any]:
    return {"type": "heterogeneous", "sigma_t": grid(np.full((4, 4, 4, 1), 0.8)), "albedo": 0.8}


def camera(origin: list[float], kind: str = "perspective", **more: Any) -> dict[str, Any]:
    film = {"type": "hdrfilm", "width": SIZE, "height": SIZE, "rfilter": {"type": "box"}}
    to_world = mi.ScalarTransform4f().look_at(origin, [0, 1, 0], [0, 0, 1])
    return {"type": kind, "to_world": to_world, "film": film, **more}


def scene(medium: dict[str, Any], cameras: dict[str, dict[str, Any]], told: tuple[str, ...] = ()) -> dict[str, Any]:
    """A cube of the medium with a stone in it, under a sky where the medium does not shine itself."""
    ref = {"type": "ref", "id": "air"}
    found: dict[str, Any] = {
        "type": "scene",
        "air": {**medium, "id": "air"},
        "body": {"type": "cube", "bsdf": {"type": "null"}, "interior": ref},
        "stone": {"type": "sphere", "center": [0, 0.6, 0], "radius": 0.2, "bsdf": {"type": "diffuse"}},
    }
    if medium["type"] != "emissive":
        found["sky"] = {"type": "constant"}
    return {**found, **{name: {**of, **({"medium": ref} if name in told else {})} for name, of in cameras.items()}}


def inside_of(description: dict[str, Any]) -> list[bool]:
    return [medium is not None for medium in camera_media(mi.load_dict(description))]


def test_a_camera_that_names_no_medium_is_found_to_stand_in_one(caplog: pytest.LogCaptureFixture) -> None:
    """A pinhole, a lens and parallel rays inside; one outside, one that looks away, and one beside a second cube that has no medium."""
    cameras = {
        "pinhole": camera(INSIDE),
        "lens": camera(INSIDE, "thinlens", aperture_radius=0.05, focus_distance=1.0),
        "parallel": camera([0.1, -0.9, 0.2], "orthographic"),
        "meter": {"type": "radiancemeter", "origin": INSIDE, "direction": [0, 1, 0], "film": camera(INSIDE)["film"]},
        "outside": camera(OUTSIDE),
        "away": {**camera(OUTSIDE), "to_world": mi.ScalarTransform4f().look_at(OUTSIDE, [0, -9, 2], [0, 0, 1])},
        "above": camera([0, 0, 5]),
    }
    cameras["meter"]["film"] = {**cameras["meter"]["film"], "width": 1, "height": 1}
    description = scene(cloud(), cameras)
    with caplog.at_level(logging.WARNING, "unrender"):
        assert inside_of(description) == [True, True, True, True, False, False, False]
    said = [record.getMessage() for record in caplog.records]
    assert [line.split(":")[0] for line in said] == ["sensor pinhole", "sensor lens", "sensor parallel", "sensor meter"]


def test_what_a_camera_says_itself_counts(caplog: pytest.LogCaptureFixture) -> None:
    description = scene(cloud(), {"inside": camera(INSIDE), "outside": camera(OUTSIDE)}, told=("inside", "outside"))
    with caplog.at_level(logging.WARNING, "unrender"):
        assert inside_of(description) == [True, True]
    assert not caplog.records


def test_a_medium_that_is_described_twice_has_the_border_of_its_shape() -> None:
    """As the medium of a closed cube, and again as that of the camera and of a stone in it; without the cube it has no border."""
    fog = {"type": "homogeneous", "sigma_t": 0.2, "albedo": 0.8}
    bounded = scene(fog, {"inside": camera(INSIDE, medium=fog)})
    bounded["stone"]["exterior"] = fog
    assert not unbounded_notices(mi.load_dict(bounded, optimize=False))
    outside = {**bounded, "outside": camera(OUTSIDE, medium=fog)}
    assert len(unbounded_notices(mi.load_dict(outside, optimize=False))) == 1
    del bounded["body"]
    assert len(unbounded_notices(mi.load_dict(bounded, optimize=False))) == 1


def test_a_medium_that_many_objects_describe_costs_one_search(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each object had a search of its own: 300 stones took 17 s before the first step, now 0.3 s."""
    fog, listed = {"type": "homogeneous", "sigma_t": 0.2, "albedo": 0.8}, []
    described = scene(fog, {"inside": camera(INSIDE, medium=fog)})
    for n in range(9):
        described[f"stone{n}"] = {"type": "sphere", "center": [0.1 * n, 0.0, 0.0], "radius": 0.02, "exterior": fog}
    media = camera_media_module.media
    monkeypatch.setattr(camera_media_module, "media", lambda found: listed.append(0) or media(found))
    assert not unbounded_notices(mi.load_dict(described, optimize=False))
    assert len(listed) == 1


@pytest.mark.parametrize(
    ("own", "keys", "told"),
    [
        ({"sigma_t": 0.2}, ["air"], "sensor inside"),
        ({"sigma_t": 0.3}, ["air"], "sensor inside and 1 more"),
        ({"sigma_t": 0.3}, ["inside.medium"], "sensor inside"),
        ({"sigma_t": 0.3}, ["air", "inside.medium"], ""),
        ({"sigma_t": 0.3}, [], ""),
        (None, ["air"], ""),
    ],
)
def test_a_medium_of_two_descriptions_of_which_one_is_unknown_is_told(own: Any, keys: list[str], told: str) -> None:
    """The camera's copy stayed as it was; a run ended at .06 in place of .15 with a finished status."""
    fog = {"type": "homogeneous", "sigma_t": 0.2, "albedo": 0.8}
    inside = camera(INSIDE, **({} if own is None else {"medium": {**fog, **own}}))
    described = scene(fog, {"inside": inside}, told=("inside",) if own is None else ())
    if told.endswith("more"):
        described["stone"]["exterior"] = fog
    names = [f"{key}.sigma_t.value.value" for key in keys]
    notices = MitsubaRenderer(described, keys=names).notices
    lines = [line for line in notices if "second description" in line]
    assert [line.split(" has a")[0] for line in lines] == ([f"{names[0]}: {told}"] if told else [])
    assert not any("inside.medium_medium" in line for line in notices)


def test_a_camera_behind_the_walls_of_a_room_in_a_medium_is_found() -> None:
    """Its rays pass what bounds no medium."""
    description = scene(cloud(), {"inside": camera(INSIDE)})
    for axis in range(3):
        for side in (-0.8, 0.8):
            at = np.eye(3)[axis] * side
            up = np.roll(np.eye(3)[axis], 1)
            wall = mi.ScalarTransform4f().look_at(at.tolist(), [0, 0, 0], up.tolist()).scale(0.8)
            description[f"wall_{axis}_{side < 0}"] = {"type": "rectangle", "to_world": wall}
    assert inside_of(description) == [True]


@pytest.mark.slow
def test_a_camera_inside_renders_the_same_told_or_found() -> None:
    """To the bit, image and gradient; it was black for a medium that emits."""
    images, gradients = [], []
    key = "air.emission.data"
    for told in ((), ("camera",)):
        renderer = MitsubaRenderer(scene(glow(), {"camera": camera(INSIDE)}, told), 2)
        session = renderer.prepare([key], None)
        rendering = session.image(renderer.values([key]), SampleRequest(0, 16, 1))
        weight = renderer.array(np.ones((1, SIZE, SIZE, 3)))
        gradients.append(np.array(session.adjoint(renderer.values([key]), rendering.paths, weight)[key]))
        images.append(np.array(rendering.images))
    assert images[0].mean() > 0.1
    np.testing.assert_array_equal(images[0], images[1])
    np.testing.assert_allclose(gradients[0], gradients[1], rtol=1e-4, atol=1e-5 * np.abs(gradients[1]).max())


@pytest.mark.parametrize("medium", quick([glow, cloud], glow))
def test_cameras_in_different_media_share_a_launch(medium: Any) -> None:
    """Lanes of one sensor get the same random numbers as if it were alone."""
    cameras = {"inside": camera(INSIDE), "outside": camera(OUTSIDE), "found": camera([0, -0.4, -0.3])}
    renderer = MitsubaRenderer(scene(medium(), cameras, ("inside",)), 3)
    session, count = renderer.prepare([], None), SIZE * SIZE
    pixels = mi.UInt32(np.arange(count, dtype=np.uint32))
    shown = []
    for sensor in range(3):
        of_pixel = mi.UInt32(np.full(count, sensor, np.uint32))
        together = session.image({}, SampleRequest(0, 4, 5, 1, pixels, of_pixel)).images
        alone = session.image({}, SampleRequest(sensor, 4, 5, 1, pixels)).images
        # Rounding of the ray turns a few collisions.
        assert np.isclose(np.array(together), np.array(alone), rtol=1e-4).mean() > 0.85
        shown.append(np.array(alone).mean())
    assert min(shown) > 0.05
    assert len(set(shown)) == 3
    mixed = mi.UInt32(np.arange(count, dtype=np.uint32) % 3)
    image = np.array(session.image({}, SampleRequest(0, 256, 6, 1, pixels, mixed)).images)[0]
    for sensor in range(3):
        alone = np.array(session.image({}, SampleRequest(sensor, 256, 7, 1, pixels)).images)[0]
        chosen = np.arange(count) % 3 == sensor
        assert image[chosen].mean() == pytest.approx(alone[chosen].mean(), rel=0.1)


@pytest.mark.slow
@pytest.mark.parametrize("part", ["emission", "sigma_t"])
def test_adaptive_pixels_inside_a_medium_that_emits(part: str) -> None:
    """Without any other emitter, and with cameras inside and outside; forward mode failed on the extinction."""
    cameras = {"inside": camera(INSIDE), "outside": camera(OUTSIDE)}
    key = f"air.{part}.data"
    reference = np.full((SIZE, SIZE, 3), 0.3, np.float32)
    views = [ur.View(reference, sensor=sensor) for sensor in (0, 1)]
    found = ur.Problem(lambda: scene(glow(), cameras), [ur.Parameter(key, 0.5)], views, max_depth=2)
    estimator = ur.PathGradient(pixels=ur.pixels.Adaptive(64, denoiser="none"), spp=2)
    result = ur.optimize(found, estimator, ur.optimizers.Adam(), steps=2)
    assert np.isfinite([row["loss"] for row in result.history]).all()
    assert not np.allclose(np.array(result.parameters[key]), 0.5)


def test_a_medium_that_emits_tells_what_it_is() -> None:
    assert str(mi.load_dict(glow())).startswith("EmissiveMedium[")


def test_light_leaves_fog_without_a_border_in_the_channel_that_it_lets_through():
    """Its flights once had no end, since light of this channel never collides."""

    def red_and_blue(fog: dict[str, Any]) -> np.ndarray:
        stone = {"type": "sphere", "radius": 1, "bsdf": {"type": "diffuse"}}
        described = {"type": "scene", "stone": stone, "sky": {"type": "constant"}, "eye": camera(OUTSIDE, **fog)}
        session = MitsubaRenderer(described, 4).prepare([], None, False)
        return np.array(session.image({}, SampleRequest(0, 1024, 1)).images).mean((0, 1, 2))[[0, 2]]

    colours = {"type": "rgb", "value": [0.5, 0.2, 0]}
    seen = red_and_blue({"medium": {"type": "homogeneous", "albedo": 0.5, "sigma_t": colours}})
    clear = red_and_blue({})
    assert seen[1] == pytest.approx(clear[1], rel=0.03)
    assert seen[0] < 0.1 * clear[0]


def test_a_channel_with_hardly_any_extinction_ends_its_flights_through_fog_without_a_border():
    """The steps of a flight once grew as the ratio of the extinctions."""

    def seen(blue: float) -> np.ndarray:
        colours = {"type": "rgb", "value": [0.5, 0.2, blue]}
        fog = {"type": "homogeneous", "albedo": 0.5, "sigma_t": colours}
        stone = {"type": "sphere", "radius": 1, "emitter": {"type": "area", "radiance": 2.0}}
        described = {"type": "scene", "stone": stone, "eye": camera(OUTSIDE, medium=fog)}
        session = MitsubaRenderer(described, 4).prepare([], None, False)
        return np.array(session.image({}, SampleRequest(0, 256, 1)).images)

    np.testing.assert_allclose(seen(1e-9), seen(0.0), atol=1e-6)


def test_gradient_by_extinction_where_one_channel_leaves_fog_without_a_border():
    """A lamp at distance d fills half of the image: its radiance exp(-σ d) has the derivative -d exp(-σ d). Paths beside the lamp once
    gave an infinite one, or NaN."""
    key, d, σ = "eye.medium.sigma_t.value.value", 3.0, np.array([0.5, 0.2, 0])
    place = mi.ScalarTransform4f().translate([1, 0, d]).rotate([1, 0, 0], 180)
    half = {"type": "rectangle", "to_world": place, "emitter": {"type": "area"}}
    film = {"type": "hdrfilm", "width": SIZE, "height": SIZE, "rfilter": {"type": "box"}}
    fog = {"type": "homogeneous", "albedo": 0.0, "sigma_t": {"type": "rgb", "value": list(σ)}}
    eye = {"type": "perspective", "fov": 1, "film": film, "medium": fog}
    renderer = MitsubaRenderer({"type": "scene", "half": half, "sky": {"type": "constant"}, "eye": eye}, 2, [key])
    session, values = renderer.prepare([key], None), renderer.values([key])
    paths = session.image(values, SampleRequest(0, 4096, 1)).paths
    weights = renderer.array(np.ones((1, SIZE, SIZE, 3), np.float32))
    found = np.array(session.adjoint(values, paths, weights)[key])
    assert np.isfinite(found).all()
    np.testing.assert_allclose(found[:2], (-d * np.exp(-σ * d) * SIZE * SIZE / 2)[:2], rtol=0.03)


def test_in_scattering_in_a_channel_without_extinction_is_differentiated_beyond_all_shapes():
    """Light of one lamp, scattered once, beside the lamp: the image rises with the extinction from 0, at points beyond the lamp too."""
    key = "eye.medium.sigma_t.value.value"
    place = mi.ScalarTransform4f().translate([2, 0, 3])
    film = {"type": "hdrfilm", "width": SIZE, "height": SIZE, "rfilter": {"type": "box"}}
    lamp = {"type": "sphere", "radius": 0.3, "to_world": place, "emitter": {"type": "area"}}
    fog = {"type": "homogeneous", "albedo": 1.0, "sigma_t": {"type": "rgb", "value": [0.5, 0.2, 0]}}
    eye = {"type": "perspective", "fov": 5, "film": film, "medium": fog}
    renderer = MitsubaRenderer({"type": "scene", "lamp": lamp, "eye": eye}, 2, [key])
    session, values = renderer.prepare([key], None), renderer.values([key])
    weights = renderer.array(np.ones((1, SIZE, SIZE, 3), np.float32))
    paths = session.image(values, SampleRequest(0, 4096, 1)).paths
    found = np.array(session.adjoint(values, paths, weights)[key])[2]
    # The lamp of radius r is a point of intensity π r² at 2 from the axis: ∫₀^∞ π r² / (4π (4 + (t - 3)²)) dt per pixel.
    expected = 0.3**2 / 4 * (np.pi / 2 + np.arctan(1.5)) / 2 * SIZE * SIZE
    assert found == pytest.approx(expected, rel=0.05)


def test_a_sky_around_fog_without_a_border_is_told():
    """Mitsuba's picture depends on whether emitters are sampled there; inside a shape it does not."""
    fog = {"type": "homogeneous", "sigma_t": 0.1, "albedo": 0.9}
    inside = {"pinhole": camera(INSIDE)}
    closed = scene(fog, inside, told=("pinhole",))
    endless = {name: part for name, part in closed.items() if name != "body"}
    dark = {name: part for name, part in endless.items() if name != "sky"}
    for description, told in ((endless, True), (closed, False), (dark, False)):
        notices = MitsubaRenderer(description).notices
        assert any("put the medium inside a closed shape" in line for line in notices) is told
    means: dict[str, list[float]] = {"closed": [], "endless": []}
    for name, description in (("closed", closed), ("endless", endless)):
        for sampled in (True, False):
            air = {**description["air"], "sample_emitters": sampled}
            loaded = mi.load_dict({**description, "air": air})
            integrator = mi.load_dict({"type": "volpath", "max_depth": 4})
            means[name].append(float(np.mean(mi.render(loaded, integrator=integrator, spp=1024))))
    assert means["closed"][0] == pytest.approx(means["closed"][1], rel=0.02)
    assert means["endless"][0] > 1.1 * means["endless"][1]
