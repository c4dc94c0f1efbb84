"""Vertices at one position are found up to rounding."""

from __future__ import annotations

import numpy as np
import pytest

from unrender.core.geometry import weld


def tube(radius: float = 1.0, shift: float = 0.0) -> np.ndarray:
    """Four columns around a circle and a fifth at 2π, in two rows, (10, 3): the last column differs from the first by rounding."""
    angle, height = (x.ravel() for x in np.meshgrid(np.linspace(0, 2 * np.pi, 5), [0.0, 1.0]))
    return radius * np.stack([np.cos(angle), np.sin(angle), height], -1) + shift


@pytest.mark.parametrize("points", [tube(), tube(1e-3), tube(1e4), tube(shift=50.0).astype(np.float32)])
def test_a_seam_that_is_equal_up_to_rounding_is_one_column(points: np.ndarray) -> None:
    first, places = weld(points)
    assert len(first) == 8
    assert places[[4, 9]].tolist() == places[[0, 5]].tolist()
    np.testing.assert_allclose(points[first][places], points, rtol=0, atol=1e-6 * np.abs(points).max())


def test_distinct_and_equal_points_are_numbered_as_by_numpy() -> None:
    points = np.random.default_rng(0).integers(0, 3, (40, 3)).astype(float)
    _, first, places = np.unique(points, axis=0, return_index=True, return_inverse=True)
    np.testing.assert_array_equal(weld(points)[0], first)
    np.testing.assert_array_equal(weld(points)[1], places.reshape(-1))


def test_points_that_are_not_finite_or_few_are_no_error() -> None:
    assert len(weld(np.array([[0, 0, np.nan], [0, 0, 1.0]]))[0]) == 2
    assert [len(weld(np.zeros((count, 3)))[0]) for count in (0, 1)] == [0, 1]


def test_details_far_from_the_origin_and_beside_a_far_point_stay_apart() -> None:
    """Rounding is below the distance of neighbours: 16 of 90,000 points were left of a plate of size 0.1 at 1000."""
    x, y = np.meshgrid(*[np.linspace(0.0, 0.1, 300)] * 2)
    plate = (np.stack([x.ravel(), y.ravel(), 0.0 * x.ravel()], -1) + 1000.0).astype(np.float32)
    assert len(weld(plate)[0]) == len(np.unique(plate, axis=0)) == 90000
    scattered = np.random.default_rng(0).normal(size=(4000, 3))
    scattered[0] = 2e6
    assert len(weld(scattered)[0]) == 4000
