"""Paths through parameter space that every method takes alike, and image estimates along them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

import unrender as ur
from benchmarks.internals import (
    Estimator,
    ImageEstimate,
    ImageEstimator,
    Key,
    SampleRequest,
    Tree,
    arrays,
    image_step,
    prepare,
)
from benchmarks.moments import Moments

CHUNK = 64
"""Samples per pixel of one render of `converged`."""


def truth(problem: ur.Problem) -> Tree:
    """The true parameters, in the renderer's arrays."""
    return {key: problem.renderer.array(value) for key, value in problem.truth.items()}


def geometric(problem: ur.Problem, steps: int, half_life: float) -> list[Tree]:
    """From the initial values towards the truth, halving the distance every `half_life` steps."""
    start = {key: arrays.numpy(value) for key, value in problem.initial().items()}
    path = []
    for step in range(steps):
        left = 0.5 ** (step / half_life)
        values = {key: problem.truth[key] + left * (start[key] - problem.truth[key]) for key in start}
        path.append({key: problem.renderer.array(value) for key, value in values.items()})
    return path


class _Recorder(ur.protocols.Callback):
    """Keeps the parameters of every step of a run."""

    def __init__(self) -> None:
        self.path: list[Tree] = []

    def on_start(self, run: Any, record: Any = None) -> None:
        self.path.append(dict(run.parameters))

    on_step = on_start


def descent(
    problem: ur.Problem, estimator: Estimator, rate: float, steps: int, seed: int = 0, falling: bool = False
) -> list[Tree]:
    """The parameters at each of `steps` steps of Adam, the first one included; with `falling` its rate falls as half a cosine."""
    recorder, taken = _Recorder(), max(steps - 1, 1)
    optimizer = ur.optimizers.Adam(rate, schedule=ur.schedules.Cosine(taken) if falling else None)
    ur.optimize(problem, estimator, optimizer, steps=taken, seed=seed, callbacks=[recorder])
    return recorder.path[:steps]


def converged(problem: ur.Problem, parameters: Tree, spp: int, seed: int = 987_654) -> Moments:
    """View 0 at `spp` samples per pixel or a little more, in chunks of seeds of its own, so that its error is known."""
    session, found = prepare(problem, parameters), Moments()
    for number in range(max(2, -(-spp // CHUNK))):
        request = SampleRequest(problem.views[0].sensor, min(CHUNK, spp), Key(seed, number).uint32())
        found.add(arrays.numpy(session.image(parameters, request).images[0]))
    return found


def follow(
    problem: ur.Problem, image: ImageEstimator, path: Sequence[Tree], spp: int, seed: int
) -> Iterator[ImageEstimate]:
    """One run of an image estimator on view 0 along a path of parameters: its estimate at every step."""
    state = image.init(problem, path[0])
    for step, parameters in enumerate(path):
        estimate, state = image_step(problem, image, parameters, state, spp, Key(seed, step))
        arrays.evaluate(state, estimate.images, dict(estimate.info))
        yield estimate


def images_along(
    problem: ur.Problem, image: ImageEstimator, path: Sequence[Tree], spp: int, seed: int
) -> tuple[np.ndarray, np.ndarray]:
    """Images and control weights (0 where there are none) of one run, (steps, H, W, 3) each."""
    images, weights = [], []
    for estimate in follow(problem, image, path, spp, seed):
        images.append(arrays.numpy(estimate.mean()).astype(np.float64))
        weights.append(weight_of(estimate, images[-1]))
    return np.stack(images), np.stack(weights)


def weight_of(estimate: ImageEstimate, image: np.ndarray) -> np.ndarray:
    """The control weight of an estimate, 0 where it has none."""
    return arrays.numpy(estimate.info["control_weight"]) if estimate.info else np.zeros_like(image)
