"""Gradient, Hessian and Hessian-vector products of a smoothed function from the same evaluations."""

from __future__ import annotations

from typing import Any

import numpy as np

from unrender.estimators.smoothing.options import SamplingOptions
from unrender.estimators.smoothing.sampling import Function, SmoothedFunction
from unrender.statistics import gaussian


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
