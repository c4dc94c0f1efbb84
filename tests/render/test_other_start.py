"""Runs of few numbers leave a second minimum for better values, and a descent that arrives is not disturbed."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest

import unrender as ur
from tiers import slow
from unrender.core.errors import InputError
from unrender.methods import method
from unrender.methods.plan import Plan

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
