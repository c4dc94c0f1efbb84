"""Derivatives of any function that can be evaluated, smoothed by a Gaussian: gradients, Hessians, Hessian-vector products.

    value, error = ur.smoothed.gradient(f, theta, sigma=0.1, samples=256)

`f` takes a batch of points (B, n) to values (B,) and is never differentiated: it may have plateaus, jumps, noise. What is returned is a
derivative of its convolution S f with a Gaussian of standard deviation σ (a number, or one per dimension), estimated without bias,
and its standard error. See `statistics/gaussian.py` for the kernels and how they are sampled.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
from scipy import special
from scipy.stats import qmc

from unrender.core import checks
from unrender.core.errors import InputError
from unrender.statistics import gaussian

Function = Callable[[np.ndarray], np.ndarray]
"""(B, n) to (B,)."""

_REPLICATES = 8
"""Independent scramblings of a low-discrepancy sequence: what its standard error is measured from."""


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

    Raises:
        InputError: σ not positive, shapes that do not fit, values that are not finite.
    """
    job = _Job("gradient", f, theta, sigma, samples, seed, antithetic, low_discrepancy)
    offset = job.value_at_theta() if baseline and not antithetic else 0.0
    if product:
        z = job.draw(lambda _, u, __: gaussian.gradient_sample(u))
        return job.summarise(-job.odd(z, offset)[:, None] * np.sign(z) * (gaussian.GRADIENT_MASS / job.sigma))
    return _first_order(job, aggregate, lambda z: job.odd(z, offset))


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
) -> tuple[np.ndarray, np.ndarray]:
    """∇² S f(θ) and its standard error, (n, n) each, symmetric.

    The arguments are those of `gradient`. The kernels are even, so `baseline` helps antithetic draws as well: without it the value of f
    itself is noise.
    """
    job = _Job("hessian", f, theta, sigma, samples, seed, antithetic, low_discrepancy)
    offset = job.value_at_theta() if baseline else 0.0
    if aggregate:
        z = job.draw(gaussian.hessian_mixture)
        weight = gaussian.hessian_kernel(z, job.sigma) / gaussian.hessian_ratio(z)[:, None, None]
        return job.summarise(job.even(z, offset)[:, None, None] * weight)
    values, errors = np.empty((job.n, job.n)), np.empty((job.n, job.n))
    for i in range(job.n):
        for j in range(i, job.n):
            if i == j:
                z = job.draw(
                    lambda _, u, normal, i=i: _with(normal, i, gaussian.curvature_sample(u[:, i])), stream=i * job.n + j
                )
                weight = np.sign(z[:, i] ** 2 - 1) * gaussian.CURVATURE_MASS / job.sigma[i] ** 2
            else:
                z = job.draw(
                    lambda _, u, normal, i=i, j=j: _with(
                        _with(normal, i, gaussian.gradient_sample(u[:, i])), j, gaussian.gradient_sample(u[:, j])
                    ),
                    stream=i * job.n + j,
                )
                weight = np.sign(z[:, i] * z[:, j]) * gaussian.GRADIENT_MASS**2 / (job.sigma[i] * job.sigma[j])
            values[i, j], errors[i, j] = job.summarise(job.even(z, offset) * weight)
            values[j, i], errors[j, i] = values[i, j], errors[i, j]
    return values, errors


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
    job = _Job("hvp", f, theta, sigma, samples, seed, antithetic, low_discrepancy, sides=2)
    direction = job.vector("v", v)
    length = float(np.sqrt(np.sum((direction / job.sigma) ** 2)))
    step = checks.number("smoothed.hvp", "epsilon", epsilon, above=0.0)
    if length == 0.0:
        return np.zeros(job.n), np.zeros(job.n)
    step /= length

    def difference(z: np.ndarray) -> np.ndarray:
        ahead, behind = (job.odd(z, 0.0, job.theta + side * step * direction) for side in (1, -1))
        return (ahead - behind) / (2 * step)

    return _first_order(job, aggregate, difference)


def together(
    f: Function,
    theta: Any,
    sigma: Any,
    samples: int,
    seed: int = 0,
    low_discrepancy: bool = False,
) -> JointDerivatives:
    """Gradient, Hessian and its products from the same evaluations of f, at f(θ) and at `samples` points in antithetic pairs.

    The difference of a pair tells of the gradient, its mean less f(θ) of the Hessian (`gaussian.gradient_kernel`,
    `gaussian.hessian_kernel`). Draws are from the mixture of both aggregates, half of each, whose density weighs them all; so every
    derivative is unbiased, and products with any number of vectors are of one symmetric matrix, which is never built.

    What a pair's mean has in common with a bowl of the same curvature all round is taken out of it, and that bowl's own Hessian, which is
    known, put back: a control variate, whose factor each draw takes from all others. Without it the mean's size, which grows with the
    number of dimensions, would be noise in every element.

    The arguments are those of `gradient`.
    """
    job = _Job("together", f, theta, sigma, samples, seed, True, low_discrepancy)

    z = job.draw(gaussian.joint_mixture)
    behind, ahead = job.pairs(z)
    offset = job.value_at_theta()
    ratio = gaussian.joint_ratio(z)
    bend, square = 0.5 * (behind + ahead) - offset, np.sum(z * z, axis=1)
    # The others' own curvature, kept finite by one more draw's worth of none.
    bowl = 2 * job.others(bend) / (job.others(square) + job.n)
    odd, even = 0.5 * (behind - ahead) / ratio, (bend - 0.5 * bowl * square) / ratio
    return JointDerivatives(job, z, offset, odd, even, bowl)


class JointDerivatives:
    """What `together` found; each derivative with its standard error.

    Attributes:
        value: f(θ), not smoothed.
    """

    def __init__(self, job: _Job, z: np.ndarray, value: float, odd: np.ndarray, even: np.ndarray, bowl: np.ndarray):
        self.value = value
        self._job, self._z, self._odd, self._even, self._bowl = job, z, odd, even, bowl

    def gradient(self) -> tuple[np.ndarray, np.ndarray]:
        """∇ S f(θ), (n,), and its standard error."""
        return self._job.summarise(self._odd[:, None] * gaussian.gradient_kernel(self._z, self._job.sigma))

    def hessian(self) -> tuple[np.ndarray, np.ndarray]:
        """∇² S f(θ), (n, n), and its standard error."""
        kernel = gaussian.hessian_kernel(self._z, self._job.sigma)
        bowl = self._bowl[:, None, None] * np.diag(1 / self._job.sigma**2)
        return self._job.summarise(self._even[:, None, None] * kernel + bowl)

    def hvp(self, v: Any) -> tuple[np.ndarray, np.ndarray]:
        """∇² S f(θ) v, (n,), and its standard error: no evaluation, O(samples n) time and memory."""
        direction, scaled = self._job.vector("v", v), self._z / self._job.sigma
        round_part = direction / self._job.sigma**2
        products = scaled * (scaled @ direction)[:, None] - round_part
        return self._job.summarise(self._even[:, None] * products + self._bowl[:, None] * round_part)


def _first_order(
    job: _Job, aggregate: bool, values_at: Callable[[np.ndarray], np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """The gradient kernel's mean of `values_at(z)` over its draws, (n,), and its standard error."""
    if aggregate:
        z = job.draw(gaussian.gradient_mixture)
        weight = gaussian.gradient_kernel(z, job.sigma) / gaussian.gradient_ratio(z)[:, None]
        return job.summarise(values_at(z)[:, None] * weight)
    values, errors = np.empty(job.n), np.empty(job.n)
    for i in range(job.n):
        z = job.draw(lambda _, u, normal, i=i: _with(normal, i, gaussian.gradient_sample(u[:, i])), stream=i)
        weight = -np.sign(z[:, i]) * gaussian.GRADIENT_MASS / job.sigma[i]
        values[i], errors[i] = job.summarise(values_at(z) * weight)
    return values, errors


def _with(normal: np.ndarray, column: int, values: np.ndarray) -> np.ndarray:
    z = normal.copy()
    z[:, column] = values
    return z


class _Job:
    """One call: its checked arguments, its draws, its evaluations of f, its statistics."""

    def __init__(
        self,
        name: str,
        f: Function,
        theta: Any,
        sigma: Any,
        samples: int,
        seed: int,
        antithetic: bool,
        low_discrepancy: bool,
        sides: int = 1,
    ):
        self.owner, self.f, self.seed = f"smoothed.{name}", f, seed
        self.theta = np.array(theta, np.float64)
        if self.theta.ndim != 1 or self.theta.size == 0 or not np.isfinite(self.theta).all():
            raise InputError(f"{self.owner}: theta must be a finite vector (n,), got shape {self.theta.shape}")
        self.n = self.theta.size
        self.sigma = self.vector("sigma", sigma)
        if not (self.sigma > 0).all():
            raise InputError(f"{self.owner}: sigma must be above 0, got {sigma!r}")
        self.antithetic, self.low_discrepancy = antithetic, low_discrepancy
        least = 16 if low_discrepancy else 4
        per_draw = (2 if antithetic else 1) * sides
        self.draws = checks.integer(self.owner, "samples", samples, at_least=least * sides) // per_draw

    def vector(self, name: str, given: Any) -> np.ndarray:
        """A finite vector (n,) from a number or a vector."""
        found = np.array(given, np.float64)
        if found.shape not in ((), (self.n,)) or not np.isfinite(found).all():
            raise InputError(f"{self.owner}: {name} must be a finite number or a vector ({self.n},), got {given!r}")
        return np.broadcast_to(found, (self.n,)).copy()

    def draw(self, sampler: Callable[..., np.ndarray], stream: int = 0) -> np.ndarray:
        """(draws, n): `sampler` of uniform choices (B,), uniform numbers (B, n) and standard normals (B, n)."""
        if not self.low_discrepancy:
            rng = np.random.default_rng([self.seed, stream])
            count = self.draws
            return sampler(
                rng.random(count), _inside(rng.random((count, self.n))), rng.standard_normal((count, self.n))
            )
        parts = []
        for replicate in range(_REPLICATES):
            rng = np.random.default_rng([self.seed, stream, replicate])
            # Of counts that are no power of 2, whose balance is less good, and good enough.
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", UserWarning)
                points = qmc.Sobol(self.n + 1, scramble=True, rng=rng).random(max(self.draws // _REPLICATES, 1))
            u = _inside(points[:, 1:])
            parts.append(sampler(points[:, 0], u, special.ndtri(u)))
        return np.concatenate(parts)

    def odd(self, z: np.ndarray, offset: float, theta: np.ndarray | None = None) -> np.ndarray:
        """f(θ − σ z), or with antithetic draws half its difference to f(θ + σ z): what an odd kernel weighs."""
        centre = self.theta if theta is None else theta
        if not self.antithetic:
            return self.evaluate(centre - self.sigma * z) - offset
        behind, ahead = self.pairs(z, centre)
        return 0.5 * (behind - ahead)

    def even(self, z: np.ndarray, offset: float) -> np.ndarray:
        """f(θ − σ z), or with antithetic draws its mean with f(θ + σ z): what an even kernel weighs."""
        if not self.antithetic:
            return self.evaluate(self.theta - self.sigma * z) - offset
        behind, ahead = self.pairs(z)
        return 0.5 * (behind + ahead) - offset

    def pairs(self, z: np.ndarray, theta: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
        """f(θ − σ z) and f(θ + σ z), (B,) each, by one call of f."""
        centre = self.theta if theta is None else theta
        both = self.evaluate(np.concatenate([centre - self.sigma * z, centre + self.sigma * z]))
        return both[: len(z)], both[len(z) :]

    def others(self, values: np.ndarray) -> np.ndarray:
        """Per draw, the sum of `values` (B,) over all draws that are independent of it."""
        if not self.low_discrepancy:
            return values.sum() - values
        own = values.reshape(_REPLICATES, -1).sum(axis=1)
        return np.repeat(values.sum() - own, len(values) // _REPLICATES)

    def value_at_theta(self) -> float:
        return float(self.evaluate(self.theta[None])[0])

    def evaluate(self, points: np.ndarray) -> np.ndarray:
        """f at points (B, n), checked."""
        values = np.asarray(self.f(points), np.float64)
        if values.shape != (len(points),):
            raise InputError(
                f"{self.owner}: f must return shape ({len(points)},) for {points.shape}, got {values.shape}"
            )
        if not np.isfinite(values).all():
            worst = points[~np.isfinite(values)][0]
            raise InputError(f"{self.owner}: f is not finite at {np.array2string(worst, threshold=8, precision=4)}")
        return values

    def summarise(self, draws: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Mean over draws and its standard error; with low discrepancy, from the means of the scramblings."""
        if self.low_discrepancy:
            draws = draws.reshape(_REPLICATES, -1, *draws.shape[1:]).mean(axis=1)
        return draws.mean(axis=0), draws.std(axis=0, ddof=1) / np.sqrt(len(draws))


def _inside(u: np.ndarray) -> np.ndarray:
    """Uniform numbers kept off 0 and 1."""
    return np.clip(u, 2.0**-53, 1 - 2.0**-53)
