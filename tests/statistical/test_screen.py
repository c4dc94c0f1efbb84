"""The texture of a screen, over two decades of radiance, that is seen in a rough mirror and by the light that it casts."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np
import pytest

import unrender as ur

KEY, DEPTH = "screen.emitter.radiance.data", 4
TRUTH = np.full((8, 8, 3), 1.0, np.float32)
TRUTH[:4, :4] = 8.0
TRUTH[4:, 4:] = 0.1


def room(texels: np.ndarray) -> dict[str, Any]:
    """A screen behind the camera, a mirror in front of it, a grey floor."""
    to = mi.ScalarTransform4f
    grey = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.6}}
    radiance = {"type": "bitmap", "bitmap": mi.Bitmap(texels), "raw": True}
    return {
        "type": "scene",
        "camera": {
            "type": "perspective",
            "fov": 60,
            "to_world": to().look_at([0, 0.3, 1.2], [0, 0, -1], [0, 1, 0]),
            "film": {"type": "hdrfilm", "width": 16, "height": 16, "rfilter": {"type": "box"}},
        },
        "mirror": {
            "type": "rectangle",
            "to_world": to().translate([0, 0, -1]),
            "bsdf": {"type": "roughconductor", "alpha": 0.05},
        },
        "floor": {
            "type": "rectangle",
            "to_world": to().translate([0, -1, 0]).rotate([1, 0, 0], -90).scale([1, 1.5, 1]),
            "bsdf": grey,
        },
        "screen": {
            "type": "rectangle",
            "to_world": to().translate([0, 0, 1.4]).rotate([0, 1, 0], 180).scale(0.9),
            "emitter": {"type": "area", "radiance": radiance},
        },
    }


@pytest.mark.slow
@pytest.mark.parametrize("loss", [ur.losses.L2(), ur.losses.L1()], ids=["L2", "L1"])
def test_dark_and_bright_texels_of_a_screen_come_back(loss: Any) -> None:
    path = mi.load_dict({"type": "path", "max_depth": DEPTH})
    reference = np.array(mi.render(mi.load_dict(room(TRUTH)), spp=4096, integrator=path))
    problem = ur.Problem(
        lambda: room(np.full_like(TRUTH, 2.0)),
        [ur.Parameter(KEY, initial=2.0)],
        [ur.View(reference)],
        loss=loss,
        max_depth=DEPTH,
        truth={KEY: TRUTH},
    )
    ratios: list[np.ndarray] = []

    class Watch(ur.protocols.Callback):
        def on_step(self, run: Any, record: dict[str, Any]) -> None:
            ratios.append(np.log(np.array(run.parameters[KEY]).reshape(TRUTH.shape) / TRUTH))

    ur.optimize(problem, "auto", steps=200, callbacks=[Watch()])
    errors = [float(np.sqrt(np.mean(x**2))) for x in ratios]
    start = float(np.sqrt(np.mean(np.log(2.0 / TRUTH) ** 2)))
    assert errors[-1] < 0.4 * start
    assert errors[-1] < 1.1 * min(errors), "dark texels do not wander away"
    medians = {float(level): float(np.median(ratios[-1][level == TRUTH])) for level in np.unique(TRUTH)}
    assert abs(medians[8.0]) < 0.15
    assert abs(medians[1.0]) < 0.5
    assert 0.0 < medians[float(np.float32(0.1))] < 0.8, "the start is a factor of 20 away, 3.0"
