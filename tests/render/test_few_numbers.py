"""`auto` recovers a few numbers with which the picture changes its form: lamps, lenses, indices of refraction, roughness, skies, poses."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest

import unrender as ur
from tiers import quick, slow
from unrender.methods import method
from unrender.optimizers import ScheduleFree

Scene = dict[str, Any]
SIZE, STEPS = 32, 30
LAMPS = {"lamp0": [-1.0, 1.5, 1.0], "lamp1": [0.2, 1.2, 1.2], "lamp2": [1.1, 1.6, 0.8]}


def camera(kind: str, origin: list[float], **options: Any) -> Scene:
    film = {"type": "hdrfilm", "width": SIZE, "height": SIZE, "rfilter": {"type": "box"}}
    to_world = mi.ScalarTransform4f().look_at(origin, [0, 0, 0], [0, 1, 0])
    return {"type": kind, "fov": 40, "to_world": to_world, "film": film, **options}


def rgb(*values: float) -> Scene:
    return {"type": "rgb", "value": list(values) if len(values) > 1 else float(*values)}


def checkers(scale: float) -> Scene:
    to_uv = mi.ScalarTransform4f().scale([scale, scale, 1])
    return {"type": "diffuse", "reflectance": {"type": "checkerboard", "to_uv": to_uv}}


def floor(bsdf: Scene, height: float, size: float) -> Scene:
    place = mi.ScalarTransform4f().translate([0, height, 0]).rotate([1, 0, 0], -90).scale(size)
    return {"type": "rectangle", "to_world": place, "bsdf": bsdf}


def lamps() -> tuple[Scene, dict[str, Any], dict[str, Any], float]:
    made: Scene = {"type": "scene", "cam": camera("perspective", [0, 3, 5])}
    made["floor"] = floor({"type": "diffuse", "reflectance": rgb(0.6)}, 0.0, 3)
    made["box"] = {"type": "cube", "to_world": mi.ScalarTransform4f().translate([0, 0.3, 0]).scale(0.3)}
    for index, (name, place) in enumerate(LAMPS.items()):
        colour = [4.0 if channel == index else 1.0 for channel in range(3)]
        made[name] = {"type": "point", "position": place, "intensity": rgb(*colour)}
    truth = {f"{name}.position": place for name, place in LAMPS.items()}
    start = {"lamp0.position": [-0.7, 1.2, 1.4], "lamp1.position": [0.0, 1.6, 0.7], "lamp2.position": [0.8, 1.3, 1.2]}
    return made, truth, start, 0.05


def lens() -> tuple[Scene, dict[str, Any], dict[str, Any], float]:
    ball = {"type": "sphere", "radius": 0.5, "bsdf": {"type": "diffuse", "reflectance": rgb(0.5, 0.1, 0.1)}}
    made = {
        "type": "scene",
        "cam": camera("thinlens", [0, 1, 5], aperture_radius=0.3, focus_distance=5.0),
        "floor": floor(checkers(12), -0.6, 5),
        "ball": ball,
        "sky": {"type": "constant"},
    }
    return (
        made,
        {"cam.focus_distance": 5.0, "cam.aperture_radius": 0.3},
        {"cam.focus_distance": 3.5, "cam.aperture_radius": 0.15},
        0.1,
    )


def view() -> tuple[Scene, dict[str, Any], dict[str, Any], float]:
    made = {
        "type": "scene",
        "cam": camera("perspective", [0, 1, 5], principal_point_offset_x=0.05),
        "floor": floor(checkers(12), -0.6, 5),
        "ball": {"type": "sphere", "radius": 0.5, "bsdf": {"type": "diffuse", "reflectance": rgb(0.5, 0.1, 0.1)}},
        "sky": {"type": "constant"},
    }
    truth = {"cam.x_fov": 40.0, "cam.principal_point_offset_x": 0.05}
    return made, truth, {"cam.x_fov": 37.0, "cam.principal_point_offset_x": 0.0}, 0.02


def glass() -> tuple[Scene, dict[str, Any], dict[str, Any], float]:
    back = mi.ScalarTransform4f().translate([0, 0, -2]).scale(3)
    made = {
        "type": "scene",
        "cam": camera("perspective", [0, 0.5, 4]),
        "glass": {"type": "sphere", "bsdf": {"type": "roughdielectric", "alpha": 0.15, "int_ior": 1.6}},
        "back": {"type": "rectangle", "to_world": back, "bsdf": checkers(6)},
        "sky": {"type": "constant"},
    }
    return made, {"glass.bsdf.eta": 1.6}, {"glass.bsdf.eta": 1.3}, 0.02


def polished(bsdf: Scene) -> Scene:
    """Return a ball on a checkered floor, between a lamp and the sky."""
    place = mi.ScalarTransform4f().look_at([-1.5, 3, 1.5], [0, 0, 0], [0, 1, 0]).scale(0.6)
    lamp = {"type": "rectangle", "to_world": place, "emitter": {"type": "area", "radiance": rgb(8.0)}}
    view = camera("perspective", [0, 1.5, 4])
    made = {
        "type": "scene",
        "cam": view,
        "floor": floor(checkers(8), -0.7, 3),
        "lamp": lamp,
        "sky": {"type": "constant"},
    }
    return made | {"ball": {"type": "sphere", "radius": 0.7, "bsdf": bsdf}}


def plastic() -> tuple[Scene, dict[str, Any], dict[str, Any], float]:
    """A roughness without a path gradient."""
    made = polished({"type": "roughplastic", "diffuse_reflectance": rgb(0.3, 0.1, 0.1), "alpha": 0.1})
    return made, {"ball.bsdf.alpha": 0.1}, {"ball.bsdf.alpha": 0.4}, 0.01


def metal() -> tuple[Scene, dict[str, Any], dict[str, Any], float]:
    """A roughness and a colour with path gradients."""
    made = polished({"type": "roughconductor", "specular_reflectance": rgb(0.9, 0.6, 0.3), "alpha": 0.2})
    truth = {"ball.bsdf.alpha.value": 0.2, "ball.bsdf.specular_reflectance.value": [0.9, 0.6, 0.3]}
    return made, truth, {"ball.bsdf.alpha.value": 0.5, "ball.bsdf.specular_reflectance.value": 0.5}, 0.01


def cut_out() -> tuple[Scene, dict[str, Any], dict[str, Any], float]:
    """A roughness and a colour below an opacity. By path gradients the roughness ran to 0.02, where the picture hardly depends on it."""
    made = polished({"type": "roughconductor", "specular_reflectance": rgb(0.9, 0.6, 0.3), "alpha": 0.25})
    made["ball"]["bsdf"] = {"type": "mask", "opacity": 0.8, "nested": made["ball"]["bsdf"]}
    colour, alpha = (f"ball.bsdf.nested_bsdf.{name}.value" for name in ("specular_reflectance", "alpha"))
    truth = {"ball.bsdf.opacity.value": 0.8, alpha: 0.25, colour: [0.9, 0.6, 0.3]}
    return made, truth, {"ball.bsdf.opacity.value": 0.5, alpha: 0.5, colour: 0.5}, 0.02


def sky() -> tuple[Scene, dict[str, Any], dict[str, Any], float]:
    view = camera("perspective", [0, 1, 5])
    view["to_world"] = mi.ScalarTransform4f().look_at([0, -3, 1.5], [0, 0, 0.3], [0, 0, 1])  # the zenith is z
    paint = {"type": "diffuse", "reflectance": rgb(0.6, 0.5, 0.4)}
    made = {
        "type": "scene",
        "cam": view,
        "floor": {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale(3), "bsdf": paint},
        "ball": {"type": "sphere", "center": [0, 0, 0.5], "radius": 0.5},
        "sky": {"type": "sunsky", "turbidity": 3.0, "sun_direction": [0.3, 0.4, 0.86]},
    }
    return made, {"sky.turbidity": 3.0}, {"sky.turbidity": 6.0}, 0.7  # the reference has noise


def sunlight() -> tuple[Scene, dict[str, Any], dict[str, Any], float]:
    """A sun whose start is behind the scene."""
    made, _, _, _ = sky()
    made["floor"]["bsdf"] = checkers(3)
    return made, {"sky.sun_direction": [0.3, 0.4, 0.86]}, {"sky.sun_direction": [-0.8, -0.3, 0.4]}, 3.0  # degrees


def pose() -> tuple[Scene, dict[str, Any], dict[str, Any], float]:
    place = mi.ScalarTransform4f().translate([0.3, 0.35, 0.2]).rotate([0, 1, 0], 25).scale([0.3, 0.35, 0.2])
    walls = {"type": "diffuse", "reflectance": rgb(0.6, 0.5, 0.4)}
    made = {
        "type": "scene",
        "cam": camera("perspective", [0, 2, 4]),
        "floor": floor(walls, 0.0, 2.5),
        "block": {"type": "cube", "to_world": place, "bsdf": {"type": "diffuse", "reflectance": rgb(0.7, 0.3, 0.15)}},
        "sky": {"type": "constant"},
    }
    truth = {"block.translation": [0.0, 0.0, 0.0], "block.rotation.y": 0.0}
    return made, truth, {"block.translation": [0.25, 0.0, -0.2], "block.rotation.y": 0.5}, 0.05


CASES: dict[str, Callable[[], tuple[Scene, dict[str, Any], dict[str, Any], float]]] = {
    "lamps": lamps,
    "lens": lens,
    "view": view,
    "glass": glass,
    "plastic": plastic,
    "metal": metal,
    "cut-out": cut_out,
    "sky": sky,
    "sunlight": sunlight,
    "pose": pose,
}


@pytest.mark.parametrize("name", quick(CASES, "lens"))
def test_auto_finds_the_right_values(name: str) -> None:
    scene, truth, start, tolerance = CASES[name]()
    integrator = mi.load_dict({"type": "path", "max_depth": 6})
    reference = np.array(mi.render(mi.load_dict(scene), integrator=integrator, spp=2048))
    unknown = [ur.Parameter(key, initial=value) for key, value in start.items()]
    problem = ur.Problem(scene, unknown, [ur.View(reference)], max_depth=6, truth=truth)
    result = ur.optimize(problem, steps=STEPS, progress=False)
    assert "Gauss-Newton steps" in result.choices[0]
    assert result.status == "finished"
    errors = problem.parameter_error(result.parameters)
    assert max(errors.values()) < tolerance, errors
    if name == "sunlight":  # two returned lengths were 0.2 and 1.1
        (direction,) = result.parameters.values()
        assert np.linalg.norm(direction) == pytest.approx(1.0, abs=1e-5)
        (error,) = result.standard_error.values()
        assert np.linalg.norm(error) < 0.05


LIGHTS = {
    "ball": {
        "type": "sphere",
        "center": [0.8, 1.0, 0.0],
        "radius": 0.3,
        "emitter": {"type": "area", "radiance": {"type": "rgb", "value": [30.0, 25.0, 20.0]}},
    },
    "point": {"type": "point", "position": [-1.5, 1.5, 1.5], "intensity": {"type": "rgb", "value": [5.0, 3.0, 8.0]}},
    "sky": {"type": "constant", "radiance": {"type": "rgb", "value": [0.2, 0.3, 0.4]}},
}
"""A lamp that the camera sees, and two lights that it does not see."""
BRIGHTNESSES = {"ball.emitter.radiance.value": 25.0, "point.intensity.value": 5.0, "sky.radiance.value": 0.3}


@pytest.mark.parametrize(
    "factors", [slow((0.1, 0.1, 0.1)), slow((10.0, 10.0, 10.0)), (10.0, 0.1, 10.0)], ids=["low", "high", "mixed"]
)
def test_lights_arrive_from_a_tenth_and_from_ten_times_their_brightness(
    factors: tuple[float, ...], tmp_path: Any
) -> None:
    view = camera("perspective", [0, 2, 5])
    view["film"] |= {"width": 12, "height": 12}
    scene = {"type": "scene", "cam": view, "floor": floor({"type": "diffuse", "reflectance": rgb(0.5)}, 0, 3), **LIGHTS}
    reference = np.array(mi.render(mi.load_dict(scene | {"integrator": {"type": "path", "max_depth": 2}}), spp=1024))
    starts = zip(BRIGHTNESSES.items(), factors, strict=True)
    unknown = [ur.Parameter(key, initial=factor * value) for (key, value), factor in starts]
    problem = ur.Problem(scene, unknown, [ur.View(reference)], max_depth=2)
    result = ur.optimize(problem, steps=10, progress=False, run_directory=tmp_path / "run")
    assert "pictures are linear in ball.emitter.radiance.value" in result.choices[0]
    assert result.status == "finished"
    assert not result.undetermined
    assert not result.warnings
    for key, light in zip(BRIGHTNESSES, LIGHTS.values(), strict=True):
        colour = light.get("emitter", light).get("radiance") or light["intensity"]
        np.testing.assert_allclose(result.parameters[key], colour["value"], rtol=0.03)


def test_a_direction_of_any_length_means_the_same_sun() -> None:
    """Mitsuba normalises it at loading, but not when it is set: half a vector is then another sky."""
    scene, truth, _, _ = sunlight()
    key, direction = next((key, np.array(value) / np.linalg.norm(value)) for key, value in truth.items())
    problem = ur.Problem(scene, [ur.Parameter(key)], [ur.View(np.zeros((SIZE, SIZE, 3), np.float32))], max_depth=2)
    images = [ur.render(problem, {key: factor * direction}, spp=16, seed=1) for factor in (1.0, 0.4, 3.0)]
    for image in images[1:]:  # rounding changes a few paths
        assert np.abs(image - images[0]).mean() < 0.01 * images[0].mean()


def test_on_a_plateau_poses_take_steps_by_a_smoothed_loss() -> None:
    """Derivative images explain a residual that overlaps the block, and none beside it."""
    scene, _, _, _ = pose()
    reference = np.array(mi.render(mi.load_dict(scene), integrator=mi.load_dict({"type": "path"}), spp=256))
    chosen = {}
    for name, place in {"near": 0.25, "far": -1.2}.items():
        unknown = [ur.Parameter("block.translation.x", initial=place)]
        plan = method("auto").plan(ur.Problem(scene, unknown, [ur.View(reference)]))
        chosen[name] = type(plan.estimator).__name__
    assert chosen == {"near": "GaussNewton", "far": "SmoothedDerivatives"}


@pytest.mark.slow
def test_the_pose_and_the_lens_of_a_camera_take_gauss_newton_steps_together() -> None:
    made, _, _, _ = lens()
    reference = np.array(mi.render(mi.load_dict(made | {"integrator": {"type": "path", "max_depth": 2}}), spp=128))
    start = [
        ur.Parameter("cam.translation", initial=[0.05, 0.05, 0.0]),
        ur.Parameter("cam.aperture_radius", initial=0.2),
    ]
    problem = ur.Problem(made, start, [ur.View(reference)], max_depth=2)
    plan = method("auto").plan(problem)
    assert isinstance(plan.estimator, ur.GaussNewton)
    result = ur.optimize(problem, ur.GaussNewton(64, 8), ur.optimizers.AveragedNewton(), steps=12)
    np.testing.assert_allclose(result.parameters["cam.translation"], 0.0, atol=0.02)
    np.testing.assert_allclose(result.parameters["cam.aperture_radius"], 0.3, atol=0.05)


def test_environment_maps_alone_are_pulled_to_their_start(tmp_path: Path) -> None:
    """They have texels that pictures hardly show. The state of the pull is part of a checkpoint."""
    made, _, _, _ = metal()
    bitmap = mi.Bitmap(np.random.default_rng(1).uniform(0.2, 1.0, (4, 8, 3)).astype(np.float32))
    made |= {"sky": {"type": "envmap", "bitmap": bitmap}, "cam": camera("perspective", [0, 1.5, 4])}
    keys = ["sky.data", "lamp.emitter.radiance.value", "ball.bsdf.specular_reflectance.value"]
    unknown = [ur.Parameter(key, initial=0.5) for key in keys]
    problem = ur.Problem(made, unknown, [ur.View(np.ones((SIZE, SIZE, 3), np.float32))], max_depth=3)
    plan = method("auto").plan(problem)
    assert isinstance(plan.optimizer, ScheduleFree)
    assert "a weak pull to their start, for texels that the pictures hardly show: sky.data" in plan.reasons
    assert dict(plan.optimizer.pulled) == {"sky.data": pytest.approx(2 / (3 * SIZE**2 * 0.7**2))}
    whole = ur.optimize(problem, steps=4, progress=False)
    ur.optimize(problem, steps=2, run_directory=tmp_path / "run", progress=False)
    resumed = ur.resume(tmp_path / "run", problem, steps=4)
    np.testing.assert_allclose(
        resumed.last["sky.data"], whole.last["sky.data"], rtol=1e-5
    )  # two threads add in any order
