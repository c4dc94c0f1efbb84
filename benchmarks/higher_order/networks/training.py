"""Training of a network by the derivative of a black box behind it: from an image of a mug to its orientation, or to rotation, position and
colour.

The paper gives the sizes alone, 267 745 parameters for one output and 268 773 for five. Their difference is four rows of 257, so the last
layer reads 256 features; three convolutions of 3 × 3 with 16 channels, each halving an image of 64 × 64, and a layer of 256 on what
they leave (16 × 8 × 8) make exactly these numbers.
"""

from __future__ import annotations

import functools
import importlib
import math
import time
from collections.abc import Callable
from typing import Any

import numpy as np

import unrender as ur
from benchmarks.higher_order.table2.published import SETTINGS, fr22_gradient
from benchmarks.internals import SampleRequest, dr, prepare

torch: Any = importlib.import_module("torch")
nn = torch.nn

RESOLUTION = 64
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
EPOCH = 100
"""Steps with the paper's settings between errors."""
_FARTHEST = 30.0
"""The largest scale of a weight over their median."""


class PoseNetwork(nn.Module):
    """Images (K, 64, 64, 3), linear, to (K, outputs).

    Halves by stride, which the paper does not say, and by default with a smooth activation, so that its second derivatives are those of
    what it computes; `nn.ReLU` has them piecewise.
    """

    def __init__(self, outputs: int, activation: Callable[[], Any] = nn.SiLU):
        super().__init__()
        layers: list[Any] = []
        for channels in (3, 16, 16):
            layers += [nn.Conv2d(channels, 16, kernel_size=3, stride=2, padding=1), activation()]
        side = RESOLUTION // 8
        self.layers = nn.Sequential(
            *layers, nn.Flatten(), nn.Linear(16 * side * side, 256), activation(), nn.Linear(256, outputs)
        )

    def forward(self, images: Any) -> Any:
        return self.layers(images.permute(0, 3, 1, 2))


def parameter_count(network: Any) -> int:
    """How many weights it has."""
    return sum(weight.numel() for weight in network.parameters())


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
        self.session, self.pictures = self._prepared(size), self._prepared(RESOLUTION)
        self.renew(count, seed, REFERENCES, 2)
        self.evaluations, self.step, self.spp = 0, 0, 1

    def renew(self, count: int, seed: int, references: int, picture_seed: int) -> None:
        """Draw other poses, and render what the network sees and so many renders of each reference."""
        self.truth = np.random.default_rng(seed).uniform(-1, 1, (count, len(self.ranges)))
        renders = [self._render(self.session, self.truth, 64, 10_000 + number) for number in range(references)]
        self.references = np.mean(renders, axis=0)
        images = self._render(self.pictures, self.truth, 64, picture_seed)
        images = images - images.mean(axis=0)
        self.images = torch.tensor(images / images.std(), dtype=torch.float32)

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

    def losses(self, points: np.ndarray, items: np.ndarray | int) -> np.ndarray:
        """Return the losses (B,) of poses (B, n) against the images of some indices, (B,) or one: the mean product of the differences of
        two renders of `spp` samples per pixel. Unlike a square it has no variance of a render, which grows with the brightness and would
        darken the answers."""
        self.evaluations += 2 * len(points)
        seeds = (1000 + 2 * self.step, 1001 + 2 * self.step)
        one, other = (self._render(self.session, points, self.spp, seed) - self.references[items] for seed in seeds)
        return (one * other).mean(axis=(1, 2, 3)) * 100.0

    def error(self, network: Any) -> float:
        """Root mean square of the answers, in units of the ranges."""
        return float(np.sqrt(np.mean((self._answers(network) - self.truth) ** 2)))

    def image_error(self, network: Any) -> float:
        """Mean square difference of the answers' renders from the references, less that of the truth's renders."""
        squares = [
            np.mean((self._render(self.session, poses, 64, 3) - self.references) ** 2)
            for poses in (self._answers(network), self.truth)
        ]
        return float(squares[0] - squares[1])

    def _answers(self, network: Any) -> np.ndarray:
        with torch.no_grad():
            return network(self.images).double().numpy()


def train(data: Data, method: str, rate: float, seconds: float, seed: int, samples: int = 8) -> dict[str, Any]:
    """One run: errors over time, relative to the first."""
    data.evaluations = data.step = 0
    torch.manual_seed(seed)
    network = PoseNetwork(len(data.ranges))
    weights = list(network.parameters())
    adam = torch.optim.Adam(weights, lr=rate)
    curve, clock, first_image = [(0.0, data.error(network))], 0.0, data.image_error(network)

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
    image = data.image_error(network) / first_image
    return {**figures(curve), "image": image, "steps": data.step, "evaluations": data.evaluations}


def train_published(data: Data, seed: int, steps: int) -> dict[str, Any]:
    """One run with the settings of the paper's public code: a pose, one antithetic pair and one step of Adam at a time, σ constant.

    Answers are 18 units of 20 degrees times a sigmoid. Poses are new in each epoch of 100 steps, whose mean squared error is a point of
    the curve. For one number FR22 and the paper's gradient are the same estimate.
    """
    settings = SETTINGS["CNN"]["FR22, published"]
    unit, rng, curve, clock = settings.unit / float(data.ranges[0]), np.random.default_rng([41, seed]), [], 0.0
    torch.manual_seed(seed)
    network, data.spp, data.evaluations = PoseNetwork(1), settings.spp // 2, 0
    adam = torch.optim.Adam(network.parameters(), lr=settings.rate)
    for epoch in range(steps // EPOCH):
        data.renew(EPOCH, 1000 * (seed + 1) + epoch, 1, 2 + epoch)
        squares, began = [], time.process_time()
        for item in range(EPOCH):
            data.step = EPOCH * epoch + item
            answer = unit * (18 * torch.sigmoid(network(data.images[item : item + 1])) - 9)[0]
            point = answer.detach().double().numpy()
            squares.append(float((point[0] - data.truth[item, 0]) ** 2))
            losses = functools.partial(data.losses, items=item)
            slope = fr22_gradient(losses, point, unit * settings.sigma, settings.pairs, rng)
            adam.zero_grad()
            answer.backward(torch.tensor(slope, dtype=answer.dtype))
            adam.step()
        clock += time.process_time() - began
        curve.append((clock, float(np.sqrt(np.mean(squares)))))
    return {**figures(curve, 1), "steps": data.step + 1, "evaluations": data.evaluations}


def figures(curve: list[tuple[float, float]], window: int = 10) -> dict[str, Any]:
    """Return times to `GOALS`, final error and curve of (seconds, error), relative to the first error, averaged over `window` points."""
    times, errors = np.array([t for t, _ in curve]), np.array([e for _, e in curve]) / curve[0][1]
    smooth = np.convolve(errors, np.ones(window) / window, mode="valid")
    met = [smooth <= goal for goal in GOALS]
    keep = np.unique(np.round(np.geomspace(1, len(times), 100)).astype(int) - 1)
    return {
        "reached": [float(times[window - 1 :][np.argmax(m)]) if m.any() else math.inf for m in met],
        "final": float(smooth[-1]),
        "curve": [times[keep].round(3).tolist(), errors[keep].round(5).tolist()],
    }
