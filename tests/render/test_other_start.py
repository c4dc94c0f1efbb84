"""Runs leave a second minimum for better values of few numbers, and for other turns of shapes; a descent that arrives is not disturbed."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import unrender as ur
from tiers import slow
from unrender.core.errors import InputError
from unrender.estimators.fresh_pictures import FreshPictures
from unrender.methods import method
from unrender.methods.plan import Plan
from unrender.methods.rules.turns import better_turn, turns
from unrender.runs import refinement

pytestmark = pytest.mark.mitsuba

KEY = "floor.bsdf.roughness.value"


def scene(roughness: float) -> dict[str, Any]:
    """A metal floor beside the reflection of a lamp: pictures are bright at medium roughness, and alike at 0.2 and 0.85."""
    to_world = mi.ScalarTransform4f
    film = {"type": "hdrfilm", "width": 24, "height": 24, "rfilter": {"type": "box"}}
    view = to_world().look_at([0, 2, 3], [0, 0, 1.5], [0, 1, 0])
    metal = {
        "type": "principled",
        "base_color": {"type": "rgb", "value": [0.6, 0.3, 0.2]},
        "roughness": roughness,
        "metallic": 1.0,
    }
    return {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 3},
        "cam": {"type": "perspective", "fov": 30, "to_world": view, "film": film},
        "floor": {"type": "rectangle", "to_world": to_world().rotate([1, 0, 0], -90).scale(2.5), "bsdf": metal},
        "lamp": {"type": "point", "position": [2, 1, -2], "intensity": {"type": "rgb", "value": 12.0}},
        "sky": {"type": "constant", "radiance": {"type": "rgb", "value": 0.1}},
    }


def problem(truth: float, start: float) -> ur.Problem:
    reference = np.array(mi.render(mi.load_dict(scene(truth)), spp=1024))
    return ur.Problem(scene(start), [ur.Parameter(KEY)], [ur.View(reference)], max_depth=3)


@pytest.mark.parametrize(("truth", "start"), [slow(0.2, 0.5), (0.85, 0.2)])
def test_a_run_leaves_a_second_minimum(truth: float, start: float, tmp_path: Path) -> None:
    made = problem(truth, start)
    result = ur.optimize(made, steps=60, run_directory=tmp_path / "whole", checkpoint_every=20)
    assert result.parameters[KEY] == pytest.approx(truth, abs=0.01)
    assert any("begins again after step 24" in line for line in result.adapted)
    assert not any("differs" in line for line in result.warnings)
    resumed = ur.resume(tmp_path / "whole", made, steps=61)
    assert any("begins again after step 24" in line for line in resumed.adapted)
    assert resumed.parameters[KEY] == pytest.approx(truth, abs=0.01)


def test_a_descent_that_arrives_is_not_disturbed() -> None:
    made = problem(0.2, 0.25)
    plan = method("auto").plan(made)
    assert plan.other_starts == (KEY,)
    result = ur.optimize(made, plan, steps=40)
    alone = ur.optimize(made, replace(plan, other_starts=()), steps=40)
    # Sums of several threads have no fixed order.
    np.testing.assert_allclose(result.last[KEY], alone.last[KEY], rtol=1e-4)
    assert not any("begins again" in line for line in result.adapted)


def test_a_plan_keeps_the_keys_of_other_starts() -> None:
    made = problem(0.2, 0.5)
    table = method("auto").plan(made).table()
    assert Plan.from_table(made, table, "plan").other_starts == (KEY,)
    with pytest.raises(InputError, match="other_starts: expected a list of unknowns"):
        Plan.from_table(made, table | {"other_starts": ["lamp"]}, "plan")


TURN = "block.rotation.y"


def room(resolution: int = 24, lean: float = 0.0) -> dict[str, Any]:
    """A block of unequal sides on a floor, in the light of a lamp and a sky, seen from two sides; upright, it is symmetric."""
    to_world = mi.ScalarTransform4f
    shear: Any = np.eye(4) + np.outer([lean, 0, 0, 0], [0, 1, 0, 0])
    film = {"type": "hdrfilm", "width": resolution, "height": resolution, "rfilter": {"type": "box"}}
    texture = np.random.default_rng(2).uniform(0.2, 0.8, (8, 8, 3)).astype(np.float32)
    picture = {"type": "bitmap", "bitmap": mi.Bitmap(texture), "raw": True}
    views = {
        f"cam{number}": {
            "type": "perspective",
            "fov": 40,
            "to_world": to_world().look_at([side, 2, 2.5], [0, 0.2, 0], [0, 1, 0]),
            "film": film,
        }
        for number, side in enumerate((-1.0, 1.5))
    }
    return {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 3},
        **views,
        "floor": {
            "type": "rectangle",
            "to_world": to_world().rotate([1, 0, 0], -90).scale(1.5),
            "bsdf": {"type": "diffuse", "reflectance": picture},
        },
        "block": {
            "type": "cube",
            "to_world": to_world().translate([0, 0.3, 0]) @ to_world(shear) @ to_world().scale([0.5, 0.3, 0.25]),
            "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.7, 0.3, 0.15]}},
        },
        "lamp": {"type": "point", "position": [1.0, 2, 1], "intensity": {"type": "rgb", "value": 6.0}},
        "sky": {"type": "constant", "radiance": {"type": "rgb", "value": 0.3}},
    }


def turned(initial: float) -> ur.Problem:
    scene = mi.load_dict(room())
    views = [ur.View(np.array(mi.render(scene, sensor=sensor, spp=256)), sensor=sensor) for sensor in (0, 1)]
    unknowns = [ur.Parameter(TURN, initial=initial), ur.Parameter("floor.bsdf.reflectance.data", initial=0.5)]
    return ur.Problem(room(), unknowns, views, max_depth=3)


@pytest.mark.slow
def test_a_run_goes_on_with_other_turns(tmp_path: Path) -> None:
    made = turned(1.9)
    plan = method("auto").plan(made)
    assert plan.other_starts == (TURN,)
    result = ur.optimize(made, plan, steps=50, run_directory=tmp_path / "whole", checkpoint_every=10)
    assert np.sin(result.last[TURN]) == pytest.approx(0.0, abs=0.03), "the block is symmetric under half a turn"
    line = f"begins again after step 20 with other turns of {TURN}"
    assert any(line in told for told in result.adapted)
    resumed = ur.resume(tmp_path / "whole", made, steps=51)
    assert any(line in told for told in resumed.adapted)


@pytest.mark.parametrize(("angle", "best"), [(np.pi / 2, 0.0), (-np.pi / 2 + 0.05, 0.05), (0.0, None), (np.pi, None)])
def test_the_best_turn_is_that_nearest_to_the_initial_one(angle: float, best: float | None) -> None:
    made = turned(0.3)
    values = made.initial() | {TURN: np.float32(angle)}
    place = better_turn(made, FreshPictures(made, 0, 1 << 16), {k: np.asarray(x) for k, x in values.items()}, (TURN,))
    if best is None:
        assert place is None
    else:
        assert place is not None
        assert place.values[TURN] == pytest.approx(best, abs=1e-5)
        assert 0 < place.share < 1


@pytest.mark.slow
def test_a_shape_that_arrives_is_not_turned() -> None:
    result = ur.optimize(turned(0.3), steps=50)
    assert result.last[TURN] == pytest.approx(0.0, abs=0.03)
    assert not any("begins again" in line for line in result.adapted)


def test_a_block_that_has_not_moved_is_named() -> None:
    result = ur.optimize(turned(0.3), steps=3)
    assert result.parameters[TURN] == np.float32(0.3)
    told = f"{TURN}: still at the initial values after 3 steps, since the first 8 are steps of the others"
    assert any(line.startswith(told) for line in result.warnings)


def test_turns_are_compositions_of_rotations() -> None:
    vector = np.array([0.3, -1.1, 0.5])
    quarters = [Rotation.from_rotvec(angle * axis) for axis in np.eye(3) for angle in np.pi / 2 * np.array([1, 2, 3])]
    for turn, quarter in zip(turns(vector), quarters, strict=True):
        expected = (quarter * Rotation.from_rotvec(vector)).as_matrix()
        np.testing.assert_allclose(Rotation.from_rotvec(turn).as_matrix(), expected, atol=1e-6)
    angles = np.array(turns(np.array(0.5)))
    np.testing.assert_allclose(np.exp(1j * (angles - 0.5)), np.exp(0.25j * np.pi * np.arange(1, 8)), atol=1e-6)


def spot() -> dict[str, Any]:
    to_world = mi.ScalarTransform4f().look_at([0.6, 2, 0.9], [0.2, 0, 0.1], [0, 1, 0])
    return {"type": "spot", "to_world": to_world, "cutoff_angle": 30, "intensity": {"type": "rgb", "value": 12.0}}


FORWARD = {"lamp": np.array([-0.4, -2.0, -0.8]) / 2.191, "cam0": np.array([1.0, -1.8, -2.5]) / 3.239}
"""Directions in which the spotlight and the first camera look."""


@pytest.mark.parametrize(
    ("key", "start", "loss", "textured"),
    [
        (TURN, np.pi, ur.losses.L1(), False),
        slow(TURN, np.pi, ur.losses.L1(), True),
        slow("cam0.rotation", 3.0 * FORWARD["cam0"], ur.losses.L2(), False),
        slow("cam0.rotation", 1.6 * FORWARD["cam0"], ur.losses.L2(), True),
        slow("lamp.rotation", np.array([1.2, 0.0, 0.0]), ur.losses.L2(), True),
    ],
)
def test_wrong_turns_are_left(key: str, start: Any, loss: ur.losses.Loss, textured: bool) -> None:
    """Losses other than L2, poses alone, cameras and lights ended at wrong turns: textures had adapted to them."""
    description = room(lean=0.6) | ({"lamp": spot()} if key.startswith("lamp") else {})
    views = [ur.View(np.array(mi.render(mi.load_dict(description), sensor=at, spp=256)), sensor=at) for at in (0, 1)]
    unknowns = [ur.Parameter(key, initial=np.ravel(start) if np.ndim(start) else start)]
    unknowns += [ur.Parameter("floor.bsdf.reflectance.data", initial=0.5)] * textured
    result = ur.optimize(ur.Problem(description, unknowns, views, loss, max_depth=3), steps=50)
    assert any("other turns" in line for line in result.adapted)
    value = result.parameters[key]
    if key.startswith("lamp"):  # its turns about its own axis are equal
        value = Rotation.from_rotvec(value).apply(FORWARD["lamp"]) - FORWARD["lamp"]
    np.testing.assert_allclose(value, 0.0, atol=0.07)


def few_numbers(bounds: tuple[float, float] | None = None) -> ur.Problem:
    others = [
        ur.Parameter("block.translation.x", initial=0.1, bounds=(-0.2, 0.2)),
        ur.Parameter("lamp.intensity.value", initial=[4.0] * 3),
    ]
    return ur.Problem(room(), [ur.Parameter(TURN, initial=1.9, bounds=bounds), *others], turned(1.9).views, max_depth=3)


def test_translations_beside_rotations_are_not_turned(monkeypatch: pytest.MonkeyPatch) -> None:
    """They were taken for angles, beyond their bounds, where a block of poses and all other unknowns were few numbers."""
    made, compared = few_numbers(), []
    plan = method("auto").plan(made)
    assert plan.other_starts == (TURN, "block.translation.x")
    monkeypatch.setattr(refinement, "better_turn", lambda problem, pictures, values, keys, *_: compared.append(keys))
    ur.optimize(made, plan, steps=17)
    assert set(compared) == {(TURN,)}


def test_a_block_that_begins_at_other_values_does_not_wait_again() -> None:
    """It waited for another 20 steps, so a run of 30 ended where it began again."""
    result = ur.optimize(few_numbers((-3.3, 3.3)), steps=24, seed=1)
    assert any("begins again after step 16 with other values" in line for line in result.adapted)
    assert np.sin(result.last[TURN]) == pytest.approx(0.0, abs=0.05)
