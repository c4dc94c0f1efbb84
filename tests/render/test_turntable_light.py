"""Light whose direction is another in each photograph: what a turned environment map gives, in images and gradients."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest

import unrender as ur
from kernels import recorded
from unrender.app.evaluation import scenes
from unrender.rendering.mitsuba import film, frozen, turntable_light

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


def three_views() -> ur.Problem:
    """A turntable's: too few views for all of them to be rendered as one table of sensors."""

    def description() -> dict[str, Any]:
        turns = turntable_light.text(np.stack([np.eye(3), turn(), turn() @ turn()]))
        light = {"type": "turntable", "turns": turns, "map": {"type": "envmap", "bitmap": mi.Bitmap(MAP)}}
        base = scene(light)
        camera = base.pop("camera")
        times = ({"shutter_open": float(i), "shutter_close": float(i)} for i in range(3))
        return base | {f"camera-{i}": camera | time for i, time in enumerate(times)}

    views = [ur.View(np.zeros((8, 8, 3)), sensor=i) for i in range(3)]
    return ur.Problem(description, [ur.Parameter("light.map.data")], views, max_depth=3)


@pytest.mark.parametrize("sharing", [True, False])
def test_views_of_a_turntable_share_their_kernels(sharing: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """In one recording, or in one for each view whose time is an input."""
    monkeypatch.setattr(frozen, "_MANY", 3 if sharing else 4)
    given = three_views()
    pictures = [ur.render(given, view=0, spp=4)]
    with recorded() as new:
        pictures += [ur.render(given, view=view, spp=4) for view in (1, 2)]
    assert new
    assert not any(new)
    assert np.abs(pictures[1] - pictures[0]).mean() > 0.01  # the light has turned
    monkeypatch.setattr(film, "open_at_different_times", lambda sensors: False)  # as if time were a constant
    fresh = three_views()
    ur.render(fresh, view=0, spp=4)
    with recorded() as new:
        again = ur.render(fresh, view=1, spp=4)
    assert any(new) != sharing
    np.testing.assert_array_equal(again, pictures[1])


def test_under_another_light_they_share_them_too(tmp_path: Path) -> None:
    given = three_views()
    path = scenes.export_scene(given, given.initial_values(), tmp_path / "scene")

    def later(lit: Any) -> list[bool]:
        scenes.render(lit, lit.sensors()[0], 4, 3)
        with recorded() as new:
            for sensor in lit.sensors()[1:]:
                scenes.render(lit, sensor, 4, 3)
        return new

    new = later(scenes.load_scene(path, np.ones((8, 16, 3), np.float32)))
    assert new
    assert not any(new)
    assert any(later(scenes.load_scene(path)))  # Mitsuba's own cameras hold the time as a constant


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
        ({"map": {"type": "point"}}, "distant emitter"),
        ({"distance": 0.0}, "distance"),
    ],
)
def test_a_malformed_one_is_one_line(changes: dict[str, Any], expected: str) -> None:
    light = {"type": "turntable", "turns": "1 0 0 0", "map": {"type": "constant"}} | changes
    with pytest.raises(ur.InputError, match=expected) as raised:
        problem(lambda: scene(light), "ball.bsdf.base_color.value")
    assert "\n" not in str(raised.value)
