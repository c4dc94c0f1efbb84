"""Draw the picture of the README: what one step of each loop sees, and the texture that it recovers from equally many paths.

`python scripts/readme_picture.py` writes `docs/images/demo.png`. The budget is in paths, so the picture does not depend on the machine's
load. It takes about a minute on two cores.
"""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from PIL import Image

import unrender as ur

ROOT = Path(__file__).resolve().parents[1]
KEY = "back.bsdf.reflectance.data"
PATHS = 4_000_000
LOOPS: dict[str, dict[str, Any]] = {"stock": {"spp": 16, "learning_rate": 0.05}, "auto": {}}
"""Settings of each loop. Errors of the tutorial loop at this budget: 0.103 with these, 0.148 with 8 samples, 0.46 with 4, 0.41 with 4 and
the rate 0.02, 0.75 with 1."""
TITLES = {"stock": "tutorial loop", "auto": "unrender, auto"}


class Recorder(ur.protocols.Callback):
    """Ends a run after `PATHS` paths, and keeps the last image and the error by the number of paths."""

    def __init__(self) -> None:
        self.image, self.curve = np.empty(0), [(0, 0.0)]

    def on_step(self, run: Any, record: dict[str, Any]) -> None:
        """Keep a step."""
        self.image = np.asarray(run.estimate.info["images"][0])
        error = run.problem.parameter_error(run.parameters)[KEY]
        self.curve.append((record["samples"], error))
        if self.curve[-1][0] >= PATHS:
            run.stop()


def main() -> None:
    """Run both loops and write the picture."""
    ur.use()
    problem = ur.gallery.problem("indirect-room", resolution=96, texture_resolution=64, reference_spp=1024)
    figure = plt.figure(figsize=(11, 4.1), layout="constrained")
    axes = figure.subplot_mosaic([["reference", "stock", "auto", "curve"], ["truth", "stock texture", "auto texture", "curve"]],
                                 width_ratios=[1, 1, 1, 1.3])  # fmt: skip
    _show(axes["reference"], problem.original_views[0].reference, "reference")
    _show(axes["truth"], problem.truth[KEY], "true texture")
    for name, settings in LOOPS.items():
        recorder = Recorder()
        result = ur.optimize(
            problem, ur.methods.method(name).plan(problem, settings), steps=10**6, callbacks=[recorder]
        )
        steps, error = len(recorder.curve) - 1, recorder.curve[-1][1]
        _show(axes[name], recorder.image, f"{TITLES[name]}: image of a step")
        _show(axes[f"{name} texture"], result.last[KEY], f"texture after {steps} steps, error {error:.3f}")
        start = problem.parameter_error(result.initial)[KEY]
        paths, errors = zip(*[(0, start), *recorder.curve[1:]], strict=True)
        axes["curve"].plot(np.array(paths) / 1e6, errors, label=TITLES[name])
    axes["curve"].set(yscale="log", xlabel="million paths", title="error of the texture (RMSE)")
    axes["curve"].grid(visible=True, which="both", alpha=0.3)
    axes["curve"].legend()
    drawn = io.BytesIO()
    figure.savefig(drawn, dpi=120)
    Image.open(drawn).convert("RGB").quantize(256, dither=Image.Dither.NONE).save(
        ROOT / "docs" / "images" / "demo.png", optimize=True
    )


def _show(axes: Any, linear: Any, title: str) -> None:
    """Show a linear image in sRGB."""
    values = np.clip(np.asarray(linear, np.float64).reshape(*np.shape(linear)[:2], 3), 0, 1)
    axes.imshow(
        np.where(values <= 0.0031308, 12.92 * values, 1.055 * values ** (1 / 2.4) - 0.055), interpolation="nearest"
    )
    axes.set_title(title, fontsize=9)
    axes.axis("off")


if __name__ == "__main__":
    main()
