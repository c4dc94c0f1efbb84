# Dr.Jit's stubs know less than its functions return.
# pyright: reportArgumentType=false, reportAttributeAccessIssue=false, reportReturnType=false

"""Gradients for every sensor that Mitsuba has, those among them whose rays have a weight: an irradiancemeter's is π.

Three ways to the same number: the adjoint, finite differences of a pair's previous image on the very same paths (no noise in between), and
finite differences of Mitsuba's own renders, with other samples.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import mitsuba as mi
import numpy as np
import pytest
from fog import grid
from scipy import stats

from tiers import quick
from unrender.rendering.mitsuba import frozen, session
from unrender.rendering.mitsuba.frozen import FrozenFunction
from unrender.rendering.mitsuba.renderer import MitsubaRenderer
from unrender.rendering.renderer import SampleRequest

KEY = "floor.bsdf.reflectance.value"
DEPTH = 4
SIZE = 4
ALL = ("perspective", "thinlens", "orthographic", "distant", "batch", "radiancemeter", "irradiancemeter")
METERS = ("irradiancemeter", "radiancemeter")
STEP = 4e-3


def to_world() -> Any:
    return mi.ScalarTransform4f().look_at([0, -4, 2.2], [0, 0, 0.55], [0, 0, 1])


def film(width: int = SIZE, height: int = SIZE) -> dict[str, Any]:
    return {"type": "hdrfilm", "width": width, "height": height, "rfilter": {"type": "box"}}


def sensors() -> dict[str, dict[str, Any]]:
    """All of Mitsuba's plugins by name, of the same scene. An irradiancemeter comes with the shape that carries it."""
    camera = {"fov": 35, "to_world": to_world()}
    lens = {"type": "thinlens", "aperture_radius": 0.2, "focus_distance": 4.0, **camera}
    plate = mi.ScalarTransform4f().translate([0, -2, 0.6]).rotate([1, 0, 0], 60).scale(0.3)
    return {
        "perspective": {"type": "perspective", "film": film(), **camera},
        "thinlens": {**lens, "film": film()},
        "orthographic": {"type": "orthographic", "to_world": to_world(), "film": film()},
        "distant": {"type": "distant", "direction": [0, 0.5, -1], "target": [1.5, -1, 0], "film": film(1, 1)},
        "batch": {
            "type": "batch",
            "film": film(2 * SIZE, SIZE),
            "first": {"type": "perspective", **camera},
            "second": {"type": "orthographic", "to_world": to_world()},
        },
        "radiancemeter": {"type": "radiancemeter", "origin": [0, -4, 2.2], "direction": [0, 2, -2], "film": film(1, 1)},
        "irradiancemeter": {
            "type": "rectangle",
            "to_world": plate,
            "meter": {"type": "irradiancemeter", "film": film(1, 1)},
        },
    }


def room(*names: str, foggy: bool = False) -> dict[str, Any]:
    """A red floor and a blue ball under a lamp and a sky, with these sensors; in fog where asked for."""
    to = mi.ScalarTransform4f
    found: dict[str, Any] = {
        "type": "scene",
        "floor": {
            "type": "rectangle",
            "to_world": to().scale(3),
            "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.7, 0.4, 0.3]}},
        },
        "ball": {
            "type": "sphere",
            "center": [0, 0, 0.8],
            "radius": 0.8,
            "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.2, 0.4, 0.7]}},
        },
        "lamp": {
            "type": "rectangle",
            "to_world": to().look_at([1.5, -1, 3], [0, 0, 0], [0, 1, 0]) @ to().scale(0.6),
            "emitter": {"type": "area", "radiance": {"type": "rgb", "value": [9.0, 8.0, 6.0]}},
        },
        "sky": {"type": "constant", "radiance": {"type": "rgb", "value": [0.5, 0.6, 0.7]}},
    }
    if foggy:
        medium = {"type": "heterogeneous", "sigma_t": grid(np.full((4, 4, 4, 1), 0.4)), "albedo": 0.7}
        at = to().translate([0, -1, 0.6]).scale([0.5, 0.3, 0.3])
        found["cloud"] = {"type": "cube", "to_world": at, "bsdf": {"type": "null"}, "interior": medium}
    return {**found, **{name: sensors()[name] for name in names}}


def numbers(x: Any) -> np.ndarray:
    return np.array(x).astype(np.float64)


def weighted_sums(images: Any, weight: np.ndarray) -> np.ndarray:
    return (numbers(images) * weight).reshape(len(images), -1).sum(axis=1)


def request_of_all(renderer: MitsubaRenderer, spp: int, seed: int) -> SampleRequest:
    """Every pixel of every sensor, in one launch."""
    counts = [height * width for height, width in renderer.resolutions()]
    of_sensor = np.repeat(np.arange(len(counts)), counts)
    pixels = np.concatenate([np.arange(count) for count in counts])
    return SampleRequest(0, spp, seed, 1, mi.UInt32(pixels), mi.UInt32(of_sensor))


def check_replay(renderer: MitsubaRenderer, request: SampleRequest, key: str, rel: float = 0.02) -> None:
    """The adjoint, and that of a pair, against finite differences on the same paths, for each sensor of the request."""
    session, current = renderer.prepare([key], "path"), renderer.values([key])
    paths = session.image(current, request)
    images = {
        side: session.image_pair(current, {key: current[key] * (1 + side * STEP)}, request, "path") for side in (1, -1)
    }
    assert images[1].previous is not None
    assert images[-1].previous is not None
    slope = (numbers(images[1].previous) - numbers(images[-1].previous))[0] / (2 * STEP)
    which = np.zeros(len(slope), int) if request.sensors is None else np.array(request.sensors)
    rng = np.random.default_rng(2)
    for sensor in np.unique(which):
        weight = rng.uniform(0.5, 1.5, slope.shape) * (which == sensor).reshape(-1, *[1] * (slope.ndim - 1))
        expected = float((slope * weight).sum())
        assert expected != 0
        adjoint = session.adjoint(current, paths.paths, renderer.array(weight[None]))[key]
        pair = images[1]
        none = renderer.array(np.zeros((1, *weight.shape)))
        own, _ = session.adjoint_pair(
            current, {key: current[key] * (1 + STEP)}, pair.paths, renderer.array(weight[None]), none
        )
        for gradient in (adjoint, own[key]):
            found = float((numbers(gradient) * numbers(current[key])).sum())
            assert found == pytest.approx(expected, rel=rel), sensor


def test_gradients_of_all_sensors_in_one_launch() -> None:
    renderer = MitsubaRenderer(room(*ALL), DEPTH)
    check_replay(renderer, request_of_all(renderer, 16, 7), KEY)


@pytest.mark.parametrize("name", quick(ALL, "irradiancemeter"))
def test_gradients_of_each_sensor_alone(name: str) -> None:
    renderer = MitsubaRenderer(room(name), DEPTH)
    check_replay(renderer, SampleRequest(0, 256, 7), KEY)


@pytest.mark.slow
@pytest.mark.parametrize("filter_name", quick(["box", "gaussian"], "gaussian"))
def test_one_recording_serves_all_cameras(filter_name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Images and gradients are those of a scene that has this camera only."""

    def camera(number: int) -> dict[str, Any]:
        origin = [2.0 * number - 3.0, -4 + 0.3 * number, 2.2]
        of_film = {**film(), "rfilter": {"type": filter_name}}
        at = mi.ScalarTransform4f().look_at(origin, [0, 0, 0.55], [0, 0, 1])
        return {"type": "perspective", "fov": 30 + 5 * number, "to_world": at, "film": of_film}

    def session_of(*which: int) -> Callable[[int], tuple[np.ndarray, np.ndarray]]:
        renderer = MitsubaRenderer(room() | {f"camera_{n}": camera(n) for n in which}, DEPTH)
        own, current = renderer.prepare([KEY], "path"), renderer.values([KEY])
        weights = renderer.array(np.linspace(0.5, 1.5, SIZE * SIZE * 3).reshape(1, SIZE, SIZE, 3))

        def of_sensor(sensor: int) -> tuple[np.ndarray, np.ndarray]:
            rendering = own.image(current, SampleRequest(sensor, 64, 3))
            return numbers(rendering.images), numbers(own.adjoint(current, rendering.paths, weights)[KEY])

        return of_sensor

    alone = [session_of(n)(0) for n in range(4)]
    made: list[FrozenFunction] = []

    def recorder(*arguments: Any) -> FrozenFunction:
        made.append(FrozenFunction(*arguments))
        return made[-1]

    monkeypatch.setattr(session, "FrozenFunction", recorder)
    of_sensor = session_of(0, 1, 2, 3)
    for sensor, (image, gradient) in enumerate(alone):
        own_image, own_gradient = of_sensor(sensor)
        np.testing.assert_allclose(own_image, image, rtol=1e-4)
        np.testing.assert_allclose(own_gradient, gradient, rtol=1e-3)
        assert np.abs(own_image - alone[sensor - 1][0]).max() > 0.01
    assert len(made) <= 2  # images, and their adjoint unless their paths are kept


@pytest.mark.slow
@pytest.mark.parametrize("name", ["perspective", *METERS])
def test_gradients_of_each_sensor_before_a_cloud(name: str) -> None:
    """The volumetric kernel: a pair's collisions are those of both states, and its replay is in both."""
    renderer = MitsubaRenderer(room(name, foggy=True), DEPTH)
    check_replay(renderer, SampleRequest(0, 1024, 7), KEY)


@pytest.mark.parametrize("name", quick(("thinlens", "orthographic", "batch"), "thinlens"))
def test_sensors_that_no_recording_may_hold(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Their rays are made outside of it: kernels are recorded, pictures are Mitsuba's own, also where the sensor has moved since, and
    gradients those of kernels that are traced at each call."""
    warned: list[str] = []
    monkeypatch.setattr(frozen, "_warn", warned.append)
    scene = mi.load_dict(room(name))
    renderer = MitsubaRenderer(scene, DEPTH)
    session, current = renderer.prepare([KEY], None), renderer.values([KEY])

    def pictures(first: int) -> np.ndarray:
        requests = [SampleRequest(0, 64, seed) for seed in range(first, first + 12)]
        return np.array([numbers(session.image(current, request).images)[0] for request in requests])

    stale, parameters = pictures(0), mi.traverse(scene)
    key = next(key for key in parameters.keys() if key.startswith(name) and key.endswith("to_world"))  # noqa: SIM118
    parameters[key] = mi.Transform4f().look_at([0.3, -4, 2.0], [0.2, 0, 0.6], [0, 0, 1])  # pyright: ignore[reportCallIssue]
    parameters.update()
    ours = pictures(100)
    integrator: Any = mi.load_dict({"type": "path", "max_depth": DEPTH})
    theirs = np.array([numbers(mi.render(scene, integrator=integrator, spp=64, seed=seed)) for seed in range(12)])  # pyright: ignore[reportArgumentType]
    limit = stats.t.isf((1 - (1 - 1e-3) ** (1 / theirs[0].size)) / 2, 11)

    def z(found: np.ndarray) -> float:
        error = np.sqrt((found.var(0, ddof=1) + theirs.var(0, ddof=1)) / len(found))
        return float((np.abs(found.mean(0) - theirs.mean(0)) / np.maximum(error, 1e-6)).max())

    assert z(ours) < limit
    assert z(stale) > limit, "too noisy to see that the sensor has moved"

    request = SampleRequest(0, 64, 3)
    weight = renderer.array(np.random.default_rng(1).uniform(0.5, 1.5, theirs[:1].shape))
    recorded = session.adjoint(current, session.image(current, request).paths, weight)[KEY]
    assert not warned
    monkeypatch.setattr("unrender.rendering.mitsuba.session.are_recordable", lambda *given: True)
    traced = MitsubaRenderer(scene, DEPTH).prepare([KEY], None)
    traced._recordable = False
    expected = traced.adjoint(current, traced.image(current, request).paths, weight)[KEY]
    np.testing.assert_allclose(numbers(recorded), numbers(expected), rtol=1e-4)


def test_tangents_of_a_weighted_path_are_its_derivative() -> None:
    """Path by path, since each is a pixel of its own here."""
    renderer = MitsubaRenderer(room("irradiancemeter"), DEPTH)
    session, current = renderer.prepare([KEY], "path"), renderer.values([KEY])
    request = SampleRequest(0, 1, 5, 1, mi.UInt32(np.zeros(256, np.uint32)))
    paths = session.image(current, request).paths
    moment = numbers(session.tangent_moment(current, paths, current))
    previous = [
        numbers(session.image_pair(current, {KEY: current[KEY] * (1 + step)}, request, "path").previous)[0]
        for step in (STEP, -STEP)
    ]
    slope = (previous[0] - previous[1]) / (2 * STEP)
    assert (slope > 0.1).any()
    np.testing.assert_allclose(moment, slope**2, rtol=0.02, atol=1e-4)


@pytest.mark.slow  # in the quick tier, the replays are compared on their own paths
@pytest.mark.parametrize("name", METERS)
def test_meters_agree_with_finite_differences_of_mitsuba_s_own_renders(name: str) -> None:
    """Other paths, another integrator, and the scene's own weighting of its sensor."""
    renderer = MitsubaRenderer(room(name), DEPTH)
    session, current = renderer.prepare([KEY], None), renderer.values([KEY])
    one, runs, spp, step = renderer.array(np.ones((1, 1, 1, 3)) / 3), 24, 1 << 12, 0.2
    ours = np.array(
        [
            numbers(session.adjoint(current, session.image(current, SampleRequest(0, spp, seed)).paths, one)[KEY])
            for seed in range(runs)
        ]
    )
    scene = mi.load_dict(room(name))
    integrator, parameters = mi.load_dict({"type": "path", "max_depth": DEPTH}), mi.traverse(scene)
    own = numbers(current[KEY])

    def rendered(change: np.ndarray, seed: int) -> float:
        parameters[KEY] = mi.Color3f(*(own + change).tolist())
        parameters.update()
        return float(numbers(mi.render(scene, integrator=integrator, spp=spp, seed=seed)).mean())

    differences = np.array(
        [
            [(rendered(+step * axis, seed) - rendered(-step * axis, seed)) / (2 * step) for axis in np.eye(3)]
            for seed in range(100, 100 + runs)
        ]
    )
    error = np.sqrt((ours.var(0, ddof=1) + differences.var(0, ddof=1)) / runs)
    z = (ours.mean(0) - differences.mean(0)) / error
    limit = stats.norm.isf((1 - (1 - 1e-3) ** (1 / 3)) / 2)
    assert np.abs(z).max() < limit, (z, ours.mean(0), differences.mean(0), error)
    planted = (3.9 * ours.mean(0) - differences.mean(0)) / error
    assert np.abs(planted).min() > limit, "too noisy to see what the weight did to the gradient"


def test_a_shape_that_carries_a_sensor_has_no_pose_and_sensors_keep_their_order() -> None:
    """A pose of the shape would have to move the meter's rays too; one of the other shapes leaves them where they are."""
    renderer = MitsubaRenderer(room("irradiancemeter", "orthographic"), DEPTH)
    known = renderer.parameters()
    assert "ball.translation" in known
    assert not [key for key in known if key.startswith(("irradiancemeter.", "meter.")) and "translation" in key]
    posed, still = renderer.prepare(["ball.translation"], None, False), renderer.prepare([], None)
    at = {"ball.translation": np.zeros((1, 3), np.float32)}
    for sensor, spp in ((0, 1 << 14), (1, 1 << 10)):
        a = numbers(posed.image_batch(at, SampleRequest(sensor, spp, 1))).mean()
        b = numbers(still.image({}, SampleRequest(sensor, spp, 2)).images).mean()
        assert a == pytest.approx(b, rel=0.05)


def test_the_vertices_of_a_shape_that_carries_a_sensor_have_no_path_gradient() -> None:
    """Path replay does not move the rays."""
    description = room("irradiancemeter")
    plate = description["irradiancemeter"]
    plate["type"] = "cube"
    info = MitsubaRenderer(description, DEPTH).parameters()
    moved = {key: of for key, of in info.items() if key.startswith("irradiancemeter.vertex_positions")}
    assert [(of.differentiable, of.reason) for of in moved.values()] == [
        (False, "it moves a shape that carries a sensor")
    ]
