"""Change of variables of an estimate: from derivatives with respect to the parameters to those with respect to the optimizer's."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from unrender.core import arrays, trees
from unrender.core.trees import Tree
from unrender.estimators.base import Estimate
from unrender.estimators.capabilities import (
    BlockEstimate,
    Capability,
    FreshGradient,
    GradientNoise,
    Hessian,
    HessianNoise,
    HessianProduct,
    LossFunction,
    ScoreCovariance,
    Smoothing,
    Variance,
)
from unrender.parameterisations.base import Transform
from unrender.scene.problem import Problem


def by_coordinates(estimate: Estimate, problem: Problem, parameters: Tree) -> Estimate:
    """Return the estimate with respect to v, where x = φ(u) and u = S v (`problem.coordinates`); itself if it already is.

    J is the diagonal matrix of φ'. Gradients become S J g, variances J² Var (a variance per element cannot be mapped by S). Second
    derivatives are exact, J H J + diag(g φ''), and the loss becomes a function of u. The σ of smoothed derivatives refers to x and is
    converted for each element of u, see `_width`.
    """
    if estimate.preconditioned:
        return estimate
    coordinates = problem.coordinates
    slopes = coordinates.slopes(parameters)

    def converted(capability: Capability) -> Capability:
        if isinstance(capability, BlockEstimate):
            return _block(capability, problem, parameters)
        if isinstance(capability, FreshGradient):
            return FreshGradient(coordinates.pull_back(capability.values, slopes))
        return _second_order(capability, estimate.gradient, problem, parameters, slopes) if slopes else capability

    gradient = coordinates.pull_back(estimate.gradient, slopes)
    capabilities = tuple(converted(capability) for capability in estimate.capabilities)
    return replace(estimate, gradient=gradient, capabilities=capabilities, preconditioned=True)


def restricted(problem: Problem, keys: Sequence[str]) -> Problem:
    """Return the problem with these unknowns only."""
    return problem.with_parts(unknowns={key: problem.unknowns[key] for key in keys})


def _block(block: BlockEstimate, problem: Problem, parameters: Tree) -> BlockEstimate:
    if block.estimate is None:
        return block
    own = {key: parameters[key] for key in block.keys}
    return BlockEstimate(block.keys, by_coordinates(block.estimate, restricted(problem, block.keys), own))


def _second_order(
    capability: Capability, gradient: Tree, problem: Problem, parameters: Tree, slopes: Tree
) -> Capability:
    """Convert a capability that is not linear in the gradient to u."""
    match capability:
        case Variance(values):
            return Variance({k: v * slopes[k] * slopes[k] if k in slopes else v for k, v in values.items()})
        case Hessian(matrix):
            J, term = _flat(slopes, parameters), _curvature_term(gradient, problem, parameters)
            full = J[:, None] * arrays.numpy(matrix).astype(np.float64) * J + np.diag(term)
            return Hessian(full)
        case GradientNoise(matrix) | HessianNoise(matrix) | ScoreCovariance(matrix):
            J = _flat(slopes, parameters)
            return replace(capability, matrix=J[:, None] * arrays.numpy(matrix).astype(np.float64) * J)
        case HessianProduct(apply):
            curvatures = problem.coordinates.curvatures(parameters)

            def product(v: Tree) -> Tree:
                values = apply({k: x * slopes[k] if k in slopes else x for k, x in v.items()})
                return {
                    k: x * slopes[k] + gradient[k] * curvatures[k] * v[k] if k in slopes else x
                    for k, x in values.items()
                }

            return HessianProduct(product)
        case LossFunction(evaluate):
            transforms = problem.coordinates.transforms

            def losses(points: np.ndarray) -> np.ndarray:
                split = trees.parts(points, parameters)
                values = [transforms[k].forward(u) if k in transforms else u for k, u in split.items()]
                return evaluate(np.concatenate([x.reshape(len(points), -1) for x in values], axis=1))

            return LossFunction(losses)
        case Smoothing(sigma):
            transforms = problem.coordinates.transforms
            return Smoothing(
                {
                    k: _width(transforms[k], arrays.numpy(parameters[k]), s) if k in transforms else s
                    for k, s in sigma.items()
                }
            )
    return capability


def _width(transform: Transform, x: np.ndarray, sigma: float | np.ndarray) -> np.ndarray:
    """Return σ of x as a standard deviation of u: σ / φ', with the maximum of φ' within σ, since φ' vanishes near a bound."""
    around = [np.asarray(transform.slope(at)) for at in (x, x + sigma, x - sigma)]
    return sigma / np.maximum.reduce(around)


def _flat(tree: Tree, parameters: Tree, missing: float = 1.0) -> np.ndarray:
    """Return all elements in key order, (n,), with `missing` for parameters that the tree does not have."""
    return np.concatenate(
        [
            arrays.numpy(tree[key]).astype(np.float64).ravel()
            if key in tree
            else np.full(int(np.prod(arrays.shape(x))), missing)
            for key, x in parameters.items()
        ]
    )


def _curvature_term(gradient: Tree, problem: Problem, parameters: Tree) -> np.ndarray:
    """Return g φ'', (n,)."""
    curvatures = problem.coordinates.curvatures(parameters)
    return _flat({key: gradient[key] * x for key, x in curvatures.items()}, parameters, missing=0.0)
