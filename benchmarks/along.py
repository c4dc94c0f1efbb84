"""What the figures share: paths through parameter space that every method takes alike, runs along them, moments."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

import unrender as ur
from unrender.core import arrays
from unrender.core.random import Key
from unrender.core.trees import Tree
from unrender.images.base import ImageEstimate, ImageEstimator
from unrender.problem.batches import WholeView
from unrender.rendering.renderer import SampleRequest

CHUNK = 64
"""Samples per pixel of one render of `converged`."""


def gallery(name: str, resolution: int, texture_resolution: int, **options: Any) -> ur.Problem:
    """A gallery problem at a small size."""
    return ur.gallery.problem(name, resolution=resolution, texture_resolution=texture_resolution, **options)


def drift(problem: ur.Problem, steps: int, half_life: float) -> list[Tree]:
    """A fixed path: from the initial values towards the truth, halving the distance every `half_life` steps."""
    start = {key: arrays.numpy(value) for key, value in problem.initial().items()}
    path = []
    for step in range(steps):
        left = 0.5 ** (step / half_life)
        values = {key: problem.truth[key] + left * (start[key] - problem.truth[key]) for key in start}
        path.append({key: problem.renderer.array(value) for key, value in values.items()})
    return path


class _Recorder(ur.Callback):
    """Keeps the parameters of every step of a run."""

    def __init__(self) -> None:
        self.path: list[Tree] = []

    def on_start(self, run: Any) -> None:
        self.path.append(dict(run.parameters))

    def on_step(self, run: Any, record: Any) -> None:
        del record
        self.path.append(dict(run.parameters))


def descent(problem: ur.Problem, estimator: ur.PathGradient, rate: float, steps: int, seed: int = 0) -> list[Tree]:
    """The parameters at each of `steps` steps of a real optimization, the first one included."""
    recorder = _Recorder()
    ur.optimize(problem, estimator, ur.optimizers.Adam(rate), steps=max(steps - 1, 1), seed=seed, callbacks=[recorder])
    return recorder.path[:steps]


class Moments:
    """Mean and variance over independent runs, per element of an array, and the spread of its overall mean."""

    def __init__(self) -> None:
        self.count = 0
        self.mean: np.ndarray = np.zeros(())
        self._squares: np.ndarray = np.zeros(())
        self._levels: list[float] = []

    def add(self, values: Any) -> None:
        """One more run."""
        x = np.asarray(values, np.float64)
        self.count += 1
        before = x - self.mean
        self.mean = self.mean + before / self.count
        self._squares = self._squares + before * (x - self.mean)
        self._levels.append(float(x.mean()))

    @property
    def variance(self) -> np.ndarray:
        """Of one run; unbiased."""
        return self._squares / (self.count - 1)

    @property
    def error(self) -> np.ndarray:
        """Standard error of `mean`, per element."""
        return np.sqrt(self.variance / self.count)

    @property
    def level(self) -> float:
        """The mean over all elements."""
        return float(np.mean(self._levels))

    @property
    def level_error(self) -> float:
        """Its standard error."""
        return float(np.std(self._levels, ddof=1) / np.sqrt(self.count))


def converged(problem: ur.Problem, parameters: Tree, spp: int, seed: int = 987_654) -> Moments:
    """View 0 at `spp` samples per pixel or a little more, in chunks of seeds of its own, so that its error is known."""
    session = problem.renderer.prepare(list(parameters), None)
    found = Moments()
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
        estimate, kept = image.estimate(problem, parameters, state, WholeView(problem, 0), spp, 1, Key(seed, step))
        state = image.advance(parameters, state, (kept,))
        arrays.evaluate(state, estimate.images, dict(estimate.info))
        yield estimate


def bias(found: Moments, reference: Moments) -> dict[str, float]:
    """How far the mean of runs is from a converged image, freed of the noise that both have.

    Returns:
        signed, signed_error: mean over pixels of the difference, with standard error, over the mean of |reference|.
        square, square_error: mean square of the difference less what noise alone gives (may be negative), likewise.
        rms: the root of `square`, 0 where that is negative.
        variance: of one run, mean over pixels, relative to the squared mean of |reference|.
    """
    scale = float(np.abs(reference.mean).mean())
    level_error = float(np.hypot(found.level_error, reference.level_error))
    summary = _bias(found.mean - reference.mean, found.error**2 + reference.error**2, level_error, scale)
    return {**summary, "variance": float(found.variance.mean() / scale**2)}


def paired_bias(difference: Moments, scale: float) -> dict[str, float]:
    """The same from differences, run by run, to something unbiased that takes the same samples, relative to `scale`."""
    return _bias(difference.mean, difference.error**2, difference.level_error, scale)


def _bias(difference: np.ndarray, noise: np.ndarray, level_error: float, scale: float) -> dict[str, float]:
    squares = ((difference**2 - noise) / scale**2).mean(axis=-1)  # channels of a pixel share paths; pixels do not
    square = float(squares.mean())
    return {
        "signed": float(difference.mean() / scale),
        "signed_error": level_error / scale,
        "square": square,
        "square_error": float(squares.std(ddof=1) / np.sqrt(squares.size)),
        "rms": float(np.sqrt(max(square, 0.0))),
    }


def write_maps(folder: Path, maps: dict[str, np.ndarray]) -> None:
    """Write maps.npz beside results.json: pictures for the plot, in single precision."""
    stored: dict[str, Any] = {name: np.float32(picture) for name, picture in maps.items()}
    np.savez_compressed(folder / "maps.npz", **stored)
    print(f"wrote {folder / 'maps.npz'}")


def read_maps(folder: Path) -> dict[str, np.ndarray]:
    """The pictures that `write_maps` left."""
    with np.load(folder / "maps.npz", allow_pickle=False) as stored:
        return dict(stored)
