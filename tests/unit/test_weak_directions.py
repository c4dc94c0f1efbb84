"""Differences of `GaussNewton` along sums of numbers that nearly cancel, as of a shadow that two numbers move alike."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import unrender as ur
from tests.analytic import AnalyticRenderer
from unrender.estimators.derivative_images import differences, directions
from unrender.optimizers import AveragedNewton
from unrender.rendering.renderer import ParameterInfo

START, TRUTH = {"x": np.array([2.6, 0.4]), "y": np.array([0.5])}, {"x": np.array([3.1, 1.15]), "y": np.array([0.8])}


class Edge(AnalyticRenderer):
    """Poses, unless `moves` is False. Pixels beyond an edge at x₀ + 2 x₁ are bright, the one with the edge in part. Others are as bright
    as y."""

    moves = True

    def parameters(self) -> Mapping[str, ParameterInfo]:
        return {key: replace(info, rigid=self.moves) for key, info in super().parameters().items()}

    def _flat(self, parameters: Any) -> np.ndarray:
        place = parameters["x"][0] + 2.0 * parameters["x"][1]
        lit = np.clip(np.arange(9.0) - place + 0.5, 0.0, 1.0)
        return np.append(lit, parameters["y"])


def edge() -> ur.Problem:
    renderer = Edge(TRUTH, np.zeros((36, 3)), 0.1, noise=0.1, grain=0.05, shape=(2, 6))
    renderer.matrix = np.eye(12)[:, :10].repeat(3, axis=0)
    unknown = [ur.Parameter(key, initial=value) for key, value in START.items()]
    return ur.Problem(renderer, unknown, [ur.View(renderer.exact(TRUTH))])


@pytest.mark.parametrize("along", [True, False])
def test_a_sum_of_numbers_that_moves_nothing_is_not_determined(along: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Differences by x₁ blur the edge twice as far as those by x₀, so twice the one minus the other is not 0 but an edge of its own."""
    if not along:
        monkeypatch.setattr(Edge, "moves", False)
    made, ends = edge(), []
    for seed in range(3):
        found = ur.optimize(made, ur.GaussNewton(64, 8, remember=True), AveragedNewton(), steps=40, seed=seed)
        x = found.parameters["x"]
        assert x[0] + 2.0 * x[1] == pytest.approx(5.4, abs=0.05)
        ends.append(bool(np.isinf(found.standard_error.get("x", np.inf)).all()))
    assert all(ends) is along


def test_differences_along_sums_give_the_derivatives_of_linear_pictures() -> None:
    """Two weak directions among four elements, one of them near the limit of an element."""
    rng = np.random.default_rng(0)
    slopes = rng.normal(size=(4, 3, 5, 3))
    slopes[1] = 2.0 * slopes[0] + 1e-3 * slopes[1]
    slopes[3] = slopes[2] - slopes[0] + 1e-2 * slopes[3]
    flat, widths, limits = (
        slopes.reshape(4, -1),
        np.array([0.1, 0.05, 0.1, 0.2]),
        np.array([np.inf, 0.12, np.inf, np.inf]),
    )
    rows = directions(flat @ flat.T, widths, limits)
    single = np.count_nonzero(rows, axis=1) == 1
    assert single.sum() == 2
    np.testing.assert_array_equal(rows[single], np.diag(widths)[single])
    assert (np.abs(rows) <= limits * (1.0 + 1e-12)).all()
    changes = np.linalg.norm(rows @ flat, axis=1)
    assert (changes[~single] < 0.1 * changes[single].min()).all()
    moves = 2.0 * rows
    images = np.concatenate([np.tensordot(0.5 * sign * moves, slopes, axes=1) for sign in (1.0, -1.0)])
    np.testing.assert_allclose(differences(images, moves), slopes, rtol=1e-4, atol=1e-4)


def test_elements_that_change_pictures_on_their_own_or_not_at_all_have_differences_of_their_own() -> None:
    widths, free = np.array([0.1, 0.2, 0.3]), np.full(3, np.inf)
    hessian = np.array([[4.0, 0.5, 0.0], [0.5, 1.0, 0.0], [0.0, 0.0, 1.0]])
    for metric in (None, hessian, np.diag([1.0, 0.0, 1.0]), np.full((3, 3), np.nan)):
        np.testing.assert_array_equal(directions(metric, widths, free), np.diag(widths))
    images = np.arange(6.0)[:, None, None, None] * np.ones((1, 1, 1, 3))
    moves = np.diag([0.5, 0.0, 1.0])  # the second element is held by its bounds
    np.testing.assert_array_equal(differences(images, moves)[:, 0, 0, 0], [-6.0, 0.0, -3.0])
