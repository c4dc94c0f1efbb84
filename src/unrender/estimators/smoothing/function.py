"""Derivatives of any function that can be evaluated, smoothed by a Gaussian: gradients, Hessians, Hessian-vector products.

    value, error = ur.smoothed.gradient(f, theta, sigma=0.1, samples=256)

`f` takes a batch of points (B, n) to values (B,) and is never differentiated: it may have plateaus, jumps, noise. What is returned is a
derivative of its convolution S f with a Gaussian of standard deviation σ (a number, or one per dimension), estimated without bias,
and its standard error. See `statistics/gaussian.py` for the kernels and how they are sampled.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from unrender.core import checks
from unrender.estimators.smoothing.options import SamplingOptions
from unrender.estimators.smoothing.sampling import Function, SmoothedFunction
from unrender.statistics import gaussian


def gradient(
    f: Function,
    theta: Any,
    sigma: Any,
    samples: int,
    seed: int = 0,
    aggregate: bool = True,
    antithetic: bool = True,
    baseline: bool = True,
    low_discrepancy: bool = False,
    product: bool = False,
    orthogonal: bool = False,
) -> tuple[np.ndarray, np.ndarray]:
    """∇ S f(θ) and its standard error, (n,) each.

    Args:
        f: (B, n) to (B,).
        theta: (n,).
        sigma: standard deviation of the smoothing, > 0: a number, or (n,).
        samples: how often f is evaluated, for all elements together with `aggregate`, for each of them without; at least 4, and at least
            16 with `low_discrepancy`.
        seed: of the draws.
        aggregate: draw from the mixture over all elements, each draw serving all; otherwise from each element's own kernel.
        antithetic: draw in pairs z, −z: exact for functions that are even or linear where they should be.
        baseline: subtract f(θ), at the cost of one evaluation, where the draws are not antithetic (there it cancels).
        low_discrepancy: draw from scrambled Sobol sequences; the standard error then is that of 8 scramblings.
        product: in place of `aggregate`, draw every dimension from its own gradient kernel at once, as Fischer and Ritschel 2023
            ("Plateau-reduced differentiable path tracing") do: one draw serves all elements, each with a constant magnitude of
            weight. Biased for n > 1: element i is smoothed by the Gaussian along i, and by |z| φ(z), which has two humps, along
            the other dimensions.
        orthogonal: draw directions that are orthogonal, in blocks of n, each a standard normal; in place of the mixture, with `aggregate`.
            For many dimensions and about as many draws: n of them tell the whole gradient of a linear f, up to their lengths. The standard
            error then is too large, since draws count as independent.

    Raises:
        InputError: σ not positive, shapes that do not fit, values that are not finite.
    """
    options = SamplingOptions(samples, seed, aggregate, antithetic, baseline, low_discrepancy, product, orthogonal)
    return estimate_gradient(f, theta, sigma, options)


def hessian(
    f: Function,
    theta: Any,
    sigma: Any,
    samples: int,
    seed: int = 0,
    aggregate: bool = True,
    antithetic: bool = True,
    baseline: bool = True,
    low_discrepancy: bool = False,
    orthogonal: bool = False,
) -> tuple[np.ndarray, np.ndarray]:
    """∇² S f(θ) and its standard error, (n, n) each, symmetric.

    The arguments are those of `gradient`. The kernels are even, so `baseline` helps antithetic draws as well: without it the value of f
    itself is noise.
    """
    options = SamplingOptions(samples, seed, aggregate, antithetic, baseline, low_discrepancy, orthogonal=orthogonal)
    return estimate_hessian(f, theta, sigma, options)


def hvp(
    f: Function,
    theta: Any,
    v: Any,
    sigma: Any,
    samples: int,
    seed: int = 0,
    aggregate: bool = True,
    antithetic: bool = True,
    low_discrepancy: bool = False,
    epsilon: float = 0.1,
    orthogonal: bool = False,
) -> tuple[np.ndarray, np.ndarray]:
    """∇² S f(θ) v and its standard error, (n,) each, without a Hessian: the central difference of two gradients (Eq. 23).

    Both gradients take the same draws (common random numbers), so that what f has in common at θ ± ε u cancels, where u is v scaled to
    one σ. Biased by the difference: its error is ε² / 6 times the fourth derivative of S f in units of σ. Where f jumps, the variance
    falls with 1 / ε, and 0.3 or more serves better than the default.

    Args:
        v: (n,), the direction; its length scales the product.
        epsilon: ε, how far θ moves to either side along v, in units of σ, > 0.

    The other arguments are those of `gradient`; `samples` counts evaluations of both gradients.
    """
    options = SamplingOptions(
        samples, seed, aggregate, antithetic, low_discrepancy=low_discrepancy, orthogonal=orthogonal, epsilon=epsilon
    )
    return estimate_hvp(f, theta, v, sigma, options)


def estimate_gradient(f: Function, theta: Any, sigma: Any, options: SamplingOptions) -> tuple[np.ndarray, np.ndarray]:
    """`gradient` with its options in one object."""
    function = SmoothedFunction("gradient", f, theta, sigma, options)
    offset = function.value_at_theta() if options.baseline and not options.antithetic else 0.0
    if options.product:
        z = function.draw(lambda _, u, __: gaussian.gradient_sample(u))
        return function.mean_and_error(
            -function.odd(z, offset)[:, None] * np.sign(z) * (gaussian.GRADIENT_MASS / function.sigma)
        )
    return _first_order(function, options.aggregate, lambda z: function.odd(z, offset))


def estimate_hessian(f: Function, theta: Any, sigma: Any, options: SamplingOptions) -> tuple[np.ndarray, np.ndarray]:
    """`hessian` with its options in one object."""
    function = SmoothedFunction("hessian", f, theta, sigma, options)
    offset = function.value_at_theta() if options.baseline else 0.0
    if options.aggregate:
        z, ratio = function.draw_aggregate(gaussian.hessian_mixture, gaussian.hessian_ratio)
        weight = gaussian.hessian_kernel(z, function.sigma) / ratio[:, None, None]
        return function.mean_and_error(function.even(z, offset)[:, None, None] * weight)
    values, errors = np.empty((function.n, function.n)), np.empty((function.n, function.n))
    for i in range(function.n):
        for j in range(i, function.n):
            if i == j:
                z = function.draw(
                    lambda _, u, normal, i=i: _with_column(normal, i, gaussian.curvature_sample(u[:, i])),
                    stream=i * function.n + j,
                )
                weight = np.sign(z[:, i] ** 2 - 1) * gaussian.CURVATURE_MASS / function.sigma[i] ** 2
            else:
                z = function.draw(
                    lambda _, u, normal, i=i, j=j: _with_column(
                        _with_column(normal, i, gaussian.gradient_sample(u[:, i])), j, gaussian.gradient_sample(u[:, j])
                    ),
                    stream=i * function.n + j,
                )
                weight = (
                    np.sign(z[:, i] * z[:, j]) * gaussian.GRADIENT_MASS**2 / (function.sigma[i] * function.sigma[j])
                )
            values[i, j], errors[i, j] = function.mean_and_error(function.even(z, offset) * weight)
            values[j, i], errors[j, i] = values[i, j], errors[i, j]
    return values, errors


def estimate_hvp(
    f: Function, theta: Any, v: Any, sigma: Any, options: SamplingOptions
) -> tuple[np.ndarray, np.ndarray]:
    """`hvp` with its options in one object."""
    function = SmoothedFunction("hvp", f, theta, sigma, options, sides=2)
    direction, length = function.direction(v)
    step = checks.number("smoothed.hvp", "epsilon", options.epsilon, above=0.0)
    if length == 0.0:
        return np.zeros(function.n), np.zeros(function.n)
    step /= length

    def difference(z: np.ndarray) -> np.ndarray:
        ahead, behind = function.odd_at(z, [function.theta + side * step * direction for side in (1, -1)])
        return (ahead - behind) / (2 * step)

    return _first_order(function, options.aggregate, difference)


@dataclass(frozen=True)
class GradientAndProduct:
    """Of `estimate_gradient_and_product`, with u the direction v scaled to one σ.

    Attributes:
        gradient: ∇ S f(θ), (n,), smoothed along v by ε σ more.
        error: its standard error, (n,).
        product: ∇² S f(θ) v, (n,).
        draws: z, (B, n), in units of σ, without dropped ones.
        changes: of each, half the change of f(θ + σ z) − f(θ − σ z) as θ moves by u, (B,): zᵀ σ H u where f is a quadratic.
    """

    gradient: np.ndarray
    error: np.ndarray
    product: np.ndarray
    draws: np.ndarray
    changes: np.ndarray


def estimate_gradient_and_product(
    f: Function, theta: Any, v: Any, sigma: Any, options: SamplingOptions
) -> GradientAndProduct:
    """∇ S f(θ) and ∇² S f(θ) v from the same evaluations, in one call of f.

    They are the mean and the difference (Eq. 23) of the gradients at θ ± ε u, u being v scaled to one σ, by the same draws. So the
    gradient is of f smoothed along v by ε σ more. Draws are of the aggregate, and antithetic; `options.samples`, at least 4, counts
    all evaluations. Of one draw alone, the magnitude of the gradient stands for its standard error.
    """
    function = SmoothedFunction("gradient", f, theta, sigma, options)
    function.draws = max(options.samples // 4, 1)
    direction, length = function.direction(v)
    z, ratio = function.draw_aggregate(gaussian.gradient_mixture, gaussian.gradient_ratio)
    moved = options.epsilon / length * direction
    ahead, behind = function.odd_at(z, [function.theta + side * moved for side in (1, -1)])
    kernel = gaussian.gradient_kernel(z, function.sigma) / ratio[:, None]
    draws = (0.5 * (ahead + behind))[:, None] * kernel
    found, error = function.mean_and_error(draws) if len(z) > 1 else (draws[0], np.abs(draws[0]))
    difference = (ahead - behind) / (2 * options.epsilon)
    known = np.isfinite(difference)
    product = np.mean((difference * length)[known, None] * kernel[known], axis=0)
    return GradientAndProduct(found, error, product, z[known], -difference[known])


def _first_order(
    function: SmoothedFunction, aggregate: bool, values_at: Callable[[np.ndarray], np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """The gradient kernel's mean of `values_at(z)` over its draws, (n,), and its standard error."""
    if aggregate:
        z, ratio = function.draw_aggregate(gaussian.gradient_mixture, gaussian.gradient_ratio)
        weight = gaussian.gradient_kernel(z, function.sigma) / ratio[:, None]
        return function.mean_and_error(values_at(z)[:, None] * weight)
    values, errors = np.empty(function.n), np.empty(function.n)
    for i in range(function.n):
        z = function.draw(
            lambda _, u, normal, i=i: _with_column(normal, i, gaussian.gradient_sample(u[:, i])), stream=i
        )
        weight = -np.sign(z[:, i]) * gaussian.GRADIENT_MASS / function.sigma[i]
        values[i], errors[i] = function.mean_and_error(values_at(z) * weight)
    return values, errors


def _with_column(normal: np.ndarray, column: int, values: np.ndarray) -> np.ndarray:
    z = normal.copy()
    z[:, column] = values
    return z
