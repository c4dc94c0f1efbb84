"""Draws from the smoothing kernels, evaluations of the function at them, and the mean with its standard error."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from unrender.core import checks
from unrender.core.dropped import DropReport
from unrender.core.errors import InputError
from unrender.estimators.smoothing.options import SamplingOptions

Function = Callable[[np.ndarray], np.ndarray]
"""(B, n) to (B,)."""

_REPLICATES = 8
"""Independent scramblings of a low-discrepancy sequence, over which its standard error is measured."""
_dropped = DropReport()
"""Perturbations of all functions of this process: a descent makes a `SmoothedFunction` at each step."""
_ORTHOGONAL = 1 << 20
"""The stream of random numbers of orthogonal draws."""


class SmoothedFunction:
    """f convolved with a Gaussian of standard deviation σ, at one point θ: checked arguments, draws, evaluations, statistics.

    Args:
        name: of the public function, for messages.
        f: (B, n) to (B,).
        theta: (n,), finite.
        sigma: > 0, a number or (n,).
        options: how to draw.
        sides: evaluations of f per sample point.

    Raises:
        InputError: σ not positive, shapes that do not fit, too few samples.
    """

    def __init__(self, name: str, f: Function, theta: Any, sigma: Any, options: SamplingOptions, sides: int = 1):
        self.owner, self.f, self.seed = f"smoothed.{name}", f, options.seed
        self.theta = np.array(theta, np.float64)
        if self.theta.ndim != 1 or self.theta.size == 0 or not np.isfinite(self.theta).all():
            raise InputError(f"{self.owner}: theta must be a finite vector (n,), got shape {self.theta.shape}")
        self.n = self.theta.size
        self.sigma = self.vector("sigma", sigma)
        if not (self.sigma > 0).all():
            raise InputError(f"{self.owner}: sigma must be above 0, got {sigma!r}")
        self.antithetic, self.low_discrepancy = options.antithetic, options.low_discrepancy
        self.orthogonal = options.orthogonal
        if self.orthogonal and (self.low_discrepancy or options.product or not options.aggregate):
            raise InputError(f"{self.owner}: orthogonal draws are of the aggregate, and of no sequence")
        least = 16 if self.low_discrepancy else 4
        per_draw = (2 if self.antithetic else 1) * sides
        self.draws = checks.integer(self.owner, "samples", options.samples, at_least=least * sides) // per_draw

    def vector(self, name: str, given: Any) -> np.ndarray:
        """A finite vector (n,) from a number or a vector."""
        found = np.array(given, np.float64)
        if found.shape not in ((), (self.n,)) or not np.isfinite(found).all():
            raise InputError(f"{self.owner}: {name} must be a finite number or a vector ({self.n},), got {given!r}")
        return np.broadcast_to(found, (self.n,)).copy()

    def direction(self, v: Any) -> tuple[np.ndarray, float]:
        """A direction (n,), and its length in units of σ."""
        found = self.vector("v", v)
        return found, float(np.sqrt(np.sum((found / self.sigma) ** 2)))

    def draw(self, sampler: Callable[..., np.ndarray], stream: int = 0) -> np.ndarray:
        """(draws, n): `sampler` of uniform choices (B,), uniform numbers (B, n) and standard normals (B, n)."""
        if not self.low_discrepancy:
            rng = np.random.default_rng([self.seed, stream])
            count = self.draws
            return sampler(
                rng.random(count), _open_interval(rng.random((count, self.n))), rng.standard_normal((count, self.n))
            )
        from scipy import special
        from scipy.stats import qmc  # takes a second to import

        parts = []
        for replicate in range(_REPLICATES):
            rng = np.random.default_rng([self.seed, stream, replicate])
            # SciPy warns of counts that are no power of 2, whose balance is slightly worse.
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", UserWarning)
                points = qmc.Sobol(self.n + 1, scramble=True, rng=rng).random(max(self.draws // _REPLICATES, 1))
            u = _open_interval(points[:, 1:])
            parts.append(sampler(points[:, 0], u, special.ndtri(u)))
        return np.concatenate(parts)

    def draw_aggregate(
        self, mixture: Callable[..., np.ndarray], ratio: Callable[[np.ndarray], np.ndarray]
    ) -> tuple[np.ndarray, np.ndarray]:
        """Draws z (B, n) that serve all elements, and their density over that of a standard normal, (B,).

        Of a mixture, or with `orthogonal` standard normals in blocks of n draws at most, whose directions are those of a uniformly random
        orthogonal matrix, each with a length of its own. Blocks are independent, draws within one are not: standard errors that take them
        for independent are too large.
        """
        if not self.orthogonal:
            z = self.draw(mixture)
            return z, ratio(z)
        rng = np.random.default_rng([self.seed, _ORTHOGONAL])
        blocks = []
        for first in range(0, self.draws, self.n):
            count = min(self.n, self.draws - first)
            basis, triangle = np.linalg.qr(rng.standard_normal((self.n, count)))
            # The signs of Householder's reflections are not random.
            signs = np.where(np.diagonal(triangle) < 0.0, -1.0, 1.0)
            lengths = np.sqrt(rng.chisquare(self.n, count))
            blocks.append((basis * (signs * lengths)).T)
        return np.concatenate(blocks), np.ones(self.draws)

    def odd(self, z: np.ndarray, offset: float) -> np.ndarray:
        """The factor of an odd kernel, (B,): f(θ − σ z), with antithetic draws half its difference to f(θ + σ z)."""
        return self.odd_at(z, [self.theta])[0] - (0.0 if self.antithetic else offset)

    def odd_at(self, z: np.ndarray, centers: Sequence[np.ndarray]) -> np.ndarray:
        """The same around each of C points (n,) in place of θ, (C, B), by one call of f."""
        signs = (-1, 1) if self.antithetic else (-1,)
        points = [center + sign * self.sigma * z for center in centers for sign in signs]
        values = self.evaluate(np.concatenate(points)).reshape(len(centers), len(signs), len(z))
        return 0.5 * (values[:, 0] - values[:, 1]) if self.antithetic else values[:, 0]

    def even(self, z: np.ndarray, offset: float) -> np.ndarray:
        """The factor of an even kernel, (B,): f(θ − σ z), with antithetic draws its mean with f(θ + σ z)."""
        if not self.antithetic:
            return self.evaluate(self.theta - self.sigma * z) - offset
        behind, ahead = self.pairs(z)
        return 0.5 * (behind + ahead) - offset

    def pairs(self, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """f(θ − σ z) and f(θ + σ z), (B,) each, by one call of f."""
        both = self.evaluate(np.concatenate([self.theta - self.sigma * z, self.theta + self.sigma * z]))
        return both[: len(z)], both[len(z) :]

    def leave_one_out_sum(self, values: np.ndarray) -> np.ndarray:
        """Per draw, the sum of `values` (B,) over all draws that are independent of it. Dropped draws, which are not finite, count 0."""
        values = np.where(np.isfinite(values), values, 0.0)
        if self.orthogonal:
            starts = np.arange(0, len(values), self.n)
            own = np.add.reduceat(values, starts)
            return np.repeat(values.sum() - own, np.diff(np.append(starts, len(values))))
        if not self.low_discrepancy:
            return values.sum() - values
        own = values.reshape(_REPLICATES, -1).sum(axis=1)
        return np.repeat(values.sum() - own, len(values) // _REPLICATES)

    def value_at_theta(self) -> float:
        """f(θ), not smoothed. Raises `InputError` where it is not finite."""
        return float(self.evaluate(self.theta[None])[0])

    def evaluate(self, points: np.ndarray) -> np.ndarray:
        """f at points (B, n), NaN where it is not finite: such perturbations are dropped, counted and reported.

        Raises `InputError` for values of another shape than (B,), or where none is finite.
        """
        values = np.asarray(self.f(points), np.float64)
        if values.shape != (len(points),):
            raise InputError(
                f"{self.owner}: f must return shape ({len(points)},) for {points.shape}, got {values.shape}"
            )
        finite = np.isfinite(values)
        if not finite.all():
            place = np.array2string(points[~finite][0], threshold=8, precision=4)
            if not finite.any():
                raise InputError(f"{self.owner}: f is not finite at {place}, nor at any other of {len(points)} points")
            _dropped.add(int((~finite).sum()), len(points), f"{self.owner}: f is not finite at {place}")
        return np.where(finite, values, np.nan)

    def mean_and_error(self, draws: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Mean over draws (B, ...) and its standard error; with low discrepancy, from the means of the scramblings.

        Draws that are not finite are left out. Raises `InputError` where fewer than two remain.
        """
        known = np.isfinite(draws.reshape(len(draws), -1)).all(axis=1)
        if self.low_discrepancy:
            parts = zip(np.split(draws, _REPLICATES), np.split(known, _REPLICATES), strict=True)
            draws = np.array([part[mask].mean(axis=0) for part, mask in parts if mask.any()])
        elif not known.all():
            draws = draws[known]
        if len(draws) < 2:
            raise InputError(
                f"{self.owner}: f is finite at fewer than two perturbations; take more samples or a smaller σ"
            )
        return draws.mean(axis=0), draws.std(axis=0, ddof=1) / np.sqrt(len(draws))


def _open_interval(u: np.ndarray) -> np.ndarray:
    """Uniform numbers clipped away from 0 and 1."""
    return np.clip(u, 2.0**-53, 1 - 2.0**-53)
