"""Perturbations at which a function is not finite are dropped: derivatives are means over the others."""

from __future__ import annotations

import logging

import numpy as np
import pytest

import unrender as ur
from unrender.core.checks import DropReport
from unrender.estimators.smoothing.function import joint


def slope(x: np.ndarray) -> np.ndarray:
    return 3 * x[:, 0] - x[:, 1]


def broken(every: int):
    """`slope`, not finite at some points that do not depend on where they lie."""
    calls = iter(range(10**6))

    def f(x: np.ndarray) -> np.ndarray:
        values = slope(x)
        values[[next(calls) % every == every - 1 for _ in x]] = np.nan
        return values

    return f


@pytest.mark.parametrize("options", [{}, {"low_discrepancy": True}, {"antithetic": False}, {"orthogonal": True}])
def test_a_gradient_is_the_mean_of_the_finite_draws(options: dict) -> None:
    found, error = ur.smoothed.gradient(broken(37), [0.2, 0.4], 0.1, 4096, **options)
    assert np.isfinite([found, error]).all()
    assert (np.abs(found - [3, -1]) < 4 * error + 1e-9).all()


def test_joint_derivatives_and_products_stay_finite() -> None:
    found = joint(broken(37), [0.2, 0.4], 0.1, 4096)
    for value, error, right in (
        (*found.gradient(), [3, -1]),
        (*found.hessian(), np.zeros((2, 2))),
        (*found.hvp([1.0, 0.0]), [0, 0]),
    ):
        assert np.isfinite(value).all()
        assert (np.abs(value - right) < 4.5 * error + 1e-9).all()
    assert np.isfinite(found.curvatures).all()
    assert len(found.draws) == len(found.curvatures) < 2048


def test_nothing_finite_is_refused() -> None:
    with pytest.raises(ur.InputError, match="f is not finite at"):
        ur.smoothed.gradient(lambda x: slope(x) * np.inf, [0.0, 0.0], 0.1, 64)
    with pytest.raises(ur.InputError, match="fewer than two perturbations"):
        ur.smoothed.gradient(lambda x: np.where(np.arange(len(x)) == 0, slope(x), np.nan), [0.0, 0.0], 0.1, 64)


def test_the_report_warns_at_the_first_and_at_each_tenfold_count(caplog: pytest.LogCaptureFixture) -> None:
    report = DropReport()
    with caplog.at_level(logging.WARNING, "unrender"):
        for dropped in (0, 1, 1, 7, 1, 0):
            report.add(dropped, 100, "samples are not finite")
    assert [record.getMessage() for record in caplog.records] == [
        "samples are not finite; 1 of 200 so far were dropped",
        "samples are not finite; 10 of 500 so far were dropped",
    ]
