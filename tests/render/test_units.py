"""Scenes in other units of length: default widths of poses follow the size of what moves, as the cameras see it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest

import unrender as ur
from unrender.methods import method

SIZE = 16


def scene(unit: float, extent: float = 6.0) -> dict[str, Any]:
    """Return a block, a light and two cameras over a floor of a given extent, in these units."""
    to = mi.ScalarTransform4f()

    def camera(origin: list[float], kind: str = "perspective") -> dict[str, Any]:
        film = {"type": "hdrfilm", "width": SIZE, "height": SIZE, "rfilter": {"type": "box"}}
        place = to.look_at([unit * x for x in origin], [0, 0, 0], [0, 1, 0])
        return {"type": kind, "to_world": place, "film": film, "near_clip": 1e-3 * unit, "far_clip": 1e4 * unit}

    return {
        "type": "scene",
        "cam": camera([1, 2, 4]),
        "side": camera([-3, 2, 3]),
        "floor": {"type": "rectangle", "to_world": to.translate([0, -0.4 * unit, 0]).rotate([1, 0, 0], -90).scale(extent * unit)},
        "block": {
            "type": "cube",
            "to_world": to.scale([0.4 * unit, 0.3 * unit, 0.3 * unit]),
            "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.7, 0.2, 0.1]}},
        },
        "lamp": {"type": "point", "position": [unit, 2 * unit, unit], "intensity": {"type": "rgb", "value": 10 * unit**2}},
        "sky": {"type": "constant", "radiance": {"type": "rgb", "value": 0.3}},
    }  # fmt: skip


def problem(unit: float, parameters: list[ur.Parameter], **options: Any) -> ur.Problem:
    blank = [ur.View(np.zeros((SIZE, SIZE, 3), np.float32), sensor=index) for index in range(2)]
    made = ur.Problem(scene(unit, **options), parameters, blank, max_depth=2)
    truth = {key: np.asarray(made.renderer.values([key])[key]) for key in made.shapes()}
    views = [ur.View(ur.render(made, truth, index, spp=256), sensor=index) for index in range(2)]
    return ur.Problem(scene(unit, **options), parameters, views, max_depth=2, truth=truth)


def test_degrees_in_place_of_radians_are_told(tmp_path: Path) -> None:
    def notices(parameter: ur.Parameter, **known: Any) -> list[str]:
        blank = ur.View(np.zeros((SIZE, SIZE, 3), np.float32), known=known.get("known"))
        return ur.Problem(scene(1.0), [parameter], [blank], max_depth=2).notices

    told = "45 radians is more than a full turn; if it is in degrees, give 0.7854"
    assert notices(ur.Parameter("block.rotation.y", 45.0)) == [f"parameter block.rotation.y: {told}"]
    assert notices(ur.Parameter("cam.rotation", 0.0, bounds=(-45, 45))) == [f"parameter cam.rotation: {told}"]
    turned = notices(ur.Parameter("lamp.intensity.value"), known={"block.rotation": [0.0, -45.0, 0.0]})
    assert turned == [f"view 0: block.rotation: {told}"]
    file = tmp_path / "rotation.npy"
    for name in (file, str(file)):
        for degrees, lines in ((0.5, []), (-45.0, turned)):
            np.save(file, np.array([0.0, degrees, 0.0]))
            assert notices(ur.Parameter("lamp.intensity.value"), known={"block.rotation": name}) == lines
    assert notices(ur.Parameter("block.rotation.y", 0.5, bounds=(-6.2831853, np.inf))) == []
    assert notices(ur.Parameter("block.translation.y", 45.0)) == []


@pytest.mark.parametrize("unit", [1e-3, 1.0, 1e3])
def test_default_widths_are_in_units_of_what_moves(unit: float) -> None:
    renderer = ur.Problem(
        scene(unit), [ur.Parameter("block.translation")], [ur.View(np.zeros((SIZE, SIZE, 3), np.float32))]
    ).renderer
    known = renderer.parameters()
    for key in ("block.translation", "block.translation.x", "cam.translation", "lamp.translation"):
        assert known[key].length == pytest.approx(unit), key
    for key in ("block.rotation", "block.scale", "cam.rotation.y"):
        assert known[key].length == 1.0
    wide = ur.Problem(
        scene(unit, extent=1e4), [ur.Parameter("floor.translation")], [ur.View(np.zeros((SIZE, SIZE, 3), np.float32))]
    )
    assert wide.renderer.parameters()["floor.translation"].length == pytest.approx(10 * unit)  # as far as it is seen


def test_a_given_width_is_absolute() -> None:
    blank = [ur.View(np.zeros((SIZE, SIZE, 3), np.float32))]
    made = ur.Problem(scene(1e3), [ur.Parameter("block.translation"), ur.Parameter("block.rotation.y")], blank)
    given: Any = method("smoothed").plan(made, {"sigma": 0.3}).estimator
    assert given.sigma == 0.3
    own: Any = method("smoothed").plan(made).estimator
    assert own.sigma == pytest.approx({"block.translation": 200.0, "block.rotation.y": 0.2})


@pytest.mark.slow
@pytest.mark.parametrize(("name", "least"), [("auto", 0.02), ("smoothed", 0.06), ("cma-es", 0.09)])
@pytest.mark.parametrize("unit", [1e-3, 1.0, 1e3])
def test_poses_are_recovered_in_any_unit(unit: float, name: str, least: float) -> None:
    """From 0.104 units away. With absolute widths, scenes in units of 1e-3 and 1e3 stay there."""
    start = [
        ur.Parameter("block.translation", initial=[0.15 * unit, 0.0, -0.1 * unit]),
        ur.Parameter("block.rotation.y", initial=0.3),
    ]
    made = problem(unit, start)
    settings = {"optimizer": "cma-es"} if name == "cma-es" else {}
    plan = method("smoothed" if name == "cma-es" else name).plan(made, settings)
    result = ur.optimize(plan.problem, plan, steps=40)
    errors = made.parameter_error(result.parameters)
    assert errors["block.translation"] < least * unit
    assert errors["block.rotation.y"] < 0.2
