"""Smoothed derivatives behind a network (HO Table 2, CNN and CNN5): learning poses from images without labels.

A network answers with the pose of a mug in an image; its answer is rendered and compared with the image, and the
derivative of that comparison is sampled. Needs PyTorch. CNN answers with the angle; CNN5, one network as well, with
five numbers: the paper says rotation, position and colour, which is read as the angle, the place across the image,
and the cup's red, green and blue. The network is given its images less their mean, over their standard deviation.
Methods: OurG, the aggregate gradient of the black box through the network with Adam; OurHVPA, Newton-CG on products
with the Hessian of the whole, network and black box; OurJoint, the same with gradient and products from the same
renders. Newton-CG is in Adam's metric: of weights over the fourth root of 1 / v, v the mean square of the gradient.
Rates, radii and σ fall over a run. FR22 is OurG with the product of gradient kernels; for one output they are the
same. CMA-ES on 268 000 weights has no chance and is left out, as is a Hessian. Error: root mean square over the
images of the answers, relative to the first, each number over its range. Seconds are the processor's.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from typing import Any

import numpy as np

import unrender as ur
from benchmarks import figures, markdown
from benchmarks.higher_order.networks.cnn import RESOLUTION, PoseNetwork, parameter_count, torch
from benchmarks.internals import SampleRequest, dr, prepare
from benchmarks.runner.records import Record

GOALS = (0.1, 0.01)
COLOUR = "mug.bsdf.brdf_0.reflectance.value"
ANSWERS: dict[str, dict[str, Any]] = {
    "CNN": {"mug.rotation.y": 0.7},
    "CNN5": {"mug.rotation.y": 0.6, "mug.translation.x": 0.3, COLOUR: (0.25, 0.25, 0.25)},
}
"""Each number's range to either side: of the truth, and what the network's outputs are multiples of."""
REST: dict[str, Any] = {"mug.rotation.y": -0.1, COLOUR: (0.45, 0.45, 0.45)}
"""Their middles, where they are not 0. Beyond 0.8 rad the cup hides its handle, and images do not tell the angle."""
SIGMA = {"CNN": 0.5, "CNN5": 0.25}
"""In units of the ranges, at first; it falls in proportion to the time left, to `LEAST_SIGMA` of this."""
LEAST_SIGMA = 0.08
LEAST_RATE = 0.01
"""Of rates and radii, at the end of a run."""
GRID = {"OurG": (1e-4, 3e-4, 1e-3), "OurHVPA": (1e-3, 3e-3), "OurJoint": (1e-3, 3e-3)}
"""Of each method: Adam's learning rates, or trust radii as the length of a step that moves each weight by so much."""
REFERENCES = 32
"""Renders of 64 samples per pixel that references are the mean of: their noise is a part of the loss's minimum, and moves answers."""
_DECAY = 0.99
"""Of the mean square of the gradient that makes the metric."""
_TINY = 1e-24
"""Added to the mean square."""
_FARTHEST = 30.0
"""The largest scale of a weight over their median."""
MERGE = ("tasks.*.methods",)
QUICK = {"task": ("CNN",), "runs": 1, "seconds": 0.3, "images": 2, "size": 8}


class Data:
    """Images of mugs and the black box: the loss of poses, each against the image that it belongs to.

    Args:
        task: which numbers are unknown.
        count: of images.
        size: of the rendered answers, pixels along a side.
        seed: of the poses.
    """

    def __init__(self, task: str, count: int, size: int, seed: int):
        self.task, self.keys = task, list(ANSWERS[task])
        self.widths = [np.size(ANSWERS[task][key]) for key in self.keys]
        self.ranges = np.concatenate([np.atleast_1d(ANSWERS[task][key]) for key in self.keys])
        self.rest = np.concatenate([np.atleast_1d(REST.get(key, 0.0)) for key in self.keys])
        self.truth = np.random.default_rng(seed).uniform(-1, 1, (count, len(self.ranges)))
        self.session = self._prepared(size)
        renders = [self._render(self.session, self.truth, 64, 10_000 + number) for number in range(REFERENCES)]
        self.references = np.mean(renders, axis=0)
        images = self._render(self._prepared(RESOLUTION), self.truth, 64, 2)
        images = images - images.mean(axis=0)
        images /= images.std()
        self.images = torch.tensor(images, dtype=torch.float32)
        self.evaluations = 0
        self.step = 0

    def _prepared(self, size: int) -> Any:
        problem = ur.gallery.problem("mug", resolution=size, reference_spp=1)
        return prepare(problem, self.keys, None, derivatives=False)

    def _render(self, session: Any, poses: np.ndarray, spp: int, seed: int) -> np.ndarray:
        values = self.rest + self.ranges * np.clip(poses, -2.5, 2.5)
        ends = np.cumsum(self.widths)
        parts = np.split(values, ends[:-1], axis=1)
        state = {
            key: np.clip(part, 0.0, 1.0) if key == COLOUR else part[:, 0]
            for key, part in zip(self.keys, parts, strict=True)
        }
        images = session.image_batch(state, SampleRequest(0, spp, seed))
        dr.eval(images)
        return images.numpy()

    def losses(self, points: np.ndarray, items: np.ndarray) -> np.ndarray:
        """(B, n) and the indices (B,) of the images they belong to, to (B,): mean square of the difference, one sample per pixel."""
        self.evaluations += len(points)
        images = self._render(self.session, points, 1, 1000 + self.step)
        return ((images - self.references[items]) ** 2).mean(axis=(1, 2, 3)) * 100.0

    def error(self, network: Any) -> float:
        """Root mean square of the answers, in units of the ranges."""
        with torch.no_grad():
            found = network(self.images).double().numpy()
        return float(np.sqrt(np.mean((found - self.truth) ** 2)))


def train(data: Data, method: str, rate: float, seconds: float, seed: int, samples: int = 8) -> dict[str, Any]:
    """One run: errors over time, relative to the first."""
    data.evaluations = data.step = 0
    torch.manual_seed(seed)
    network = PoseNetwork(len(data.ranges))
    weights = list(network.parameters())
    adam = torch.optim.Adam(weights, lr=rate)
    curve, clock = [(0.0, data.error(network))], 0.0

    joint = method == "OurJoint"
    squares = [torch.zeros_like(weight) for weight in weights]

    def loss() -> Any:
        answers = network(data.images)
        options: dict[str, Any] = {"seed": data.step, "epsilon": 0.3, "joint": joint}
        return ur.grey_box.loss(data.losses, answers, sigma, samples, **options).mean()

    def gradient_step() -> None:
        adam.zero_grad()
        loss().backward()
        adam.step()

    def metric_step() -> None:
        """Conjugate gradients in Adam's metric: weights over the fourth root of 1 / v, v the mean square of the gradient so far."""
        value = loss()
        for square, slope in zip(squares, torch.autograd.grad(value, weights, create_graph=True), strict=True):
            square.mul_(_DECAY).add_((1 - _DECAY) * slope.detach() ** 2)
        debias = 1 - _DECAY ** (data.step + 1)
        scales = [(square / debias + _TINY).pow(-0.25) for square in squares]
        bound = _FARTHEST * float(torch.cat([scale.ravel() for scale in scales]).median())
        scales = [scale.clamp(max=bound) for scale in scales]
        radius = factor * rate * math.sqrt(sum(float((1 / scale**2).sum()) for scale in scales))
        ur.grey_box.newton_cg_step(lambda: value, weights, radius, iterations=2, scales=scales)

    while clock < seconds:
        left = 1 - clock / seconds
        sigma, factor = SIGMA[data.task] * max(LEAST_SIGMA, left), max(LEAST_RATE, left)
        for group in adam.param_groups:
            group["lr"] = factor * rate
        began = time.process_time()
        gradient_step() if method == "OurG" else metric_step()
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


def run(
    task: tuple[str, ...] = tuple(ANSWERS), runs: int = 3, seconds: float = 120.0, images: int = 16, size: int = 32
) -> Iterator[dict[str, Any]]:
    """A part per task.

    Args:
        seconds: processor time of a run
        images: that the network learns from
        size: of the rendered answers, pixels along a side
    """
    torch.set_num_threads(1)
    for name in task:
        data = Data(name, images, size, 5)
        weights = parameter_count(PoseNetwork(len(data.ranges)))
        methods: dict[str, Any] = {}
        for method, rates in GRID.items():
            tried = {r: train(data, method, r, seconds / 4, 1000)["final"] for r in rates}
            best = min(tried, key=lambda rate, tried=tried: tried[rate])
            found = [train(data, method, best, seconds, seed) for seed in range(runs)]
            methods[method] = {"rate": best, "tried": tried, "runs": found}
            print(name, method, best, [round(one["final"], 3) for one in found], flush=True)
        entry = {"weights": weights, "seconds": seconds, "methods": methods}
        yield {"tasks": {name: entry}}


def table(record: Record) -> str:
    """Errors of the networks' answers, and when they had fallen by 90 and 99 %."""
    rows = []
    for entry in markdown.named(record["tasks"], "task", "methods", "method"):
        runs = entry["runs"]
        middle = len(runs) // 2
        finals, steps = (sorted(run[key] for run in runs) for key in ("final", "steps"))
        times = [sorted(run["reached"][goal] for run in runs)[middle] for goal in range(2)]
        row = "{task}, {weights} weights | {method} | {count} of {seconds:g} s | {rate:g}"
        rows.append(
            [
                markdown.fill(row, entry, {"count": len(runs)}),
                markdown.median_range((finals[middle], finals[0], finals[-1])),
                *(f"{t:.3g}" if math.isfinite(t) else "—" for t in times),
                steps[middle],
            ]
        )
    head = "task | method | runs | rate or radius | final error: median (range) | s to 90 % | 99 % | steps"
    return markdown.table(head, rows)


def plot(record: Record) -> figures.Figure:
    """Error over seconds."""
    panels = {
        name: {method: [run["curve"] for run in entry["runs"]] for method, entry in task["methods"].items()}
        for name, task in record["tasks"].items()
    }
    return figures.curves(panels, "seconds", "error of the poses / at the start")
