"""The checks behind the coverage page see planted faults; the page has no empty cell."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest

from scripts.coverage.checks import descended, gradients_agree, images_agree
from scripts.coverage.cli import RECORD
from tests.analytic import AnalyticRenderer

RUNS, SIZE = 16, 16
PICTURE = np.kron(np.random.default_rng(0).uniform(0.2, 0.8, (4, 4, 3)), np.ones((4, 4, 1)))


def pictures(seed: int, picture: np.ndarray = PICTURE) -> np.ndarray:
    """Noisy pictures (RUNS, SIZE, SIZE, 3), their noise as large as at 64 samples per pixel."""
    return picture + np.random.default_rng(seed).normal(0, 0.05, (RUNS, SIZE, SIZE, 3))


def derivatives(seed: int, mean: float = 2.0, noise: float = 0.02) -> np.ndarray:
    """Noisy derivatives (RUNS,)."""
    return mean + noise * np.random.default_rng(seed).normal(size=RUNS)


@pytest.mark.parametrize("seed", range(4))
def test_equal_pictures_and_derivatives_agree(seed: int) -> None:
    assert images_agree(pictures(seed), pictures(seed + 10)).verdict == "ok"
    assert gradients_agree(derivatives(seed), derivatives(seed + 10)).verdict == "ok"


@pytest.mark.parametrize("factor", [0.97, 1.03])
def test_a_factor_of_three_percent_is_seen(factor: float) -> None:
    assert images_agree(factor * pictures(1), pictures(2)).verdict == "wrong"
    assert gradients_agree(factor * derivatives(1, noise=0.01), derivatives(2, noise=0.01)).verdict == "wrong"


@pytest.mark.parametrize("axis", [0, 1])
def test_a_shift_by_half_a_pixel_is_seen(axis: int) -> None:
    shifted = (PICTURE + np.roll(PICTURE, 1, axis)) / 2
    assert images_agree(pictures(1, shifted), pictures(2)).verdict == "wrong"


def test_noise_that_would_hide_a_fault_is_told() -> None:
    assert gradients_agree(derivatives(1, noise=3.0), derivatives(2, noise=3.0)).verdict == "weak"
    assert images_agree(pictures(1) + 0.05 * derivatives(3, 0, 1.0)[:, None, None, None], pictures(2)).verdict == "weak"


def test_values_that_are_not_finite_are_wrong() -> None:
    broken = pictures(1)
    broken[0, 0, 0, 0] = np.nan
    assert images_agree(broken, pictures(2)).verdict == "wrong"
    assert gradients_agree(np.full(RUNS, np.inf), derivatives(2)).verdict == "wrong"
    assert not descended(1.0, np.nan)


def test_a_gradient_of_zero_is_told_from_one_that_is_missing() -> None:
    assert gradients_agree(np.zeros(RUNS), np.zeros(RUNS)).verdict == "zero"
    assert gradients_agree(np.zeros(RUNS), derivatives(2)).verdict == "wrong"


@pytest.mark.mitsuba
def test_the_page_is_what_the_record_says_and_has_no_empty_cell() -> None:
    from scripts.coverage.coverage_page import page
    from scripts.coverage.plugins import IN_INSTANCES, PLUGINS

    record = json.loads(RECORD.read_text())
    assert set(record) == set(PLUGINS) | set(IN_INSTANCES)
    assert not [name for name, found in record.items() if "failed" in found]
    written = page(record)
    assert [name for name in record if f"| {name} |" not in written] == []
    cells = [cell for line in written.splitlines() if line.startswith("|") for cell in line.strip("|").split("|")]
    assert all(cell.strip() and "not measured" not in cell and "**wrong**" not in cell for cell in cells)


@pytest.mark.mitsuba
@pytest.mark.parametrize(("factor", "shift", "ok"), [(1.0, 0.0, True), (-1.0, 0.0, False), (1.0, -5.0, False)])
def test_a_descent_of_a_wrong_gradient_is_seen(
    monkeypatch: pytest.MonkeyPatch, factor: float, shift: float, ok: bool
) -> None:
    """A gradient of the wrong sign, and one that leads away from the truth by a large bias."""
    from scripts.coverage.measure import descent

    matrix = np.random.default_rng(0).uniform(0, 1, (SIZE * SIZE * 3, 3))
    renderer = AnalyticRenderer({"x": np.full(3, 0.5)}, matrix, noise=0.05, shape=(SIZE, SIZE))
    adjoint = AnalyticRenderer.adjoint

    def wrong(self: Any, parameters: Any, paths: Any, weights: Any) -> Any:
        return {key: factor * value + shift * SIZE for key, value in adjoint(self, parameters, paths, weights).items()}

    monkeypatch.setattr(AnalyticRenderer, "adjoint", wrong)
    assert descent(renderer, "x", renderer.parameters()["x"])["ok"] is ok
