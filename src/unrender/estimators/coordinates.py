"""Change of variables from the parameters to the optimizer's coordinates: of an estimate, and of Gaussian perturbations."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from unrender.core import arrays, periodic, trees
from unrender.core.arrays import Array
from unrender.core.errors import InputError
from unrender.core.trees import Tree
from unrender.estimators.base import Estimate
from unrender.estimators.capabilities import (
    AtBounds,
    BlockEstimate,
    Capability,
    FreshGradient,
    GradientNoise,
    Hessian,
    HessianNoise,
    HessianProduct,
    LossFunction,
    NoiseSample,
    ScoreCovariance,
    Smoothing,
    Variance,
)
from unrender.parameterisations import Transform
from unrender.preconditioners.base import HeldElements, Preconditioner
from unrender.scene.problem import Problem


def by_coordinates(estimate: Estimate, problem: Problem, parameters: Tree, free: Tree | None = None) -> Estimate:
    """Return the estimate with respect to v, where x = φ(u) and u = S v (`problem.coordinates`); unchanged if it already is.

    J is the diagonal matrix of φ'. Gradients become S J g, variances J² Var (a variance per element cannot be mapped by S). Second
    derivatives are exact, J H J + diag(g φ''), and the loss becomes a function of u. The σ of smoothed derivatives refers to x and is
    converted for each element of u, see `_width`. `AtBounds` is added. `free`: see `Coordinates.moved`.
    """
    if estimate.preconditioned:  # by an estimator with a state in these coordinates
        return _bounded(estimate, problem, parameters)
    coordinates = problem.coordinates
    slopes = coordinates.slopes(parameters)

    def converted(capability: Capability) -> Capability:
        if isinstance(capability, BlockEstimate):
            return _block(capability, problem, parameters)
        if isinstance(capability, (FreshGradient, NoiseSample)):
            return replace(capability, values=coordinates.pull_back(capability.values, slopes, free))
        return _second_order(capability, estimate.gradient, problem, parameters, slopes) if slopes else capability

    gradient = coordinates.pull_back(estimate.gradient, slopes, free)
    capabilities = tuple(converted(capability) for capability in estimate.capabilities)
    mapped = replace(estimate, gradient=gradient, capabilities=capabilities, preconditioned=True)
    return _bounded(mapped, problem, parameters)


def bounded_with_preconditioner(problem: Problem) -> tuple[str, ...]:
    """Return the parameters with bounds and a preconditioner S, but without φ."""
    smooth, bent = problem.coordinates.preconditioners, problem.coordinates.transforms
    return tuple(key for key in smooth if key not in bent and problem.unknowns[key].bounds != (None, None))


def free_of_bounds(problem: Problem, parameters: Tree, mean: Tree, made: int) -> Tree:
    """Return {key: 0 for elements at a bound beyond which the loss falls, 1 for the others} of parameters with a preconditioner S.

    `mean`, `made`: see `AtBounds.held`.
    """
    keys, repeated = bounded_with_preconditioner(problem), problem.coordinates.repeated
    means = {k: periodic.repeat(mean[k], repeated.get(k, 0)) for k in keys if k in mean}  # columns without a gradient
    at = AtBounds(lambda: {key: problem.unknowns[key].sides(parameters[key]) for key in keys})
    ones = {key: arrays.zeros_like(parameters[key]) + 1.0 for key in keys}
    return {key: arrays.where(held, 0.0 * ones[key], ones[key]) for key, held in at.held(means, made).items()}


def with_held_elements(problem: Problem, free: Tree) -> Problem:
    """Return the problem with `HeldElements`: those where `free` is 0. Estimators with a state in the optimizer's coordinates use it."""
    if not free:
        return problem
    held = {key: HeldElements(problem.coordinates.preconditioners[key], x) for key, x in free.items()}
    unknowns = {k: replace(u, preconditioner=held[k]) if k in held else u for k, u in problem.unknowns.items()}
    made = problem.with_parts(unknowns=unknowns)
    vars(made).update({k: x for k, x in vars(problem).items() if k not in vars(made) and k != "coordinates"})  # cached
    return made


def restricted(problem: Problem, keys: Sequence[str]) -> Problem:
    """Return the problem with these unknowns only."""
    return problem.with_parts(unknowns={key: problem.unknowns[key] for key in keys})


def _bounded(estimate: Estimate, problem: Problem, parameters: Tree) -> Estimate:
    """Return the estimate with the bounds that parameters have reached, see `AtBounds`."""
    if estimate.get(AtBounds) is not None:
        return estimate

    def sides() -> Tree:
        smooth, unknowns = problem.coordinates.preconditioners, problem.unknowns
        return {k: arrays.zeros_like(x) if k in smooth else unknowns[k].sides(x) for k, x in parameters.items()}

    return replace(estimate, capabilities=(*estimate.capabilities, AtBounds(sides)))


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
            curved = {key: gradient[key] * x for key, x in problem.coordinates.curvatures(parameters).items()}
            J, term = _flat(slopes, parameters), _flat(curved, parameters, missing=0.0)
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


_ALONE = 0.1
"""Size of the perturbations of elements that stay at a bound, relative to those that are smoothed: enough for the sign of a gradient."""
_PROBES = 4  # number of samples that estimate the gain of S for white noise, within 5 percent for a thousand vertices


class PreconditionedPerturbations:
    """A function of the parameters as a function of v, where u = θ + S (v − θ), with the preconditioners S and the current parameters θ.

    A Gaussian of v with standard deviation σ moves u by σ S ε: neighbours move alike, by less than σ. `deviations` are those of v that
    move the elements of u by σ, in the root mean square over a parameter. Without preconditioners nothing changes.

    Args:
        problem: problem with the preconditioners.
        parameters: θ; they determine keys and shapes.

    Raises:
        InputError: there are both a preconditioner and a parameterisation, whose coordinates would conflict.
    """

    def __init__(self, problem: Problem, parameters: Tree):
        maps = problem.coordinates.preconditioners
        self._maps: Mapping[str, Preconditioner] = {key: maps[key] for key in parameters if key in maps}
        self._parameters, self._theta = parameters, trees.ravel(parameters)
        transformed = [key for key in problem.coordinates.transforms if key in parameters]
        if self._maps and transformed:
            smooth = next(iter(self._maps))
            raise InputError(
                f"SmoothedDerivatives: parameter {smooth} has a preconditioner and {transformed[0]} a parameterisation; leave out one"
            )

    def __bool__(self) -> bool:
        return bool(self._maps)

    def deviations(self, sigma: Mapping[str, float]) -> dict[str, float]:
        """Return {key: standard deviation of v} for {key: σ of u}: σ over the root mean square of S ε, from a few fixed samples of ε."""
        return {
            key: value / self._gain(key, arrays.shape(self._parameters[key])) if key in self._maps else value
            for key, value in sigma.items()
        }

    def by_coordinates(self, f: Callable[[np.ndarray], np.ndarray]) -> Callable[[np.ndarray], np.ndarray]:
        """Return f of u, (B, n) to (B,), as a function of v."""
        if not self._maps:
            return f
        return lambda points: f(self._to_u(points))

    def _to_u(self, points: np.ndarray) -> np.ndarray:
        """Return u at v, (B, n) each."""
        changes = trees.parts(points - self._theta, self._parameters)
        rows = [
            np.stack([self._smoothed(key, row) for row in rows]) if key in self._maps else rows
            for key, rows in changes.items()
        ]
        return self._theta + np.concatenate([part.reshape(len(points), -1) for part in rows], axis=1)

    def _gain(self, key: str, shape: tuple[int, ...]) -> float:
        draws = np.random.default_rng(0).standard_normal((_PROBES, *shape))
        return float(np.sqrt(np.mean([np.mean(self._smoothed(key, draw) ** 2) for draw in draws])))

    def _smoothed(self, key: str, x: Array) -> np.ndarray:
        """Return S x on the host, in double precision. Elements that stay at a bound are perturbed alone, which tells their gradients."""
        S, values = self._maps[key], np.asarray(x, np.float32)
        alone = _ALONE * (1.0 - arrays.numpy(S.free)) * values if isinstance(S, HeldElements) else 0.0
        return np.asarray(S.apply(values), np.float64) + alone
