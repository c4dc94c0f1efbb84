"""Priors and regularizers of unknowns as terms of the loss: their values and exact derivatives."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np

from unrender.core import arrays, trees
from unrender.core.arrays import Array
from unrender.core.trees import Tree
from unrender.estimators.base import Estimate
from unrender.estimators.capabilities import (
    BlockEstimate,
    Capability,
    FreshGradient,
    Hessian,
    HessianProduct,
    LossFunction,
)
from unrender.estimators.coordinates import PreconditionedPerturbations, restricted
from unrender.scene.problem import Problem


def penalty(problem: Problem, parameters: Mapping[str, Array | np.ndarray]) -> float:
    """Return the sum of priors and regularizers at `parameters`; 0 if there are none."""
    return sum(_terms(problem, key, parameters[key])[0] for key in _keys(problem))


def penalized(estimate: Estimate, problem: Problem, parameters: Tree) -> Estimate:
    """Return the estimate with priors and regularizers added, in second derivatives without those of meshes; itself without any."""
    if not (keys := _keys(problem)):
        return estimate
    terms = {key: _terms(problem, key, parameters[key]) for key in keys}
    added = {key: arrays.like(gradient.astype(np.float32), parameters[key]) for key, (_, gradient) in terms.items()}
    if estimate.preconditioned:
        added = problem.coordinates.pull_back(added, problem.coordinates.slopes(parameters))
    capabilities = tuple(
        _added(one, added, problem, parameters, estimate.preconditioned) for one in estimate.capabilities
    )
    return replace(
        estimate,
        loss=estimate.loss + sum(value for value, _ in terms.values()),
        gradient=_sum(estimate.gradient, added),
        capabilities=capabilities,
    )


def _keys(problem: Problem) -> list[str]:
    return [key for key, u in problem.unknowns.items() if u.regularizer is not None or u.prior is not None]


def _terms(problem: Problem, key: str, x: Array | np.ndarray) -> tuple[float, np.ndarray]:
    unknown, values = problem.unknowns[key], x if isinstance(x, np.ndarray) else arrays.numpy(x)
    value, gradient = 0.0, np.zeros(values.shape)
    if unknown.regularizer is not None:
        own, slope = unknown.regularizer.evaluate(values)
        value, gradient = value + own, gradient + slope
    if unknown.prior is not None:
        own, slope = unknown.prior.evaluate(values)
        scale = problem.prior_scales[key]
        value, gradient = value + scale * own, gradient + scale * slope
    return value, gradient


def _sum(gradient: Tree, added: Tree) -> Tree:
    return {key: g + added[key] if key in added else g for key, g in gradient.items()}


def _added(capability: Capability, added: Tree, problem: Problem, parameters: Tree, preconditioned: bool) -> Capability:
    """Return a capability of the data term as one of the total loss, in the coordinates of the estimate."""
    match capability:
        case FreshGradient(values):
            return FreshGradient(_sum(values, added))
        case Hessian(matrix):
            product, shape = _product(problem, parameters, preconditioned), parameters
            rows = [trees.ravel(product(trees.parts(row, shape))) for row in np.eye(len(arrays.numpy(matrix)))]
            return Hessian(arrays.numpy(matrix).astype(np.float64) + np.stack(rows))
        case HessianProduct(apply):
            product = _product(problem, parameters, preconditioned)

            def total(v: Tree) -> Tree:
                return _sum(apply(v), {key: arrays.like(x, v[key]) for key, x in product(v).items()})

            return HessianProduct(total)
        case LossFunction(evaluate):

            def penalties(points: np.ndarray) -> np.ndarray:
                return np.array([penalty(problem, trees.parts(point, parameters)) for point in points])

            smooth = PreconditionedPerturbations(problem, parameters) if preconditioned else None
            added_at = smooth.by_coordinates(penalties) if smooth else penalties
            return LossFunction(lambda points: evaluate(points) + added_at(points))
        case BlockEstimate(keys, estimate) if estimate is not None:
            own = {key: parameters[key] for key in keys}
            return BlockEstimate(keys, penalized(estimate, restricted(problem, keys), own))
    return capability


def _product(
    problem: Problem, parameters: Tree, preconditioned: bool
) -> Callable[[Mapping[str, Array | np.ndarray]], dict[str, np.ndarray]]:
    """Return a function from v to the product of the priors' Hessian with v, with respect to the parameters, or to the coordinates of a
    preconditioned estimate."""
    unknowns, coordinates = problem.unknowns, problem.coordinates
    points = {key: arrays.numpy(x) for key, x in parameters.items()}

    def product(v: Mapping[str, Array | np.ndarray]) -> dict[str, np.ndarray]:
        products = {}
        for key, x in v.items():
            values, prior = x if isinstance(x, np.ndarray) else arrays.numpy(x), unknowns[key].prior
            products[key] = np.zeros(points[key].shape)
            if prior is not None:
                products[key] += problem.prior_scales[key] * prior.product(points[key], values)
        return products

    if not preconditioned:
        return product
    slopes, curvatures = coordinates.slopes(points), coordinates.curvatures(points)

    def product_by_coordinates(v: Mapping[str, Array | np.ndarray]) -> dict[str, np.ndarray]:
        moved = {
            key: np.asarray(x if isinstance(x, np.ndarray) else arrays.numpy(x), np.float32) for key, x in v.items()
        }
        products = product(coordinates.push_forward(moved, slopes))
        result = coordinates.pull_back({key: x.astype(np.float32) for key, x in products.items()}, slopes)
        for key, bend in curvatures.items():
            result[key] = result[key] + _terms(problem, key, points[key])[1] * bend * moved[key]
        return result

    return product_by_coordinates
