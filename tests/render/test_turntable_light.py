"""Light whose direction is another in each photograph: what a turned environment map gives, in images and gradients."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np
import pytest

import unrender as ur
from unrender.rendering.mitsuba import turntable_light

ANGLE = 60.0
MAP = (np.random.default_rng(0).uniform(0, 1, (8, 16, 3)) ** 4 * 5).astype(np.float32)


def turn() -> np.ndarray:
    return np.array(mi.ScalarTransform4f().rotate([0, 1, 0], ANGLE).matrix, float).reshape(4, 4)[:3, :3]


def scene(light: dict[str, Any], **sensor: float) -> dict[str, Any]:
    film = {"type": "hdrfilm", "width": 8, "height": 8, "rfilter": {"type": "box"}}
    look = mi.ScalarTransform4f().look_at([0, 1, 4], [0, 0, 0], [0, 1, 0])
    return {
        "type": "scene",
        "ball": {"type": "sphere", "bsdf": {"type": "principled", "roughness": 0.3}},
        "light": light,
        "camera": {"type": "perspective", "fov": 40, "to_world": look, "film": film, **sensor},
    }


def on_turntable() -> dict[str, Any]:
    turns = turntable_light.text(np.stack([np.eye(3), turn()]))
    light = {"type": "turntable", "turns": turns, "map": {"type": "envmap", "bitmap": mi.Bitmap(MAP)}}
    return scene(light, shutter_open=1.0, shutter_close=1.0)


def turned() -> dict[str, Any]:
    to_world = mi.ScalarTransform4f().rotate([0, 1, 0], ANGLE)
    return scene({"type": "envmap", "bitmap": mi.Bitmap(MAP), "to_world": to_world})


def problem(description: Any, key: str) -> ur.Problem:
    return ur.Problem(description, [ur.Parameter(key)], [ur.View(np.zeros((8, 8, 3)))], max_depth=3)


@pytest.mark.slow
def test_images_and_gradients_are_those_of_a_map_that_is_turned() -> None:
    ours, plain = problem(on_turntable, "light.map.data"), problem(turned, "light.data")
    np.testing.assert_allclose(ur.render(ours, spp=16), ur.render(plain, spp=16), rtol=1e-3, atol=1e-5)
    found, expected = (
        next(iter(ur.estimate(each, ur.PathGradient(spp=16)).gradient.values())) for each in (ours, plain)
    )
    np.testing.assert_allclose(found, expected, rtol=1e-2, atol=1e-3 * np.abs(expected).max())
    unturned = problem(lambda: on_turntable() | {"camera": turned()["camera"]}, "light.map.data")  # a planted fault
    assert np.abs(np.asarray(ur.render(unturned, spp=16)) - np.asarray(ur.render(plain, spp=16))).mean() > 0.01


def test_rotations_survive_the_plugin() -> None:
    given = np.stack([np.eye(3), turn(), np.diag([1.0, -1.0, -1.0]), turn() @ np.diag([-1.0, 1.0, -1.0])])
    light = {"type": "turntable", "turns": turntable_light.text(given), "map": {"type": "constant"}}
    renderer: Any = problem(lambda: scene(light), "ball.bsdf.base_color.value").renderer
    np.testing.assert_allclose(turntable_light.turns(renderer.pair.current.emitters()[0]), given, atol=1e-7)


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"turns": "1 0 0"}, "four numbers"),
        ({"turns": "0 0 0 0"}, "four numbers"),
        ({"turns": "1 0 0 nan"}, "four numbers"),
        ({"map": {"type": "point"}}, "light from afar"),
        ({"distance": 0.0}, "distance"),
    ],
)
def test_a_malformed_one_is_one_line(changes: dict[str, Any], expected: str) -> None:
    light = {"type": "turntable", "turns": "1 0 0 0", "map": {"type": "constant"}} | changes
    with pytest.raises(ur.InputError, match=expected) as raised:
        problem(lambda: scene(light), "ball.bsdf.base_color.value")
    assert "\n" not in str(raised.value)
