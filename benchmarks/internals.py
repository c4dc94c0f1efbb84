"""Every name of the library that is not public and that benchmarks need: one place to mend when the library changes.

Dr.Jit and Mitsuba stand here untyped (`dr`, `mi`): their stubs know less than their functions return.
"""

# ruff: noqa: F401, F811 (names for other modules)

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

import unrender as ur
from unrender.app.stages import stages_file
from unrender.app.stages.stage_problem import StagedProblem
from unrender.backend.versions import hardware, versions
from unrender.core import arrays, trees
from unrender.core.random import Key
from unrender.core.trees import Tree
from unrender.estimators.base import Estimate, Estimator
from unrender.estimators.loss_values import BlackBox
from unrender.estimators.sample_groups import GradientRequest, leave_one_out_groups
from unrender.gallery import parts, volumes
from unrender.gallery.analytic import RATE
from unrender.gallery.heights import Lenses, Relief
from unrender.gallery.rooms import IndirectRoom
from unrender.gallery.specification import build_problem
from unrender.gallery.volumes import Smoke
from unrender.images import denoising
from unrender.images.base import ImageEstimate, ImageEstimator, PairRequest, PlainState
from unrender.methods import method
from unrender.methods.plan import Plan
from unrender.methods.rules import newton
from unrender.methods.rules import paths as rules_of_paths
from unrender.optimizers.base import Optimizer
from unrender.pixels.base import PixelSampler
from unrender.rendering.expressions import ExpressionRenderer
from unrender.rendering.mitsuba.path_cache.session import CachingSession
from unrender.rendering.mitsuba.ranges import Range, SlotReaders
from unrender.rendering.mitsuba.scene_graph import ObjectGraph
from unrender.rendering.mitsuba.scene_loading import load as load_scene
from unrender.rendering.mitsuba.scene_loading import media
from unrender.rendering.photographs import scene_renderer
from unrender.rendering.renderer import RenderSession, SampleRequest, Space, with_differential_bsdf
from unrender.rendering.tied import TiedRenderer
from unrender.rendering.wrapper import RendererWrapper
from unrender.runs import loop
from unrender.runs.budget import Budget
from unrender.runs.image_sensitivity import insensitive
from unrender.scene.batches import FullView
from unrender.scene.bounds import project
from unrender.scene.executor import LOCAL
from unrender.scene.parameter import ParameterSettings
from unrender.statistics import gaussian
from unrender.statistics.recursion import advance

dr: Any = importlib.import_module("drjit")
mi: Any = importlib.import_module("mitsuba")


def prepare(problem: ur.Problem, keys: Any, space: Space | None = None, derivatives: bool = True) -> RenderSession:
    """The render session of the problem for these parameters; see `Renderer.prepare`."""
    return problem.renderer.prepare(list(keys), space, derivatives)


def stock_scene(problem: ur.Problem) -> tuple[Any, Any]:
    """The problem's scene and its `mi.traverse` parameters, for loops of stock Mitsuba on them."""
    pair = _mitsuba(problem).pair
    return pair.previous, pair.loaded(previous=True).parameters


def scene_values(problem: ur.Problem, values: Mapping[str, Any]) -> dict[str, Any]:
    """{key of the scene: value} for values of the unknowns, by ties and expressions, with derivatives where the values have some."""
    found, renderer = dict(values), problem.renderer
    while isinstance(renderer, RendererWrapper):
        if isinstance(renderer, TiedRenderer):
            found = renderer.scene_values(found)
        elif isinstance(renderer, ExpressionRenderer):
            own = {key: found.pop(key) for key in renderer.unknowns if key in found}
            found |= renderer.evaluated(own)
        renderer = renderer.inner
    return found


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

    renderer = scene_renderer(problem.renderer)
    if not isinstance(renderer, MitsubaRenderer):
        raise TypeError(f"{problem.name} is not rendered by Mitsuba")
    return renderer


def from_tensor(value: Any, like: Any) -> Any:
    """A tensor in the type that a scene's parameter has."""
    from unrender.rendering.mitsuba.parameters import from_tensor as convert

    # A product, since the derivative of `dr.unravel` overwrites those that its argument has from elsewhere.
    return convert(value * 1.0, like)


def image_step(
    problem: ur.Problem, image: ImageEstimator, parameters: Tree, state: Any, spp: int, key: Key
) -> tuple[ImageEstimate, Any]:
    """An estimate of view 0 from an image estimator, and its state at the next step."""
    estimate, kept = image.estimate(problem, parameters, state, FullView(problem, 0), spp, 1, key)
    return estimate, image.advance(parameters, state, (kept,))


def coupled_gradients(
    problem: ur.Problem, current: Tree, previous: Tree, space: Any, spp: int, key: Key
) -> tuple[Tree, Tree]:
    """Gradients F of the current state and H of the previous one, from the same samples."""
    request = PairRequest(previous, space)
    asked = GradientRequest(current, ur.images.Plain(), PlainState(), spp, key, pair_request=request)
    found = LOCAL.estimate_gradient(problem, asked)
    if found.previous is None:
        raise RuntimeError("the pair has no previous gradient")
    return found.gradient, found.previous


def available_denoiser() -> denoising.Denoiser:
    """The denoiser that "auto" means here; total variation where neither OptiX nor Open Image Denoise can run."""
    try:
        return denoising.choose("auto")
    except ur.InputError:
        return "variation"


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


def element_scales(like: Tree, squares: np.ndarray) -> np.ndarray:
    """What adaptive pixels multiply the derivative of each element by, for mean squared gradients (n,) in the order of `like`."""
    from unrender.pixels.pixel_statistics import scales

    tree = trees.parts(squares, like)
    return np.concatenate([np.ravel(x) for x in scales(tree, tree).values()])


def pixel_shares(problem: ur.Problem, sampler: Any, state: Any) -> np.ndarray:
    """Probabilities of the pixels of all views, relative to uniform ones, by the state of a sampler with an importance map."""
    tiles = sampler._sampler_for(problem)._tiles(problem)
    found = []
    for part, grid, view in zip(tiles.split(state.shares), tiles.grids, problem.views, strict=True):
        height, width = problem.renderer.resolutions()[view.sensor]
        found.append(part.repeat(grid.side, axis=0)[:height].repeat(grid.side, axis=1)[:, :width].ravel())
    return np.concatenate(found)


def second_moments(
    problem: ur.Problem, at: Tree, scales: Sequence[np.ndarray], paths: int, parts: int, key: Key
) -> np.ndarray:
    """Σ_c E[(∂L/∂I)²] Σ_k E[(∂I/∂θ_k)²] of each pixel of all views by single paths, (len(scales), parts, pixels), parts independent: from
    about `paths` paths in all, the two factors from different ones.

    Args:
        problem, at: what is rendered.
        scales: factors of the elements' derivatives in the coordinates of the descent, (n,) each.
        paths: how many; 8 a pixel and part at least.
        parts: independent estimates.
        key: of the random numbers.
    """
    from unrender.pixels.pixel_statistics import random_tangents

    each = 8
    rounds = max(1, round(paths / (problem.pixels * parts * each)))
    session = prepare(problem, at)
    factors = [{name: problem.renderer.array(value) for name, value in trees.parts(one, at).items()} for one in scales]
    found = np.zeros((len(scales), parts, problem.pixels))
    for part in range(parts):
        first = 0
        for index, view in enumerate(problem.views):
            squares, moments = [], []
            for turn in range(rounds):
                of_turn = key.fold(part).fold(index).fold(turn)
                rendering = session.image(at, SampleRequest(view.sensor, each, of_turn.uint32(), each))
                derivative = arrays.numpy(problem.loss_derivative(index, rendering.images)).astype(np.float64)
                squares.append(np.square(derivative).reshape(2, each // 2, -1, 3).mean(axis=1))
                along = [random_tangents(problem, at, one, of_turn.fold(1)) for one in factors]
                told = [arrays.numpy(session.tangent_moment(at, rendering.paths, one)) for one in along]
                moments.append(np.reshape(told, (len(scales), 2, each // 2, -1, 3)).mean(axis=2, dtype=np.float64))
            a, b = np.mean(squares, axis=0), np.mean(moments, axis=0)
            last = first + a.shape[1]
            found[:, part, first:last] = (a[::-1] * b).sum(axis=(1, 3))
            first = last
    return found


def gradient_of(problem: ur.Problem, parameters: Tree, batch: Any, key: Key, spp: int = 2) -> list[np.ndarray]:
    """The gradient from a pixel mini-batch, in the coordinates of the descent."""
    asked = GradientRequest(parameters, ur.images.Plain(), PlainState(), spp, key, batch=batch)
    found = LOCAL.estimate_gradient(problem, asked)
    coordinates = problem.coordinates
    moved = coordinates.pull_back(coordinates.wrt_u(found.gradient, parameters), {})
    return [arrays.numpy(value) for value in moved.values()]


def with_preconditioner(problem: ur.Problem, preconditioner: Any, *keys: str) -> ur.Problem:
    """Return the problem with a preconditioner for parameters that have none."""
    return problem.configured(dict.fromkeys(keys, ParameterSettings(preconditioner=preconditioner)))


def descend(problem: ur.Problem, estimator: Estimator, optimizer: Optimizer, steps: int) -> dict[str, np.ndarray]:
    """Return the parameters after some steps; without the pictures that verify a run, which cost more than a short one."""
    run = loop.prepare(Plan(problem, estimator, optimizer), steps, None, 1)
    run.callbacks = [Budget()]
    return loop.descend(run).parameters
