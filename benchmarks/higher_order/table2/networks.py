# pyright: reportMissingImports=false

"""CNN and CNN5 of Wang et al., Table 2: a network learns to tell the pose of a mug from its picture, without labels: its answer is
rendered and compared with the picture, and the derivative of that comparison is sampled.

    python benchmarks/higher_order/table2/networks.py [--task CNN] [--runs 3] [--seconds 20]

Needs PyTorch. CNN answers with the angle; CNN5, one network as well, with five numbers: the paper says rotation, position and colour,
which is read as the angle, the place across the picture, and the cup's red, green and blue. Methods: OurG, the aggregate gradient of the
black box through the network with Adam; OurHVPA, Newton-CG on products with the Hessian of the whole, network and black box; OurTogether,
the same with gradient and products from the same renders, plain and with its steps through Adam. FR22 is OurG with the product of
gradient kernels; for one output they are the same. CMA-ES on 268 000 weights has no chance and is left out, as is a Hessian.
Error: root mean square over the pictures of the answers, relative to the first, each number over its range. Seconds are the processor's.
"""

from __future__ import annotations

import argparse
import math
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import drjit as dr
import matplotlib.pyplot as plt
import mitsuba as mi
import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
from cnn import RESOLUTION, PoseNetwork, parameter_count
from common import mitsuba_renderer, write

import unrender as ur
from unrender.rendering.renderer import SampleRequest

HERE = Path(__file__).resolve().parent / "networks"
GOALS = (0.1, 0.01)
COLOUR = "mug.bsdf.brdf_0.reflectance.value"
ANSWERS: dict[str, dict[str, Any]] = {
    "CNN": {"mug.rotation.y": 0.9},
    "CNN5": {"mug.rotation.y": 0.6, "mug.translation.x": 0.3, COLOUR: (0.25, 0.25, 0.25)},
}
"""Each number's range to either side: of the truth, and what the network's outputs are multiples of."""
REST: dict[str, Any] = {COLOUR: (0.45, 0.45, 0.45)}
"""Their middles, where they are not 0."""
SIGMA = 0.25
"""In units of the ranges."""


class Data:
    """Pictures of mugs and the black box: the loss of poses, each against the picture that it belongs to.

    Args:
        task: which numbers are unknown.
        count: of pictures.
        size: of the rendered answers, pixels along a side.
        seed: of the poses.
    """

    def __init__(self, task: str, count: int, size: int, seed: int):
        self.keys = list(ANSWERS[task])
        self.widths = [np.size(ANSWERS[task][key]) for key in self.keys]
        self.ranges = np.concatenate([np.atleast_1d(ANSWERS[task][key]) for key in self.keys])
        self.rest = np.concatenate([np.atleast_1d(REST.get(key, 0.0)) for key in self.keys])
        self.truth = np.random.default_rng(seed).uniform(-1, 1, (count, len(self.ranges)))
        self.session = self._session(size)
        self.references = self._render(self.session, self.truth, 64, 1)
        pictures = self._render(self._session(RESOLUTION), self.truth, 64, 2)
        self.pictures = torch.tensor(pictures, dtype=torch.float32)
        self.evaluations = 0
        self.step = 0

    def _session(self, size: int) -> Any:
        renderer = mitsuba_renderer(ur.gallery.problem("mug", resolution=size, reference_spp=1))
        return renderer.prepare(self.keys, None, derivatives=False)

    def _render(self, session: Any, poses: np.ndarray, spp: int, seed: int) -> np.ndarray:
        values = self.rest + self.ranges * np.clip(poses, -2.5, 2.5)
        ends = np.cumsum(self.widths)
        parts = np.split(values, ends[:-1], axis=1)
        state = {
            key: np.clip(part, 0.0, 1.0) if key == COLOUR else part[:, 0]
            for key, part in zip(self.keys, parts, strict=True)
        }
        images: mi.TensorXf = session.image_batch(state, SampleRequest(0, spp, seed))
        dr.eval(images)
        return images.numpy()

    def losses(self, points: np.ndarray, items: np.ndarray) -> np.ndarray:
        """(B, n) and the pictures (B,) they belong to, to (B,): mean square of the difference, one sample per pixel."""
        self.evaluations += len(points)
        images = self._render(self.session, points, 1, 1000 + self.step)
        return ((images - self.references[items]) ** 2).mean(axis=(1, 2, 3)) * 100.0

    def error(self, network: Any) -> float:
        """Root mean square of the answers, in units of the ranges."""
        with torch.no_grad():
            found = network(self.pictures).double().numpy()
        return float(np.sqrt(np.mean((found - self.truth) ** 2)))


def train(task: str, method: str, rate: float, seconds: float, seed: int, samples: int = 8) -> dict[str, Any]:
    """One run: errors over time, relative to the first."""
    data = Data(task, 16, 32, 5)
    torch.manual_seed(seed)
    network = PoseNetwork(len(data.ranges))
    weights = list(network.parameters())
    adam = torch.optim.Adam(weights, lr=rate)
    curve, clock = [(0.0, data.error(network))], 0.0
    sigma = SIGMA

    joint = method.startswith("OurTogether")

    def loss() -> torch.Tensor:
        answers = network(data.pictures)
        options: dict[str, Any] = {"seed": data.step, "epsilon": 0.3, "joint": joint}
        return ur.grey_box.loss(data.losses, answers, sigma, samples, **options).mean()

    def gradient_step() -> None:
        adam.zero_grad()
        loss().backward()
        adam.step()

    steps: dict[str, Callable[[], Any]] = {
        "OurG": gradient_step,
        "OurHVPA": lambda: ur.grey_box.newton_cg_step(loss, weights, trust_radius=rate, iterations=2),
        "OurTogether": lambda: ur.grey_box.newton_cg_step(loss, weights, trust_radius=rate, iterations=4),
        "OurTogether, Adam": lambda: ur.grey_box.newton_cg_step(loss, weights, 1.0, iterations=4, optimizer=adam),
    }
    while clock < seconds:
        sigma = SIGMA * max(0.15, 1 - clock / seconds)
        began = time.process_time()
        steps[method]()
        clock += time.process_time() - began
        data.step += 1
        curve.append((clock, data.error(network)))
    first = curve[0][1]
    times, errors = np.array([t for t, _ in curve]), np.array([e for _, e in curve]) / first
    smooth = np.convolve(errors, np.ones(10) / 10, mode="valid")
    reached = [float(times[9:][np.argmax(smooth <= goal)]) if (smooth <= goal).any() else math.inf for goal in GOALS]
    keep = np.unique(np.round(np.geomspace(1, len(times), 100)).astype(int) - 1)
    return {
        "reached": reached,
        "final": float(smooth[-1]),
        "steps": data.step,
        "evaluations": data.evaluations,
        "curve": [times[keep].round(3).tolist(), errors[keep].round(5).tolist()],
    }


GRID = {
    "OurG": (3e-4, 1e-3, 3e-3),
    "OurHVPA": (0.03, 0.1),
    "OurTogether": (0.03, 0.1),
    "OurTogether, Adam": (3e-4, 1e-3, 3e-3),
}
"""Of each method: Adam's learning rates, or trust radii."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--task", action="append", choices=list(ANSWERS))
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("--seconds", type=float, default=40.0)
    asked = parser.parse_args()
    ur.use()
    torch.set_num_threads(1)
    tasks: dict[str, Any] = {}
    figure, axes = plt.subplots(1, len(asked.task or ANSWERS), figsize=(11, 4), squeeze=False, layout="constrained")
    for axis, task in zip(axes[0], asked.task or ANSWERS, strict=True):
        weights = parameter_count(PoseNetwork(sum(np.size(width) for width in ANSWERS[task].values())))
        tasks[task] = {"weights": weights, "methods": {}}
        for method, rates in GRID.items():
            tried = {rate: train(task, method, rate, asked.seconds / 4, 1000)["final"] for rate in rates}
            best = min(tried, key=lambda rate: tried[rate])
            runs = [train(task, method, best, asked.seconds, seed) for seed in range(asked.runs)]
            tasks[task]["methods"][method] = {"rate": best, "tried": tried, "runs": runs}
            finals = [round(run["final"], 3) for run in runs]
            print(task, method, best, finals, [run["reached"] for run in runs], flush=True)
            grid = np.linspace(0, asked.seconds, 200)
            axis.plot(grid, np.median([np.interp(grid, *run["curve"]) for run in runs], axis=0), label=method)
        axis.set(
            title=f"{task}: {weights} weights",
            xlabel="seconds",
            ylabel="error of the poses / at the start",
            yscale="log",
        )
        axis.legend()
        write(HERE, {"runs": asked.runs, "seconds": asked.seconds, "tasks": tasks})
    figure.savefig(HERE / "figure.png", dpi=110)


if __name__ == "__main__":
    main()
