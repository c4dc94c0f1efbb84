"""Every name of the library that is not public and that benchmarks need: one place to mend when the library changes.

Dr.Jit and Mitsuba stand here untyped (`dr`, `mi`): their stubs know less than their functions return.
"""

from __future__ import annotations

import importlib
import time
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

import unrender as ur
from unrender.core import arrays, trees, vectors
from unrender.core.random import Key
from unrender.core.trees import Tree
from unrender.estimators.base import Estimator
from unrender.estimators.loss_values import BlackBox
from unrender.estimators.sample_groups import gather
from unrender.images.base import ImageEstimate, ImageEstimator, PairRequest
from unrender.images.plain import PlainState
from unrender.methods import method
from unrender.optimizers.base import Optimizer
from unrender.pixels.base import PixelSampler
from unrender.problem.batches import WholeView
from unrender.problem.bounds import project
from unrender.rendering.numpy.exponential import RATE
from unrender.rendering.renderer import Renderer, RenderSession, SampleRequest, Space
from unrender.runs import optimize as runs_optimize
from unrender.runs.folder.writer import RunWriter
from unrender.runs.result import hardware, versions
from unrender.runs.sensitivity import hardly_seen
from unrender.statistics.recursion import advance

dr: Any = importlib.import_module("drjit")
mi: Any = importlib.import_module("mitsuba")

__all__ = [
    "RATE",
    "Estimator",
    "ImageEstimate",
    "ImageEstimator",
    "Key",
    "Optimizer",
    "PixelSampler",
    "Renderer",
    "SampleRequest",
    "Tree",
    "advance",
    "arrays",
    "black_box",
    "coupled_gradients",
    "dr",
    "from_tensor",
    "hardly_seen",
    "hardware",
    "image_step",
    "loss_derivative",
    "method",
    "method_parts",
    "mi",
    "mitsuba_renderer",
    "pixel_probability",
    "prepare",
    "project",
    "scene_description",
    "stock_scene",
    "time_run_folder",
    "trees",
    "vectors",
    "versions",
    "volumetric",
]


def prepare(problem: ur.Problem, keys: Any, space: Space | None = None, derivatives: bool = True) -> RenderSession:
    """The render session of the problem for these parameters; see `Renderer.prepare`."""
    return problem.renderer.prepare(list(keys), space, derivatives)


def mitsuba_renderer(scene: Callable[[], Any], depth: int) -> Renderer:
    """Mitsuba's renderer of a scene description."""
    from unrender.rendering.mitsuba.renderer import MitsubaRenderer

    return MitsubaRenderer(scene, depth)


def stock_scene(problem: ur.Problem) -> tuple[Any, Any]:
    """The problem's scene and its `mi.traverse` parameters, for loops of stock Mitsuba on them."""
    pair = _mitsuba(problem).pair
    return pair.previous, pair.previous_parameters


def volumetric(problem: ur.Problem) -> bool:
    """Whether the problem's scene has participating media."""
    return _mitsuba(problem).pair.volumetric


def scene_description(problem: ur.Problem) -> Any:
    """The dictionary that a gallery problem's scene is loaded from."""
    description = _mitsuba(problem).pair.description
    if not callable(description):
        raise TypeError(f"{problem.name} was not made from a description")
    return description()


def _mitsuba(problem: ur.Problem) -> Any:
    from unrender.rendering.mitsuba.renderer import MitsubaRenderer

    if not isinstance(problem.renderer, MitsubaRenderer):
        raise TypeError(f"{problem.name} is not rendered by Mitsuba")
    return problem.renderer


def from_tensor(value: Any, like: Any) -> Any:
    """A tensor in the type that a scene's parameter has."""
    from unrender.rendering.mitsuba.tensors import from_tensor as convert

    return convert(value, like)


def image_step(
    problem: ur.Problem, image: ImageEstimator, parameters: Tree, state: Any, spp: int, key: Key
) -> tuple[ImageEstimate, Any]:
    """An estimate of view 0 from an image estimator, and its state at the next step."""
    estimate, kept = image.estimate(problem, parameters, state, WholeView(problem, 0), spp, 1, key)
    return estimate, image.advance(parameters, state, (kept,))


def coupled_gradients(
    problem: ur.Problem, current: Tree, previous: Tree, space: Any, spp: int, key: Key
) -> tuple[Tree, Tree]:
    """Gradients F of the current state and H of the previous one, from the same samples."""
    request = PairRequest(previous, space)
    found = gather(problem, current, ur.images.Plain(), PlainState(), spp, key, pair_request=request)
    if found.previous is None:
        raise RuntimeError("the pair has no previous gradient")
    return found.gradient, found.previous


def loss_derivative(problem: ur.Problem, view: int, images: Any) -> Any:
    """The derivative of the problem's loss by the images of a view."""
    return problem.loss_derivative(view, images)


def black_box(
    problem: ur.Problem, parameters: Mapping[str, Any], spp: int, key: Key
) -> Callable[[np.ndarray], np.ndarray]:
    """The loss at points (B, n), all with the same random numbers, (B,)."""
    return BlackBox(problem, dict(parameters), spp, key).losses


def pixel_probability(problem: ur.Problem, sampler: PixelSampler, key: Key) -> np.ndarray:
    """A pixel sampler's first probabilities for view 0, one per pixel, over uniform ones."""
    at = problem.initial()
    batch, _ = sampler.draw(problem, at, sampler.init(problem, at), key)
    return batch.probability[0]


def method_parts(name: str, settings: Mapping[str, Any] | None = None) -> tuple[Estimator, Optimizer]:
    """Estimator and optimizer of a method of the command line."""
    return method(name).start(settings)


def time_run_folder(spent: dict[str, list[float]]) -> Callable[[], None]:
    """Time the writing of run folders: from now on, `spent` gets the seconds of each "history" line and each of the "checkpoints".

    Returns a function that ends it.
    """

    class TimedWriter(RunWriter):
        def append(self, record: Mapping[str, Any]) -> None:
            began = time.perf_counter()
            super().append(record)
            spent["history"].append(time.perf_counter() - began)

        def write_checkpoint(self, *arguments: Any) -> None:
            began, before = time.perf_counter(), self._written_step
            super().write_checkpoint(*arguments)
            if self._written_step != before:
                spent["checkpoints"].append(time.perf_counter() - began)

    runs_optimize.RunWriter = TimedWriter

    def end() -> None:
        runs_optimize.RunWriter = RunWriter

    return end
