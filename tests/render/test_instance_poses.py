"""Poses of instances, and of what stands beside them: pictures are those of the scene with the object moved."""

from __future__ import annotations

from functools import cache
from typing import Any

import mitsuba as mi
import numpy as np
import pytest

import unrender as ur
from tiers import quick
from unrender.rendering.mitsuba.renderer import MitsubaRenderer
from unrender.rendering.renderer import SampleRequest

RUNS, SPP = 12, 64
render: Any = mi.render
SHIFT, TURN = np.array([0.1, 0.05, -0.1], np.float32), np.array([0.0, 0.4, 0.0], np.float32)


def scene(moved: str = "", motion: Any = None) -> dict[str, Any]:
    """A group of a cube in two instances, a rectangle and a sphere beside them; `motion` stands before the `to_world` of `moved`."""
    to, size = mi.ScalarTransform4f, 12
    places = {
        "left": to().translate([-0.7, 0, 0]).rotate([0, 1, 0], 20).scale(0.8),
        "right": to().translate([0.8, 0.1, 0]).scale(0.6),
        "ball": to().translate([0, 0.7, 0]).scale(0.3),
        "camera": to().look_at([0, 1.0, 4], [0, 0, 0], [0, 1, 0]),
    }
    if moved:
        places[moved] = motion @ places[moved]
    group = {"type": "shapegroup", "part": {"type": "cube", "to_world": to().scale(0.5), "bsdf": {"type": "diffuse"}}}
    film = {"type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": "box"}}
    copies = {
        name: {"type": "instance", "to_world": places[name], "group": {"type": "ref", "id": "group"}}
        for name in ("left", "right")
    }
    return {
        "type": "scene",
        "camera": {"type": "perspective", "fov": 45.0, "to_world": places["camera"], "film": film},
        "group": group,
        **copies,
        "ball": {"type": "sphere", "to_world": places["ball"]},
        "floor": {"type": "rectangle", "to_world": to().translate([0, -0.6, 0]).rotate([1, 0, 0], -90).scale(3)},
        "sky": {"type": "constant", "radiance": 0.4},
        "sun": {"type": "directional", "direction": [-0.4, -1.0, -0.5], "irradiance": 2.0},
    }


def motion(target: str) -> Any:
    """Turn about the target's centre, and shift."""
    loaded = mi.load_dict(scene(), parallel=False, optimize=False)
    if target == "camera":
        centre = [0.0, 1.0, 4.0]
    else:
        box = next(shape.bbox() for shape in loaded.shapes() if shape.id() == target)
        centre = [float(x) for x in np.array(box.center())]
    to = mi.ScalarTransform4f
    turned = to().translate(centre).rotate([0, 1, 0], float(np.degrees(TURN[1]))).translate([-x for x in centre])
    return to().translate([float(x) for x in SHIFT]) @ turned


def stock(description: dict[str, Any]) -> np.ndarray:
    """Return independent pictures by Mitsuba, (RUNS, H, W, 3)."""
    loaded, path = mi.load_dict(description), mi.load_dict({"type": "path", "max_depth": 3, "rr_depth": 100})
    return np.array([render(loaded, integrator=path, spp=SPP, seed=100 + run) for run in range(RUNS)])


@cache
def at_rest() -> np.ndarray:
    return stock(scene())


def difference(ours: np.ndarray, theirs: np.ndarray) -> float:
    """The largest difference of the means of squares of 3 x 3 pixels, in standard errors."""
    a, b = (x.reshape(RUNS, 4, 3, 4, 3, 3).mean((2, 4)) for x in (ours, theirs))
    error = np.sqrt((a.var(0, ddof=1) + b.var(0, ddof=1)) / RUNS)
    return float(np.max(np.abs(a.mean(0) - b.mean(0)) / np.maximum(error, 1e-4)))


@pytest.mark.parametrize("target", quick(["left", "ball", "camera"], "left"))
def test_pictures_of_posed_objects_beside_instances_are_those_of_the_moved_scene(target: str) -> None:
    renderer = MitsubaRenderer(scene, 3)
    keys = [f"{target}.translation", f"{target}.rotation"]
    session = renderer.prepare(keys, None, derivatives=False)
    states = {keys[0]: np.stack([0 * SHIFT, SHIFT]), keys[1]: np.stack([0 * TURN, TURN])}
    batches = [np.array(session.image_batch(states, SampleRequest(0, SPP, n))) for n in range(RUNS)]
    still, moved = np.array(batches).swapaxes(0, 1)
    assert difference(still, at_rest()) < 6
    assert difference(moved, stock(scene(target, motion(target)))) < 6
    planted = mi.ScalarTransform4f().translate([0.3, 0, 0]) @ motion(target)
    assert difference(moved, stock(scene(target, planted))) > 6


@pytest.mark.slow
def test_a_descent_recovers_the_pose_of_an_instance() -> None:
    renderer = MitsubaRenderer(scene, 2)
    session = renderer.prepare(["left.translation"], None, derivatives=False)
    reference = np.array(session.image({"left.translation": renderer.array(SHIFT)}, SampleRequest(0, 256, 1)).images[0])
    problem = ur.Problem(
        scene, [ur.Parameter("left.translation")], [ur.View(reference)], max_depth=2, truth={"left.translation": SHIFT}
    )
    estimator = ur.SmoothedDerivatives(0.05, samples=8, spp=16)
    result = ur.optimize(problem, estimator, ur.optimizers.Adam(0.02), steps=15, seed=1)
    before, after = (problem.parameter_error(x)["left.translation"] for x in (result.initial, result.parameters))
    assert after < 0.6 * before
