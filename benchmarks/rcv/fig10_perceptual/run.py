"""A perceptual loss from noisy images (RCV Fig. 10): the bias of its derivative, and what descents on it recover.

The loss is `unrender.losses.Perceptual` on relu1_2 and relu2_2; its weights are trained first, in a minute, on pictures that come with
scikit-image (`train.py`): features of VGG's shape, not those of ImageNet. The scene is `indirect-room`, a photograph on the
back wall of a closed room.

Bias: the derivative by each pixel at a step of a descent, from a plain render, from one whose bias 32 more renders tell (Eq.
14), and from a control variate that took the same steps; mean over runs less the derivative at a converged image.

Descents: Adam at equal steps, the learning rate tuned per method on a seed of its own by the distance of features, between converged images
and relative to the start. The error of the texture is beside it.
"""

from __future__ import annotations

import importlib
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

import unrender as ur
from benchmarks.derivative_bias import derivatives
from benchmarks.internals import Tree
from benchmarks.measured_races import Measure, compete, scaled
from benchmarks.paths import converged, descent
from benchmarks.races import Entrant, total_error
from benchmarks.rcv.fig10_perceptual.train import LAYERS, train
from unrender.losses import Loss

RATES = (0.02, 0.05)
QUICK = {
    "resolution": 8,
    "runs": 3,
    "step": 2,
    "renders": 2,
    "reference_spp": 64,
    "steps": 2,
    "seeds": 2,
    "train_steps": 2,
}


def entrants() -> list[Entrant]:
    """Who races; each has an adjoint on paths of its own, so that the network sees one image a step."""
    adam, cv = scaled(ur.optimizers.Adam), ur.images.RecursiveControlVariate
    plain = [Entrant(f"plain, {n} spp", "plain", ur.PathGradient(spp=n, adjoint_spp=4), adam, RATES) for n in (4, 32)]
    return [*plain, Entrant("rcv, 4 spp", "rcv", ur.PathGradient(cv(), spp=4, adjoint_spp=4), adam, RATES)]


def measure(problem: ur.Problem, loss: Loss, target: np.ndarray, spp: int) -> Measure:
    """Relative to the start: "features", the loss of a converged image, and "texture"."""

    def distance(parameters: Tree) -> float:
        return float(loss.value(converged(problem, parameters, spp).mean, target).mean())

    start, texture = distance(problem.initial()), problem.parameter_error(problem.initial())

    def relative(parameters: Tree) -> dict[str, float]:
        errors = problem.parameter_error(parameters)
        return {"features": distance(parameters) / start, "texture": total_error(errors, texture)}

    return relative


def run(
    resolution: int = 32,
    spp: int = 4,
    step: int = 20,
    runs: int = 12,
    renders: int = 32,
    reference_spp: int = 8192,
    steps: int = 60,
    seeds: int = 2,
    train_steps: int = 1000,
) -> Iterator[dict[str, Any]]:
    """The network, the bias, then the descents.

    Args:
        spp: of the bias
        step: of the bias
        renders: that tell the bias of Eq. 14
        steps: of every descent
        train_steps: of the network
    """
    importlib.import_module("torch").set_num_threads(1)  # on pictures this small several only wait for each other
    with tempfile.TemporaryDirectory() as folder:
        weights = Path(folder) / "weights.pth"
        network = train(weights, train_steps)
        print(f"accuracy {network['accuracy']:.2f}", flush=True)
        loss = ur.losses.Perceptual(weights, LAYERS)
        problem = ur.gallery.problem(
            "indirect-room", resolution=resolution, texture_resolution=resolution, reference_spp=2048
        )
        problem = ur.Problem(
            problem.renderer, problem.parameters, problem.given_views, loss, problem.max_depth, truth=problem.truth,
            name="indirect-room",
        )  # fmt: skip
        there = {key: problem.renderer.array(value) for key, value in problem.truth.items()}
        target = converged(problem, there, reference_spp).mean
        path = descent(problem, ur.PathGradient(spp=16, adjoint_spp=16), 0.02, step + 1)
        bias, maps = derivatives(problem, path, {"perceptual": loss}, target, spp, runs, renders, reference_spp)
        found: dict[str, Any] = {"network": network, "bias": bias, "maps": maps}
        yield found
        judge = measure(problem, loss, target, min(256, reference_spp))
        yield {**found, "methods": compete(problem, entrants(), judge, "features", seeds, steps=steps)}
