"""Standard errors of numbers that are means over the last steps of a rendered problem."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np
import pytest

import unrender as ur
from unrender.optimizers import Adam

SEEDS, STEPS, SIZE = 40, 160, 8
KEY, TRUTH = "wall.bsdf.reflectance.value", [0.6, 0.5, 0.4]


def problem() -> ur.Problem:
    """Return a wall of unknown colour under a sky and a lamp, with an almost exact reference."""
    film = {"type": "hdrfilm", "width": SIZE, "height": SIZE, "rfilter": {"type": "box"}}
    to_world = mi.ScalarTransform4f().look_at([0, 0, 4], [0, 0, 0], [0, 1, 0])
    scene: dict[str, Any] = {
        "type": "scene",
        "cam": {"type": "perspective", "fov": 40, "to_world": to_world, "film": film},
        "wall": {
            "type": "rectangle",
            "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.6, 0.5, 0.4]}},
        },
        "lamp": {"type": "point", "position": [0.5, 0.5, 1], "intensity": {"type": "rgb", "value": [6.0, 6.0, 6.0]}},
        "sky": {"type": "constant", "radiance": {"type": "rgb", "value": [3.0, 3.0, 3.0]}},
    }
    integrator = mi.load_dict({"type": "path", "max_depth": 2})
    reference = np.array(mi.render(mi.load_dict(scene), integrator=integrator, spp=1 << 15))
    return ur.Problem(scene, [ur.Parameter(KEY, initial=0.4)], [ur.View(reference)], max_depth=2, truth={KEY: TRUTH})


@pytest.mark.slow
def test_standard_errors_of_means_cover_the_truth(monkeypatch: pytest.MonkeyPatch) -> None:
    """68 % of the true values are within one standard error, with a deviation of 7 % if the three channels of a run go together.

    Only runs with a run folder report these errors, after a test.
    """
    monkeypatch.setattr("unrender.runs.optimize._with_reasons", lambda run, result: result)
    made, inside, mean, last = problem(), [], [], []
    for seed in range(SEEDS):
        result = ur.optimize(made, ur.PathGradient(spp=2), Adam(0.02), steps=STEPS, seed=seed, progress=False)
        misses = result.parameters[KEY] - np.array(TRUTH, np.float32)
        mean.append(np.mean(misses**2))
        last.append(np.mean(np.square(result.last[KEY] - np.array(TRUTH, np.float32))))
        if KEY in result.standard_error:
            inside += list(np.abs(misses) < result.standard_error[KEY])
    assert len(inside) > 2 * SEEDS
    assert np.mean(inside) == pytest.approx(0.68, abs=0.2)
    assert np.mean(mean) < 0.5 * np.mean(last)
