"""Dealt runs of one driver, one after the other, with stand-ins or with workers that render.

    python -m benchmarks.workers.scale.driver ORDER.json > one JSON object a case

The order holds "steps", "views" and "cases", each with "side" of the texture, "workers", "compress", and "seconds" of a view, null for
workers that render.
"""

from __future__ import annotations

import json
import sys
from contextlib import ExitStack
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np

__all__ = ["main"]

_PIXELS = 32


def main() -> None:
    """Carry out one order."""
    import unrender as ur
    from unrender.backend import variant

    order: dict[str, Any] = json.loads(Path(sys.argv[1]).read_text())
    ur.use("llvm_ad_rgb")
    variant.use_threads(1)
    for case in order["cases"]:
        found = _measured(case, order["views"], order["steps"])
        print(json.dumps({**case, **found}), flush=True)


def _measured(case: dict[str, Any], views: int, steps: int) -> dict[str, float]:
    import unrender as ur
    from benchmarks.workers.scale.stand_in import stand_ins
    from unrender.dealing.gatherer import DealtViews

    rows: list[dict[str, float]] = []

    class Watch(ur.Callback):
        """Notes each step."""

        def __init__(self) -> None:
            self.clock = 0.0

        def on_step(self, run: Any, record: Any) -> None:
            gatherer = run.problem.gatherer
            assert isinstance(gatherer, DealtViews)
            traffic = gatherer.traffic
            row = {"seconds": run.clock - self.clock, "busy": traffic.busy, "waited": traffic.seconds}
            rows.append({**row, "sent": traffic.sent, "received": traffic.received})
            self.clock = run.clock

    with ExitStack() as stack:
        if case["seconds"] is not None:
            stack.enter_context(stand_ins(case["seconds"]))
        tell = lambda line: print(line, file=sys.stderr, flush=True)  # noqa: E731
        problem = _problem(case["side"], views)
        dealt = stack.enter_context(ur.deal(problem, case["workers"], case["compress"], threads=1, tell=tell))
        estimator, adam = ur.PathGradient(spp=16), ur.optimizers.Adam(learning_rate=1e-3)
        ur.optimize(dealt, estimator, adam, steps=steps, progress=False, callbacks=[Watch()])
    settled = rows[len(rows) // 2 :]
    return {name: median(row[name] for row in settled) for name in settled[0]}


def _problem(side: int, views: int) -> Any:
    """A wall with a texture, seen from so many places, all with the same picture of it."""
    import mitsuba as mi

    import unrender as ur

    origin = mi.ScalarTransform4f().look_at([0, 0, 2], [0, 0, 0], [0, 1, 0])
    film = {"type": "hdrfilm", "width": _PIXELS, "height": _PIXELS, "rfilter": {"type": "box"}}
    texture = {"type": "bitmap", "bitmap": mi.Bitmap(np.full((side, side, 3), 0.5, np.float32)), "raw": True}
    wall = {"type": "rectangle", "bsdf": {"type": "diffuse", "reflectance": texture}}
    scene = {"type": "scene", "wall": wall, "sky": {"type": "constant"}}
    scene["camera"] = {"type": "perspective", "fov": 45.0, "to_world": origin, "film": film}
    image = np.full((_PIXELS, _PIXELS, 3), 0.4, np.float32)
    return ur.Problem(scene, [ur.Parameter("wall.bsdf.reflectance.data", bounds=(0, 1))], [ur.View(image)] * views)


if __name__ == "__main__":
    main()
