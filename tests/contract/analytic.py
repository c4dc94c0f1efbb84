"""Problems whose images and gradients are known exactly."""

from __future__ import annotations

import numpy as np

import unrender as ur
from tests.analytic import AnalyticRenderer
from unrender.core import registry

SHAPE = (4, 4)


def problem(
    loss: object = None, views: int = 1, noise: float = 0.5, shares_paths: bool = True, seed: int = 0
) -> ur.Problem:
    """Two parameters, a vector and a matrix, seen in a few pixels through a random positive matrix; the truth is known."""
    rng = np.random.default_rng(seed)
    truth = {"colour": rng.uniform(0.3, 0.9, 3), "map": rng.uniform(0.3, 0.9, (2, 2, 1))}
    matrix = rng.uniform(0.0, 1.0, (SHAPE[0] * SHAPE[1] * 3, 7))
    renderer = AnalyticRenderer(truth, matrix, 0.1, noise, shape=SHAPE, sensors=views, shares_paths=shares_paths)
    reference = renderer.exact(truth)
    return ur.Problem(
        renderer,
        [ur.Parameter("colour", initial=0.5, bounds=(0, 1)), ur.Parameter("map", initial=0.5, bounds=(0, 1))],
        [ur.View(reference, sensor=view) for view in range(views)],
        loss=loss or ur.losses.L2(),  # pyright: ignore[reportArgumentType]
        truth=truth,
    )


def exact_gradient(found: ur.Problem, parameters: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The gradient of the loss at the exact images."""
    renderer = found.renderer
    assert isinstance(renderer, AnalyticRenderer)
    image = renderer.exact(parameters)
    flat = sum(found.loss_derivative(view, image).reshape(-1) @ renderer.matrix for view in range(len(found.views)))
    result, start = {}, 0
    for key, value in parameters.items():
        result[key] = np.asarray(flat)[start : start + value.size].reshape(value.shape)
        start += value.size
    return result


def others(kind: str) -> dict[str, type]:
    """{name: class} of the registered components of a kind that other packages, installed here, have added."""
    known = registry.components(kind)
    return {name: made_by for name, made_by in known.items() if not made_by.__module__.startswith("unrender.")}
