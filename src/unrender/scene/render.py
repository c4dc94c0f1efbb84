"""Rendering of a problem's views to NumPy arrays, for display, reports and comparison."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from unrender.core import arrays, checks, timing
from unrender.core.errors import InputError, UnrenderError
from unrender.core.exclusive import exclusive
from unrender.core.random import Key, check_seed
from unrender.core.text import in_words
from unrender.core.trees import Tree
from unrender.rendering.renderer import SampleRequest
from unrender.scene.problem import Problem

_PATHS_PER_PASS = 1 << 21  # maximum number of paths per pass, within the memory of a small machine
_SELECTED_VIEWS = 4  # maximum number of views that `selected_views` returns
MANY_SENSORS = 4
"""Number of sensors from which all views share one kernel: recording one per sensor would take longer than rendering."""


@exclusive("render")
def render(
    problem: Problem,
    parameters: Mapping[str, np.ndarray] | None = None,
    view: int = 0,
    spp: int = 64,
    seed: int = 0,
    per_pass: int | None = None,
) -> np.ndarray:
    """Render one view, in as many passes as memory requires. Unbiased, with the film's reconstruction filter.

    Args:
        problem: problem that contains the scene.
        parameters: {key: array} of all parameters of the problem, possibly at a coarser resolution of the run; None for the initial ones.
        view: index of the view.
        spp: samples per pixel, >= 1.
        seed: seed of the random numbers, which differ between views.
        per_pass: most samples per pixel of a pass, >= 1. Passes of equal counts share one kernel. None for the most that memory allows.

    Returns:
        float32 (H, W, 3), linear RGB.

    Raises:
        InputError: `spp` or `view` is out of range, or `parameters` have other keys or shapes, or are not finite.
    """
    check_problem("render", problem)
    spp = checks.integer("render", "spp", spp, at_least=1)
    seed, view = check_seed("render: seed", seed), checks.integer("render", "view", view, at_least=0)
    if view >= len(problem.views):
        raise InputError(f"render: view must be 0 to {len(problem.views) - 1}, got {in_words(view)}")
    point = as_tree(problem, parameters)
    session = problem.renderer.prepare(list(point), None, derivatives=False)
    sensor = problem.views[view].sensor
    height, width = problem.renderer.resolutions()[sensor]
    most = spp if per_pass is None else checks.integer("render", "per_pass", per_pass, at_least=1)
    per_pass = max(1, min(spp, _PATHS_PER_PASS // (height * width), most))
    # Views of one seed are independent, so their noise averages out.
    total, done, key = np.zeros((height, width, 3)), 0, Key(seed, view)
    while done < spp:
        take = min(per_pass, spp - done)
        request = view_request(problem, view, take, key.fold(done).uint32())
        total += take * arrays.numpy(session.image(point, request).images[0]).reshape(total.shape)
        timing.add(take * height * width)
        done += take
    return (total / spp).astype(np.float32)


_FEW_PIXELS = 64  # below, starting a render takes longer than its paths


def limited_spp(paths: int, pixels: int, limits: tuple[int, int]) -> int:
    """Return the samples per pixel of a path budget, within limits; fewer than 64 pixels, such as those of meters, have up to as many paths
    as 64."""
    low, high = limits
    return min(max(paths // pixels, low), high * max(_FEW_PIXELS // pixels, 1))


def power_of_two(number: int) -> int:
    """Return the largest power of two <= `number`, at least 1. Few different sample counts need few different kernels."""
    return 1 << (max(number, 1).bit_length() - 1)


def view_request(problem: Problem, view: int, spp: int, seed: int) -> SampleRequest:
    """Return the request for a view.

    It is for the view's sensor. With many sensors it is for all pixels of the film instead, each with the sensor's index. Images are then
    (groups, H * W, 3), and all views of one size share their kernels.
    """
    sensor, sensors = problem.views[view].sensor, {other.sensor for other in problem.views}
    known = problem.renderer.parameters()
    if len(sensors) < MANY_SENSORS or any(known[parameter.key].rigid for parameter in problem.parameters):
        return SampleRequest(sensor, spp, seed)
    height, width = problem.renderer.resolutions()[sensor]
    like = problem.renderer.array(np.zeros(1))
    sensor_of_pixel = arrays.like_integers(np.full(height * width, sensor), like)
    return SampleRequest(min(sensors), spp, seed, 1, arrays.arange(like, height * width), sensor_of_pixel)


@exclusive("render_pair")
def render_pair(
    problem: Problem, current: Mapping[str, np.ndarray], previous: Mapping[str, np.ndarray], spp: int, seed: int
) -> tuple[np.ndarray, np.ndarray]:
    """Render view 0 in two states with the same paths, which are traced in the current state. Both images are unbiased.

    Args:
        problem: problem that contains the scene; its parameters must share paths (`ParameterInfo.shares_paths`).
        current, previous: {key: array} of all parameters of the problem.
        spp: samples per pixel, >= 1.
        seed: seed of the random numbers.

    Returns:
        float32 (H, W, 3) of the current state, and the same of the previous state.
    """
    check_problem("render_pair", problem)
    spp, seed = checks.integer("render_pair", "spp", spp, at_least=1), check_seed("render_pair: seed", seed)
    points = as_tree(problem, current), as_tree(problem, previous)
    session = problem.renderer.prepare(list(points[0]), "path")
    request = SampleRequest(problem.views[0].sensor, spp, Key(seed).uint32())
    rendering = session.image_pair(*points, request, "path")
    current_image, previous_image = rendering.images, rendering.previous
    if previous_image is None:
        raise UnrenderError("render_pair: the renderer returned only one of two images")
    return arrays.numpy(current_image[0]), arrays.numpy(previous_image[0])


def check_problem(owner: str, problem: Any) -> None:
    """Raise `InputError` for anything but a `Problem`."""
    if not isinstance(problem, Problem):
        words = f"the class {problem.__name__}" if isinstance(problem, type) else in_words(problem)
        raise InputError(f"{owner}: expected a Problem, such as that of Problem.from_file, got {words}")


def as_tree(problem: Problem, parameters: Mapping[str, np.ndarray] | None) -> Tree:
    """Return `parameters` as arrays of the renderer; None for the initial ones. Raises `InputError` for other keys or shapes, and NaN."""
    point = problem.initial()
    if parameters is None:
        return point
    if not isinstance(parameters, Mapping):
        raise InputError(f"parameters: expected values by key of the problem's unknowns, got {in_words(parameters)}")
    if set(parameters) != set(point):
        raise InputError(f"parameters: expected {sorted(point)}, got {sorted(parameters)}")
    given = {key: checks.array_like(value, "fill it") for key, value in parameters.items()}
    for key, value in given.items():
        checks.refuse_encoded(checks.as_array(value, f"parameter {key}: "), f"parameter {key}: ")
    parameters = problem.full({key: arrays.to_numpy(x, arrays.shape(point[key])) for key, x in given.items()})
    for key, value in parameters.items():
        if np.shape(value) != arrays.shape(point[key]):
            raise InputError(f"parameter {key}: expected shape {arrays.shape(point[key])}, got {np.shape(value)}")
        if np.asarray(value).dtype.kind in "OSUc" or not np.isfinite(value).all():
            raise InputError(f"parameter {key}: expected finite numbers, got NaN, infinite ones or another type")
    return {key: problem.renderer.array(np.asarray(parameters[key])) for key in point}


def selected_views(problem: Problem) -> list[int]:
    """Return the indices of at most four views, evenly spaced, for tests that cannot render all."""
    count = len(problem.views)
    return sorted({round(place) for place in np.linspace(0, count - 1, min(count, _SELECTED_VIEWS))})
