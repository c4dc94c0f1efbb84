"""Gradients at the ends of ranges, where a surface is black or a lobe has the probability 0."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np
import pytest

import unrender as ur
from unrender.rendering.mitsuba.renderer import MitsubaRenderer

KEY, GREY, SIDE = "floor.bsdf.reflectance.value", 0.5, 4
LIGHT = {"type": "area", "radiance": {"type": "rgb", "value": 1.0}}


def made(description: dict[str, Any], parameter: ur.Parameter) -> ur.Problem:
    """Of a black reference."""
    renderer = MitsubaRenderer(description, keys=[parameter.key])
    return ur.Problem(renderer, [parameter], [ur.View(np.zeros((SIDE, SIDE, 3), np.float32))])


def diffuse(value: float) -> dict[str, Any]:
    return {"type": "diffuse", "reflectance": {"type": "rgb", "value": [value] * 3}}


def camera(**to_world: Any) -> dict[str, Any]:
    film = {"type": "hdrfilm", "width": SIDE, "height": SIDE, "rfilter": {"type": "box"}}
    look = mi.ScalarTransform4f().look_at(**to_world)
    return {"type": "perspective", "fov": 40.0, "to_world": look, "film": film}


def glowing_room(floor: float) -> dict[str, Any]:
    """Closed and bright everywhere: the floor has the radiance 1 + ρ (1 + grey) by paths of three segments."""
    to = mi.ScalarTransform4f()
    return {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 3},
        "camera": camera(origin=[0, 0.5, 0], target=[0, -1, 0], up=[0, 0, 1]),
        "room": {"type": "cube", "flip_normals": True, "bsdf": diffuse(GREY), "emitter": LIGHT},
        "floor": {
            "type": "rectangle",
            "to_world": to.translate([0, -0.95, 0]).rotate([1, 0, 0], -90),
            "bsdf": diffuse(floor),
            "emitter": LIGHT,
        },
    }


@pytest.mark.parametrize("floor", [0.0, 0.3])
def test_black_reflects_light_of_several_bounces(floor: float) -> None:
    """In a loop of one's own, and in `estimate`: the derivative of the mean radiance by the floor's reflectance is 1 + grey."""
    found = []
    for seed in range(6):
        renderer = ur.Renderer(lambda: glowing_room(floor), [KEY], spp=64, seed=seed)
        weights = np.full((SIDE, SIDE, 3), 1 / (SIDE * SIDE), np.float32)
        renderer.render(None)
        found.append(np.asarray(renderer.backward(weights)[KEY]).mean())
    problem = made(glowing_room(floor), ur.Parameter(KEY))
    slopes = [np.mean(ur.estimate(problem, ur.PathGradient(spp=64), seed=seed).gradient[KEY]) for seed in range(6)]
    for values, expected in ((found, 1 + GREY), (slopes, 2 / 3 * (1 + floor * (1 + GREY)) * (1 + GREY))):
        error = np.std(values, ddof=1) / np.sqrt(len(values))
        assert abs(np.mean(values) - expected) < max(5 * error, 1e-3 * expected), (values, expected)


def ball(bsdf: dict[str, Any]) -> dict[str, Any]:
    return {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 4},
        "camera": camera(origin=[0, 1.2, 4], target=[0, 0, 0], up=[0, 1, 0]),
        "ball": {"type": "sphere", "radius": 0.7, "bsdf": bsdf},
        "sky": {"type": "constant", "radiance": {"type": "rgb", "value": [0.8, 0.9, 1.0]}},
    }


GLASS, RED = {"type": "roughdielectric", "alpha": 0.3}, diffuse(0.6)
LOBES: dict[str, tuple[dict[str, Any], str]] = {
    "blend": ({"type": "blendbsdf", "weight": 0.0, "one": RED, "other": GLASS}, "weight.value"),
    "mask": ({"type": "mask", "opacity": 0.0, "nested": RED}, "opacity.value"),
    "principled": ({"type": "principled", "spec_trans": 0.0}, "spec_trans.value"),
    "thin": ({"type": "principledthin", "spec_trans": 0.0}, "spec_trans.value"),
    "thin diffuse": ({"type": "principledthin", "diff_trans": 0.0}, "diff_trans.value"),
    "plastic": ({"type": "plastic", "specular_reflectance": 0.0}, "specular_reflectance.value"),
    "rough plastic": ({"type": "roughplastic", "diffuse_reflectance": 0.0}, "diffuse_reflectance.value"),
}
LOBES["metal below a mask"] = ({"type": "mask", "opacity": 1.0, "nested": {"type": "conductor"}}, "opacity.value")


@pytest.mark.parametrize("name", LOBES)
@pytest.mark.parametrize("high", [False, True])
def test_a_start_without_a_lobe_is_moved_with_a_notice(name: str, high: bool) -> None:
    bsdf, slot = LOBES[name]
    key = f"ball.bsdf.{slot}"
    info = MitsubaRenderer(ball(bsdf)).parameters()
    low, top = info[key].lowest, info[key].highest
    assert low is not None
    assert top is not None
    end = top if high else low
    problem = made(ball(bsdf), ur.Parameter(key, initial=np.full(info[key].shape, end)))
    inside = end + (-0.01 if high else 0.01) * (top - low)
    np.testing.assert_allclose(np.array(problem.initial()[key]), inside, rtol=1e-6)
    (line,) = [line for line in problem.notices if "never sampled" in line]
    assert key in line
    assert f"from {end:g} to" in line


def test_a_start_between_the_ends_and_a_map_stay_as_they_are() -> None:
    bsdf, slot = LOBES["blend"]
    key = f"ball.bsdf.{slot}"
    problem = made(ball(bsdf), ur.Parameter(key, initial=0.005))
    assert not any("never sampled" in line for line in problem.notices)
    assert float(np.array(problem.initial()[key])) == pytest.approx(0.005)
    values = np.array([[0.0, 1.0], [0.5, 0.0]], np.float32)[..., None]
    weight = {"type": "bitmap", "bitmap": mi.Bitmap(values), "raw": True}
    problem = made(ball({**bsdf, "weight": weight}), ur.Parameter("ball.bsdf.weight.data"))
    np.testing.assert_array_equal(np.array(problem.initial()["ball.bsdf.weight.data"]), values)
