"""Derivatives of any function that can be evaluated, smoothed by a Gaussian: gradients, Hessians, Hessian-vector products.

    value, error = ur.smoothed.gradient(f, theta, sigma=0.1, samples=256)

`f` maps a batch of points (B, n) to values (B,) and is never differentiated: it may have plateaus, discontinuities and noise. The
result is a derivative of its convolution S f with a Gaussian of standard deviation σ (a number, or one per dimension), estimated
without bias, and its standard error. See `statistics/gaussian.py` for the kernels and their sampling.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from unrender.core import checks
from unrender.estimators.smoothing.sampling import Function, SamplingOptions, SmoothedFunction
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
    """Estimate ∇ S f(θ) and its standard error, (n,) each.

    Args:
        f: (B, n) to (B,).
        theta: (n,).
        sigma: standard deviation of the smoothing, > 0: a number, or (n,).
        samples: number of evaluations of f: for all elements together with `aggregate`, for each element otherwise; at least 4, and at
            least 16 with `low_discrepancy`.
        seed: random seed of the perturbations.
        aggregate: sample from the mixture over all elements, so that each sample serves all; otherwise from each element's own kernel.
        antithetic: sample pairs z, −z: exact for functions with the parity of the kernel.
        baseline: subtract f(θ), at the cost of one evaluation, without `antithetic` (with which it cancels).
        low_discrepancy: use scrambled Sobol sequences; the standard error is then that of 8 scramblings.
        product: instead of `aggregate`, sample every dimension from its own gradient kernel at once, as Fischer and Ritschel 2023
            ("Plateau-reduced differentiable path tracing") do: one sample serves all elements, each with a weight of constant
            magnitude. Biased for n > 1: element i is smoothed by the Gaussian along i, and by the bimodal |z| φ(z) along
            the other dimensions.
        orthogonal: with `aggregate`, sample orthogonal directions in blocks of n, each a standard normal, instead of the mixture. Use
            it for many dimensions and about as many samples: n of them determine the full gradient of a linear f, up to their lengths.
            The standard error is then too large, since it assumes independent samples.

    Raises:
        InputError: σ not positive, shapes that do not match, values that are not finite.
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
    """Estimate ∇² S f(θ) and its standard error, (n, n) each, symmetric.

    The arguments are those of `gradient`. The kernels are even, so `baseline` reduces the variance of antithetic samples as well:
    without it, the value of f itself is noise.
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
    """Estimate ∇² S f(θ) v and its standard error, (n,) each, without a Hessian: the central difference of two gradients (Eq. 23).

    Both gradients use the same samples (common random numbers), so common terms of f at θ ± ε u cancel, where u is v scaled to one σ.
    The difference is biased: its error is ε² / 6 times the fourth derivative of S f in units of σ. If f is discontinuous, the variance
    decreases with 1 / ε, and ε = 0.3 or more is better than the default.

    Args:
        v: (n,), the direction; its length scales the product.
        epsilon: ε, displacement of θ to both sides along v, in units of σ, > 0.

    The other arguments are those of `gradient`; `samples` counts evaluations of both gradients.
    """
    options = SamplingOptions(
        samples, seed, aggregate, antithetic, low_discrepancy=low_discrepancy, orthogonal=orthogonal, epsilon=epsilon
    )
    return estimate_hvp(f, theta, v, sigma, options)


def estimate_gradient(f: Function, theta: Any, sigma: Any, options: SamplingOptions) -> tuple[np.ndarray, np.ndarray]:
    """Evaluate `gradient` with its options in one object."""
    function = SmoothedFunction("gradient", f, theta, sigma, options)
    offset = function.value_at_theta() if options.baseline and not options.antithetic else 0.0
    if options.product:
        z = function.draw(lambda _, u, __: gaussian.gradient_sample(u))
        return function.mean_and_error(
            -function.odd(z, offset)[:, None] * np.sign(z) * (gaussian.GRADIENT_MASS / function.sigma)
        )
    return _first_order(function, options.aggregate, lambda z: function.odd(z, offset))


def estimate_hessian(f: Function, theta: Any, sigma: Any, options: SamplingOptions) -> tuple[np.ndarray, np.ndarray]:
    """Evaluate `hessian` with its options in one object."""
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
    """Evaluate `hvp` with its options in one object."""
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
    """Result of `estimate_gradient_and_product`, where u is the direction v scaled to one σ.

    Attributes:
        gradient: ∇ S f(θ), (n,), with additional smoothing along v by ε σ.
        error: its standard error, (n,).
        product: ∇² S f(θ) v, (n,).
        draws: z, (B, n), in units of σ, without dropped ones.
        changes: for each, half the change of f(θ + σ z) − f(θ − σ z) as θ moves by u, (B,): zᵀ σ H u for a quadratic f.
    """

    gradient: np.ndarray
    error: np.ndarray
    product: np.ndarray
    draws: np.ndarray
    changes: np.ndarray


def estimate_gradient_and_product(
    f: Function, theta: Any, v: Any, sigma: Any, options: SamplingOptions
) -> GradientAndProduct:
    """Estimate ∇ S f(θ) and ∇² S f(θ) v from the same evaluations, in one call of f.

    They are the mean and the difference (Eq. 23) of the gradients at θ ± ε u, where u is v scaled to one σ, with the same samples. The
    gradient is therefore that of f with additional smoothing along v by ε σ. Samples are from the aggregate, and antithetic;
    `options.samples`, at least 4, counts all evaluations. For a single sample, the magnitude of the gradient replaces its standard error.
    """
    function = SmoothedFunction("gradient", f, theta, sigma, options)
    function.draws = max(options.samples // 4, 1)
    direction, length = function.direction(v)
    z, ratio = function.draw_aggregate(gaussian.gradient_mixture, gaussian.gradient_ratio)
    moved = options.epsilon / length * direction
    ahead, behind = function.odd_at(z, [function.theta + side * moved for side in (1, -1)])
    kernel = gaussian.gradient_kernel(z, function.sigma) / ratio[:, None]
    draws = (0.5 * (ahead + behind))[:, None] * kernel
    gradient, error = function.mean_and_error(draws) if len(z) > 1 else (draws[0], np.abs(draws[0]))
    difference = (ahead - behind) / (2 * options.epsilon)
    known = np.isfinite(difference)
    product = np.mean((difference * length)[known, None] * kernel[known], axis=0)
    return GradientAndProduct(gradient, error, product, z[known], -difference[known])


def _first_order(
    function: SmoothedFunction, aggregate: bool, values_at: Callable[[np.ndarray], np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """Return the mean of the gradient kernel times `values_at(z)`, (n,), and its standard error."""
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


def joint(
    f: Function,
    theta: Any,
    sigma: Any,
    samples: int,
    seed: int = 0,
    low_discrepancy: bool = False,
    orthogonal: bool = False,
) -> JointDerivatives:
    """Estimate gradient, Hessian and its products from the same evaluations of f, at f(θ) and at `samples` points in antithetic pairs.

    The gradient comes from the difference of a pair, the Hessian from its mean minus f(θ) (`gaussian.gradient_kernel`,
    `gaussian.hessian_kernel`). Samples are from the mixture of both aggregates, half each, weighted by its density. Every derivative is
    therefore unbiased, and products with any number of vectors belong to one symmetric matrix, which is never formed.

    An isotropic quadratic is the control variate of the Hessian: its values are subtracted from the pairs' means, and its known Hessian
    is added. Each sample estimates the quadratic's curvature from all other samples, so there is no bias. Without it, the mean, which
    grows with the number of dimensions, would be noise in every element.

    The arguments are those of `smoothed.gradient`.
    """
    function = SmoothedFunction(
        "joint", f, theta, sigma, SamplingOptions(samples, seed, low_discrepancy=low_discrepancy, orthogonal=orthogonal)
    )
    z, ratio = function.draw_aggregate(gaussian.joint_mixture, gaussian.joint_ratio)
    behind, ahead = function.pairs(z)
    center = function.value_at_theta()
    second_difference, square = 0.5 * (behind + ahead) - center, np.sum(z * z, axis=1)
    # Curvature from the other draws. The n in the denominator adds a draw of no curvature, which keeps it finite.
    curvature = 2 * function.leave_one_out_sum(second_difference) / (function.leave_one_out_sum(square) + function.n)
    odd, even = 0.5 * (behind - ahead) / ratio, (second_difference - 0.5 * curvature * square) / ratio
    return JointDerivatives(function, z, center, odd, even, curvature, 2 * second_difference)


class JointDerivatives:
    """Derivatives from the samples of `joint`, each with its standard error.

    Attributes:
        value: f(θ), not smoothed.
        draws: z, (B, n), in units of σ, without dropped ones.
        curvatures: for each, f(θ + σ z) + f(θ − σ z) − 2 f(θ), (B,): zᵀ (σ H σ) z for a quadratic f.
    """

    def __init__(
        self,
        function: SmoothedFunction,
        z: np.ndarray,
        value: float,
        odd: np.ndarray,
        even: np.ndarray,
        curvature: np.ndarray,
        curvatures: np.ndarray,
    ):
        """Store the samples. `odd` and `even` (B,) weight the gradient and the Hessian kernel; `curvature` (B,) is that of the control
        variate."""
        known = np.isfinite(curvatures)
        self.value, self.draws, self.curvatures = value, z[known], curvatures[known]
        self._function, self._z, self._odd, self._even, self._curvature = function, z, odd, even, curvature

    def gradient(self) -> tuple[np.ndarray, np.ndarray]:
        """Return ∇ S f(θ), (n,), and its standard error."""
        kernel = gaussian.gradient_kernel(self._z, self._function.sigma)
        return self._function.mean_and_error(self._odd[:, None] * kernel)

    def hessian(self) -> tuple[np.ndarray, np.ndarray]:
        """Return ∇² S f(θ), (n, n), and its standard error."""
        kernel = gaussian.hessian_kernel(self._z, self._function.sigma)
        control_variate = self._curvature[:, None, None] * np.diag(1 / self._function.sigma**2)
        return self._function.mean_and_error(self._even[:, None, None] * kernel + control_variate)

    def hvp(self, v: Any) -> tuple[np.ndarray, np.ndarray]:
        """Return ∇² S f(θ) v, (n,), and its standard error, without evaluations, in O(samples n) time and memory."""
        direction, scaled = self._function.vector("v", v), self._z / self._function.sigma
        isotropic = direction / self._function.sigma**2
        products = scaled * (scaled @ direction)[:, None] - isotropic
        return self._function.mean_and_error(self._even[:, None] * products + self._curvature[:, None] * isotropic)
