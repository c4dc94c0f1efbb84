"""Options of a smoothed derivative, sampling of the kernels, evaluation of the function, and the mean with its standard error."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from unrender.core import checks
from unrender.core.checks import DropReport
from unrender.core.errors import InputError
from unrender.core.text import in_words


@dataclass(frozen=True)
class SamplingOptions:
    """Options of an estimate of a smoothed derivative, as in `smoothed.gradient` and `smoothed.hvp`."""

    samples: int
    seed: int = 0
    aggregate: bool = True
    antithetic: bool = True
    baseline: bool = True
    low_discrepancy: bool = False
    product: bool = False
    orthogonal: bool = False
    epsilon: float = 0.1


Function = Callable[[np.ndarray], np.ndarray]
"""Function from points (B, n) to values (B,)."""

_REPLICATES = 8  # number of independent scramblings of a low-discrepancy sequence, which give its standard error
_dropped = DropReport()
"""Dropped perturbations of all functions of this process, since each step creates a `SmoothedFunction`."""
_ORTHOGONAL = 1 << 20  # stream of random numbers for orthogonal samples


def numbers(values: Any, expected: str) -> np.ndarray:
    """Return a new array of float64. Raises `InputError` that begins with `expected` for anything but numbers."""
    try:
        if np.iscomplexobj(values):  # NumPy would drop the imaginary parts
            raise TypeError
        return np.array(values, np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        raise InputError(f"{expected}, got {in_words(values)}") from error


class SmoothedFunction:
    """f convolved with a Gaussian of standard deviation σ, at one point θ: validation, sampling, evaluation, statistics.

    Args:
        name: name of the public function, for messages.
        f: (B, n) to (B,).
        theta: (n,), finite.
        sigma: > 0, a number or (n,).
        sides: evaluations of f per sample point.

    Raises:
        InputError: σ not positive, shapes that do not match, too few samples.
    """

    def __init__(self, name: str, f: Function, theta: Any, sigma: Any, options: SamplingOptions, sides: int = 1):
        self.owner, self.f = f"smoothed.{name}", f
        if not callable(f):
            raise InputError(f"{self.owner}: f must be a function of points (B, n), got {in_words(f)}")
        self.seed = checks.integer(self.owner, "seed", options.seed, 0, (1 << 63) - 1)
        self.theta = numbers(theta, f"{self.owner}: theta must be a finite vector (n,)")
        if self.theta.ndim != 1 or self.theta.size == 0 or not np.isfinite(self.theta).all():
            raise InputError(f"{self.owner}: theta must be a finite vector (n,), got shape {self.theta.shape}")
        self.n = self.theta.size
        self.sigma = self.vector("sigma", sigma)
        if not (self.sigma > 0).all():
            raise InputError(f"{self.owner}: sigma must be above 0, got {in_words(sigma)}")
        self.antithetic, self.low_discrepancy = options.antithetic, options.low_discrepancy
        self.orthogonal = options.orthogonal
        if self.orthogonal and (self.low_discrepancy or options.product or not options.aggregate):
            raise InputError(f"{self.owner}: orthogonal requires aggregate, and neither low_discrepancy nor product")
        least = 16 if self.low_discrepancy else 4
        per_draw = (2 if self.antithetic else 1) * sides
        self.draws = checks.integer(self.owner, "samples", options.samples, at_least=least * sides) // per_draw

    def vector(self, name: str, value: Any) -> np.ndarray:
        """Return a finite vector (n,) from a number or a vector."""
        expected = f"{self.owner}: {name} must be a finite number or a vector ({self.n},)"
        array = numbers(value, expected)
        if array.shape not in ((), (self.n,)) or not np.isfinite(array).all():
            raise InputError(f"{expected}, got {in_words(value)}")
        return np.broadcast_to(array, (self.n,)).copy()

    def direction(self, v: Any) -> tuple[np.ndarray, float]:
        """Return a direction (n,), and its length in units of σ."""
        vector = self.vector("v", v)
        return vector, float(np.sqrt(np.sum((vector / self.sigma) ** 2)))

    def draw(self, sampler: Callable[..., np.ndarray], stream: int = 0) -> np.ndarray:
        """Return samples (draws, n): `sampler` applied to uniform choices (B,), uniform numbers (B, n) and standard normals (B, n)."""
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
        """Return samples z (B, n) that serve all elements, and their density over that of a standard normal, (B,).

        They are from a mixture or, with `orthogonal`, standard normals in blocks of at most n, whose directions are those of a
        uniformly random orthogonal matrix, with independent lengths. Blocks are independent, samples within one are not. Standard
        errors that assume independence are then too large.
        """
        if not self.orthogonal:
            z = self.draw(mixture)
            return z, ratio(z)
        rng = np.random.default_rng([self.seed, _ORTHOGONAL])
        blocks = []
        for first in range(0, self.draws, self.n):
            count = min(self.n, self.draws - first)
            basis, triangle = np.linalg.qr(rng.standard_normal((self.n, count)))
            # Randomise signs, since those of Householder reflections are deterministic.
            signs = np.where(np.diagonal(triangle) < 0.0, -1.0, 1.0)
            lengths = np.sqrt(rng.chisquare(self.n, count))
            blocks.append((basis * (signs * lengths)).T)
        return np.concatenate(blocks), np.ones(self.draws)

    def odd(self, z: np.ndarray, offset: float) -> np.ndarray:
        """Return the factor of an odd kernel, (B,): f(θ − σ z), with antithetic samples half its difference from f(θ + σ z)."""
        return self.odd_at(z, [self.theta])[0] - (0.0 if self.antithetic else offset)

    def odd_at(self, z: np.ndarray, centers: Sequence[np.ndarray]) -> np.ndarray:
        """Return the same around each of C points (n,) instead of θ, (C, B), by one call of f."""
        signs = (-1, 1) if self.antithetic else (-1,)
        points = [center + sign * self.sigma * z for center in centers for sign in signs]
        values = self.evaluate(np.concatenate(points)).reshape(len(centers), len(signs), len(z))
        return 0.5 * (values[:, 0] - values[:, 1]) if self.antithetic else values[:, 0]

    def even(self, z: np.ndarray, offset: float) -> np.ndarray:
        """Return the factor of an even kernel, (B,): f(θ − σ z), with antithetic samples its mean with f(θ + σ z)."""
        if not self.antithetic:
            return self.evaluate(self.theta - self.sigma * z) - offset
        behind, ahead = self.pairs(z)
        return 0.5 * (behind + ahead) - offset

    def pairs(self, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return f(θ − σ z) and f(θ + σ z), (B,) each, by one call of f."""
        both = self.evaluate(np.concatenate([self.theta - self.sigma * z, self.theta + self.sigma * z]))
        return both[: len(z)], both[len(z) :]

    def leave_one_out_sum(self, values: np.ndarray) -> np.ndarray:
        """Return, per sample, the sum of `values` (B,) over all samples that are independent of it. Dropped samples, which are not
        finite, count 0."""
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
        """Return f(θ), not smoothed. Raise `InputError` if it is not finite."""
        return float(self.evaluate(self.theta[None])[0])

    def evaluate(self, points: np.ndarray) -> np.ndarray:
        """Return f at points (B, n), NaN where it is not finite: such perturbations are dropped, counted and reported.

        Raises `InputError` for values of another shape than (B,), or if none is finite.
        """
        values = numbers(self.f(points), f"{self.owner}: f must return numbers")
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
        """Return the mean over samples (B, ...) and its standard error; with low discrepancy, from the means of the scramblings.

        Samples that are not finite are omitted. Raises `InputError` if fewer than two remain.
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
    return np.clip(u, 2.0**-53, 1 - 2.0**-53)
