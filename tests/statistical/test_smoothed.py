"""Smoothed derivatives against closed forms: within 3 standard errors, and with standard errors that are honest."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from scipy import stats

import unrender as ur
from tiers import quick

SIGMA = 0.6


class Case:
    """A function of n dimensions whose smoothed gradient and Hessian are known."""

    def __init__(self, n: int):
        rng = np.random.default_rng(n)
        self.n = n
        self.theta = rng.uniform(-0.5, 0.8, n)
        self.sigma = SIGMA * rng.uniform(0.7, 1.3, n)
        self.a = rng.normal(size=n) / np.sqrt(n)
        self.b = rng.normal(size=(n, n)) / n


class Polynomial(Case):
    """xᵀ B x + (a·x)³: a cubic gains 3 (aᵀ Σ a) a·x by smoothing."""

    def f(self, x: np.ndarray) -> np.ndarray:
        return np.einsum("bi,ij,bj->b", x, self.b, x) + (x @ self.a) ** 3

    def gradient(self) -> np.ndarray:
        spread = np.sum((self.a * self.sigma) ** 2)
        return (self.b + self.b.T) @ self.theta + 3 * self.a * ((self.theta @ self.a) ** 2 + spread)

    def hessian(self) -> np.ndarray:
        return self.b + self.b.T + 6 * np.outer(self.a, self.a) * (self.theta @ self.a)


class Sine(Case):
    """sin(a·x + 0.3), damped by exp(−aᵀ Σ a / 2)."""

    def f(self, x: np.ndarray) -> np.ndarray:
        return np.sin(x @ self.a + 0.3)

    def gradient(self) -> np.ndarray:
        return self.damping * np.cos(self.theta @ self.a + 0.3) * self.a

    def hessian(self) -> np.ndarray:
        return -self.damping * np.sin(self.theta @ self.a + 0.3) * np.outer(self.a, self.a)

    @property
    def damping(self) -> float:
        return float(np.exp(-0.5 * np.sum((self.a * self.sigma) ** 2)))


class Step(Case):
    """1 where a·x > 0.1, else 0: a normal distribution function once smoothed. Its own derivative is zero."""

    def f(self, x: np.ndarray) -> np.ndarray:
        return (x @ self.a > 0.1).astype(float)

    def gradient(self) -> np.ndarray:
        return stats.norm.pdf(self.t) / self.s * self.a

    def hessian(self) -> np.ndarray:
        return -self.t * stats.norm.pdf(self.t) / self.s**2 * np.outer(self.a, self.a)

    @property
    def s(self) -> float:
        return float(np.sqrt(np.sum((self.a * self.sigma) ** 2)))

    @property
    def t(self) -> float:
        return float((self.theta @ self.a - 0.1) / self.s)


CASES = [Polynomial, Sine, Step]
OPTIONS = [
    dict(zip(("aggregate", "antithetic", "low_discrepancy"), flags, strict=True))
    for flags in itertools.product([True, False], repeat=3)
]
V = np.random.default_rng(77).normal(size=10)


def estimate(
    case: Any, order: str, samples: int, seed: int, **options: bool
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(value, standard error, truth)."""
    if order == "hvp":
        v = V[: case.n]
        return *ur.smoothed.hvp(case.f, case.theta, v, case.sigma, samples, seed, **options), case.hessian() @ v
    call: Callable[..., Any] = getattr(ur.smoothed, order)
    return *call(case.f, case.theta, case.sigma, samples, seed, **options), getattr(case, order)()


@pytest.mark.parametrize("kind", CASES)
@pytest.mark.parametrize("n", quick([1, 2, 10], 2))
@pytest.mark.parametrize("order", ["gradient", "hessian", "hvp"])
def test_every_estimator_agrees_with_the_closed_form_within_its_standard_error(kind: Any, n: int, order: str) -> None:
    """All eight combinations of options; z scores corrected for their number."""
    case = kind(n)
    for number, options in enumerate(OPTIONS):
        value, error, truth = estimate(case, order, 4096, 10 + number, **options)
        bias = 0.01 * np.abs(truth).max() if order == "hvp" else 0.0  # of the central difference
        excess = np.maximum(np.abs(value - truth) - bias, 0)
        z = excess / np.maximum(error, 1e-12)
        # Antithetic pairs of a linear function have no error at all.
        freedom = 7 if options["low_discrepancy"] else 1000
        limit = stats.t.isf(1e-3 / (2 * z.size * len(OPTIONS)), freedom)
        assert (z < limit).all() or excess.max() < 1e-9, (options, z.max(), limit)


@pytest.mark.parametrize("kind", CASES)
@pytest.mark.parametrize("n", [1, 2, 10])
@pytest.mark.parametrize("low_discrepancy", [True, False])
def test_derivatives_from_the_same_evaluations_agree_with_the_closed_form(
    kind: Any, n: int, low_discrepancy: bool
) -> None:
    """Without the bias of a central difference; in few dimensions a tenth too much of the smooth cases' is seen."""
    case, counted = kind(n), [0]

    def f(x: np.ndarray) -> np.ndarray:
        counted[0] += len(x)
        return case.f(x)

    found = ur.smoothed.joint(f, case.theta, case.sigma, 16384, 3, low_discrepancy)
    v = V[:n]
    answers = (
        (found.gradient(), case.gradient()),
        (found.hessian(), case.hessian()),
        (found.hvp(v), case.hessian() @ v),
    )
    assert counted[0] == 16384 + 1
    worst = 0.0
    for (value, error), truth in answers:
        freedom = 7 if low_discrepancy else 1000
        limit = stats.t.isf(1e-3 / (2 * value.size * len(answers)), freedom)
        z = np.abs(value - truth) / np.maximum(error, 1e-12)
        assert (z < limit).all() or np.abs(value - truth).max() < 1e-9, (z.max(), limit)
        worst = max(worst, float((np.abs(1.1 * value - truth) / np.maximum(error, 1e-12)).max() / limit))
    if kind is not Step and n < 10:
        assert worst > 1, "a planted bias of 10 % went unseen"
    np.testing.assert_allclose(found.hessian()[0] @ v, found.hvp(v)[0], rtol=1e-9, atol=1e-12)


def test_standard_errors_of_derivatives_from_the_same_evaluations_are_honest() -> None:
    case = Sine(2)
    rows = []
    for seed in range(400):
        found = ur.smoothed.joint(case.f, case.theta, case.sigma, 256, seed)
        (g, g_error), (h, h_error) = found.gradient(), found.hvp(V[:2])
        rows.append([((g - case.gradient()) / g_error)[0], ((h - case.hessian() @ V[:2]) / h_error)[0]])
    z = np.array(rows)
    assert (np.abs(z.mean(0)) < 4 / np.sqrt(len(z))).all()
    assert (np.abs(z.var(0) - 1) < 5 * np.sqrt(2 / len(z))).all()


@pytest.mark.parametrize("order", ["gradient", "hessian", "hvp"])
@pytest.mark.parametrize("options", OPTIONS[:1] + OPTIONS[2:3] + OPTIONS[4:5], ids=str)
def test_standard_errors_are_honest(order: str, options: dict[str, bool]) -> None:
    """z scores over many seeds have mean 0 and variance 1 within test error."""
    case = Sine(2)
    rows = []
    for seed in range(400):
        value, error, truth = estimate(case, order, 256, seed, **{**options, "low_discrepancy": False})
        # Its target is the central difference itself, which a tenth of σ leaves within a part in a hundred.
        if order == "hvp":
            truth = truth * 0.998
        rows.append(((value - truth) / error).ravel()[0])
    z = np.array(rows)
    assert abs(z.mean()) < 4 / np.sqrt(len(z)) + (0.15 if order == "hvp" else 0)
    assert abs(z.var() - 1) < 5 * np.sqrt(2 / len(z))


def test_a_planted_fault_is_seen() -> None:
    case = Sine(2)
    value, error, truth = estimate(case, "gradient", 4096, 3)
    assert (np.abs(value - truth) < 4 * error).all()
    assert (np.abs(1.3 * value - truth) > 4 * error).any()


class Offset(Polynomial):
    """With a constant that no derivative sees and plain draws do."""

    def f(self, x: np.ndarray) -> np.ndarray:
        return super().f(x) + 10.0


def test_every_variance_cut_pays() -> None:
    """At equal evaluations. Antithetic pairs and the baseline both remove the constant; Sobol's points fill more evenly."""
    case = Offset(2)

    def variance(order: str, **options: bool) -> float:
        rows = [estimate(case, order, 256, seed, **options)[0] for seed in range(60)]
        return float(np.var(rows, axis=0).sum())

    bare = variance("gradient", antithetic=False, baseline=False)
    assert variance("gradient", antithetic=True, baseline=False) < 0.5 * bare
    assert variance("gradient", antithetic=False, baseline=True) < 0.5 * bare
    assert variance("gradient", low_discrepancy=True) < 0.7 * variance("gradient")
    assert variance("hessian", baseline=True) < 0.5 * variance("hessian", baseline=False)
    assert variance("hessian", low_discrepancy=True) < 0.7 * variance("hessian")


@pytest.mark.parametrize("low_discrepancy", [False, True])
def test_curvature_of_a_paraboloid_in_many_dimensions_is_not_lost_in_its_depth(low_discrepancy: bool) -> None:
    """Of a paraboloid nearly round, 60 dimensions from 64 pairs; the mean of a pair without control variate is 30 times as noisy."""
    n, sigma = 60, 0.5
    bend = np.linspace(0.9, 1.1, n)
    v = np.random.default_rng(0).standard_normal(n)
    errors, bare = [], []
    for seed in range(20):
        found = ur.smoothed.joint(lambda x: 0.5 * (x * x) @ bend, np.zeros(n), sigma, 128, seed, low_discrepancy)
        errors.append(found.hvp(v)[0] - bend * v)
        z = np.random.default_rng(seed).standard_normal((64, n))
        values = 0.5 * (sigma * z) ** 2 @ bend
        bare.append((values[:, None] * (z * (z @ v)[:, None] - v)).mean(0) / sigma**2 - bend * v)
    assert np.std(errors) < 0.2 * np.std(bare)
    assert np.std(errors) < 0.8 * np.std(bend * v)
    deviation = np.std(errors, axis=0) / np.sqrt(len(errors))
    assert (np.abs(np.mean(errors, axis=0)) < 5 * deviation).all()


@pytest.mark.parametrize("order", ["gradient", "hessian"])
def test_bad_input_is_one_line(order: str) -> None:
    call = getattr(ur.smoothed, order)
    f = Sine(2).f
    for arguments, message in [
        ((f, [0.0, 0.0], 0.0, 64), "sigma must be above 0"),
        ((f, [0.0, 0.0], [0.1, -0.1], 64), "sigma must be above 0"),
        ((f, [0.0, 0.0], [0.1, 0.1, 0.1], 64), "sigma must be a finite number or a vector"),
        ((f, 0.0, 0.1, 64), r"theta must be a finite vector"),
        ((f, [0.0, np.nan], 0.1, 64), r"theta must be a finite vector"),
        ((f, [0.0, 0.0], 0.1, 2), "samples must be a whole number of at least 4"),
        ((f, [0.0, 0.0], "a", 64), r"sigma must be a finite number or a vector \(2,\), got 'a'"),
        ((f, [0.0, 0.0], 0.1, 64, -1), "seed must be a whole number of at least 0, got -1"),
        ((3, [0.0, 0.0], 0.1, 64), r"f must be a function of points \(B, n\), got 3"),
        ((lambda x: x[:, 0] * 1j, [0.0, 0.0], 0.1, 64), "f must return numbers"),
        ((lambda x: x, [0.0, 0.0], 0.1, 64), r"f must return shape \(\d+,\)"),
        ((lambda x: x[:, 0] * np.nan, [0.0, 0.0], 0.1, 64), "f is not finite at"),
    ]:
        with pytest.raises(ur.InputError, match=message):
            call(*arguments)


def test_equal_seeds_give_equal_answers() -> None:
    case = Step(2)
    a, b, c = (estimate(case, "hessian", 256, seed)[0] for seed in (1, 1, 2))
    assert np.array_equal(a, b)
    assert not np.array_equal(a, c)
