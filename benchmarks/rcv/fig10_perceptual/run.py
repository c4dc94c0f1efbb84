"""The bias of a perceptual loss's derivative from noisy images (RCV Fig. 10).

The loss is `unrender.losses.Perceptual` on relu1_2 and relu2_2; its weights are trained first, in a minute, on pictures that come with
scikit-image (`train.py`): features of VGG's shape, not those of ImageNet. The scene is `indirect-room`, a photograph on the
back wall of a closed room.

Compared is the derivative by each pixel at a step of a descent, from a plain render, from one whose bias 32 more renders tell (Eq.
14), and from a control variate that took the same steps; mean over runs less the derivative at a converged image.

Descents on the same loss are of the textured back wall of a Cornell box, which a lamp at the ceiling lights directly, as in the paper's
figure: the image at 4 and 32 samples per pixel without a control variate and at 4 with one, the adjoint at 4; Adam with a
falling rate, tuned per method, at equal steps. Error is the texture's RMSE relative to where it began.
"""

from __future__ import annotations

import functools
import importlib
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import unrender as ur
from benchmarks import figures, markdown
from benchmarks.derivative_bias import METHODS, derivatives
from benchmarks.internals import IndirectRoom, arrays, build_problem, parts
from benchmarks.paths import converged, descent, truth
from benchmarks.races import Entrant, race
from benchmarks.rcv.fig10_perceptual.train import LAYERS, train
from benchmarks.runner.records import Record
from unrender.losses import Loss
from unrender.schedules import Cosine

QUICK = {
    "resolution": 8, "runs": 3, "step": 2, "renders": 2, "reference_spp": 64, "train_steps": 2, "steps": 2, "seeds": 1,
}  # fmt: skip
WALL = "back.bsdf.reflectance.data"
ADJOINT_SPP = 4
RATES = (0.03, 0.06, 0.12)
FLOOR = 0.02
"""Of the falling rate, at the end."""


@dataclass(frozen=True)
class CornellBox(IndirectRoom):
    """The specification of the problem: `indirect-room` with a square lamp at its ceiling in place of the one that lights that alone."""

    def scene(self) -> dict[str, Any]:
        """A new one at each call."""
        room = {name: piece for name, piece in super().scene().items() if not name.startswith("lamp")}
        lamp = parts.rectangle((0, 0.995, 0), (0.35, 0, 0), (0, 0, 0.35), parts.diffuse(0.0))
        return room | {"lamp": lamp | {"emitter": parts.light(9.0, 8.0, 6.5)}}


def entrants(steps: int) -> list[Entrant]:
    """Adjoint paths are as many for all."""
    adam = functools.partial(ur.optimizers.Adam, schedule=Cosine(steps, FLOOR))
    estimators = {
        "plain, 4": ur.PathGradient(spp=4, adjoint_spp=ADJOINT_SPP),
        "plain, 32": ur.PathGradient(spp=32, adjoint_spp=ADJOINT_SPP),
        "rcv, 4": ur.PathGradient(ur.images.RecursiveControlVariate(), spp=4, adjoint_spp=ADJOINT_SPP),
    }
    return [Entrant(name, name.split(",")[0], made, adam, RATES) for name, made in estimators.items()]


def descents(loss: Loss, resolution: int, reference_spp: int, steps: int, seeds: int) -> tuple[dict[str, Any], Any]:
    """Every method, tuned, at equal steps.

    Returns:
        {method: see `race`}, and {"wall/reference", "wall/plain, 4", ...: (N, N, 3)}, textures at the end of the first seed's runs.
    """
    made = CornellBox(resolution, resolution, reference_spp, loss=loss)
    problem = build_problem("cornell-box", made)
    assert problem.truth is not None
    walls: dict[str, Any] = {"wall/reference": problem.truth[WALL]}

    def ended(name: str, seed: int, result: ur.Result) -> None:
        if seed == 0:
            walls[f"wall/{name}"] = result.parameters[WALL]

    found = race(problem, entrants(steps), seeds, ended=ended, points=30, steps=steps)
    return found, {name: np.asarray(arrays.numpy(wall)) for name, wall in walls.items()}


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
