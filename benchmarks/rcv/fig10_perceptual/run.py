"""The bias of a perceptual loss's derivative from noisy images (RCV Fig. 10).

The loss is `unrender.losses.Perceptual` on relu1_2 and relu2_2; its weights are trained first, in a minute, on pictures that come with
scikit-image (`train.py`): features of VGG's shape, not those of ImageNet. The scene is `indirect-room`, a photograph on the
back wall of a closed room.

Compared is the derivative by each pixel at a step of a descent, from a plain render, from one whose bias 32 more renders tell (Eq.
14), and from a control variate that took the same steps; mean over runs less the derivative at a converged image.

Descents on the same loss are of the textured back wall of a Cornell box, which a lamp at the ceiling lights directly, as in the paper's
figure (`descents.py`): the image at 4 and 32 samples per pixel without a control variate and at 4 with one, the adjoint at 4; Adam with a
falling rate, tuned per method, at equal steps. Error is the texture's RMSE relative to where it began.
"""

from __future__ import annotations

import importlib
import tempfile
from pathlib import Path
from typing import Any

import unrender as ur
from benchmarks import figures, markdown
from benchmarks.derivative_bias import METHODS, derivatives
from benchmarks.paths import converged, descent, truth
from benchmarks.rcv.fig10_perceptual.descents import descents
from benchmarks.rcv.fig10_perceptual.train import LAYERS, train
from benchmarks.runner.records import Record

QUICK = {
    "resolution": 8, "runs": 3, "step": 2, "renders": 2, "reference_spp": 64, "train_steps": 2, "steps": 2, "seeds": 1,
}  # fmt: skip


def run(
    resolution: int = 32,
    spp: int = 4,
    step: int = 20,
    runs: int = 12,
    renders: int = 32,
    reference_spp: int = 8192,
    train_steps: int = 1000,
    steps: int = 600,
    seeds: int = 3,
) -> dict[str, Any]:
    """The network, the bias, the descents.

    Args:
        renders: that tell the bias of Eq. 14
        train_steps: of the network
    """
    importlib.import_module("torch").set_num_threads(1)  # on pictures this small several only wait for each other
    with tempfile.TemporaryDirectory() as folder:
        weights = Path(folder) / "weights.pth"
        network = train(weights, train_steps)
        print(f"accuracy {network['accuracy']:.2f}", flush=True)
        loss = ur.losses.Perceptual(weights, LAYERS)
        made = ur.gallery.problem(
            "indirect-room", resolution=resolution, texture_resolution=resolution, reference_spp=2048
        )
        problem = made.replaced(loss=loss)
        target = converged(problem, truth(problem), reference_spp).mean
        path = descent(problem, ur.PathGradient(spp=16, adjoint_spp=16), 0.02, step + 1)
        bias, maps = derivatives(problem, path, {"perceptual": loss}, target, spp, runs, renders, reference_spp)
        found, walls = descents(loss, resolution, reference_spp // 2, steps, seeds)
    return {"network": network, "bias": bias, "tasks": {"cornell-box": {"methods": found}}, "maps": maps | walls}


def table(record: Record) -> str:
    """The bias of each image."""
    text = "{resolution}², {spp} spp, {runs} runs, step {step}; relative to the derivative's mean. The network tells {accuracy:.0%} of new "
    text += "crops, by chance {chance:.0%}."
    row = "{name} | {rms:.2f} ({square:.3f} ± {square_error:.3f}) | {signed:+.1%} ± {signed_error:.1%} | {variance:.2f}"
    losses = record["bias"]["losses"]["perceptual"]
    ends = [
        [markdown.fill("{name} spp | {rate:g} | {final!m}", entry), f"{entry['runs'][0][-1][1] / 1e6:.1f}"]
        for entry in markdown.named(record["tasks"]["cornell-box"]["methods"], "name")
    ]
    return markdown.blocks(
        markdown.fill(text, record["settings"], record["network"]),
        markdown.records(
            "image | bias, RMS over pixels (its square) | mean bias | variance",
            row,
            markdown.named({method: losses[method] for method in METHODS}, "name"),
        ),
        "Descents of {steps} steps, {seeds} seeds:".format(**record["settings"]),
        markdown.table("image | rate | final error of the wall (range) | million paths", ends),
    )


def plot(record: Record) -> figures.Figure:
    """The walls that descents find, and the bias of the derivative."""
    maps, ends = record["maps"], record["tasks"]["cornell-box"]["methods"]
    walls = {f"{name} spp: {entry['final'][0]:.2f}": maps[f"wall/{name}"] for name, entry in ends.items()}
    bias = {f"bias, {method}": maps[f"perceptual/{method}/bias"] for method in METHODS}
    return figures.pictures([{"reference": maps["wall/reference"], **walls}, bias], signed=True)
