"""Sobolev: applied twice it is LargeSteps, and its strength follows the texture's size."""

from __future__ import annotations

import numpy as np
import pytest

from unrender.core.errors import InputError
from unrender.preconditioners import LargeSteps, Sobolev


def data(shape: tuple[int, ...]) -> np.ndarray:
    return np.random.default_rng(3).normal(size=shape).astype(np.float32)


@pytest.mark.parametrize("wrap", [False, True])
@pytest.mark.parametrize("shape", [(7, 5, 3), (1, 9, 1), (4, 5, 6, 2)])
def test_its_square_is_large_steps(shape: tuple[int, ...], wrap: bool):
    x, smooth = data(shape), Sobolev(12.0, wrap)
    np.testing.assert_allclose(smooth.apply(smooth.apply(x)), LargeSteps(12.0, wrap).apply(x), atol=3e-6)


def test_constants_pass_and_a_checkerboard_is_damped_by_the_root():
    np.testing.assert_allclose(Sobolev(50.0).apply(np.full((6, 8, 1), 2.0, np.float32)), 2.0, rtol=1e-6)
    board = np.indices((8, 8)).sum(0)[..., None] % 2 * 2.0 - 1.0
    found = Sobolev(10.0, True).apply(board.astype(np.float32))
    np.testing.assert_allclose(found, board / np.sqrt(1 + 8 * 10.0), rtol=1e-5)


def test_the_strength_grows_with_the_texture():
    x = data((32, 8, 3))
    np.testing.assert_array_equal(Sobolev().apply(x), Sobolev((16 / 8) ** 2).apply(x))


@pytest.mark.parametrize("options", [{"strength": -1.0}, {"strength": float("inf")}, {"wrap": 1}, {"wrap": ()}])
def test_refuses_options(options: dict):
    with pytest.raises(InputError, match="Sobolev"):
        Sobolev(**options)


def test_refuses_what_is_no_texture():
    with pytest.raises(InputError, match="Sobolev needs a texture"):
        Sobolev().check("key", (3,))
    with pytest.raises(InputError, match="must have 3 entries"):
        Sobolev(1.0, (True, False)).check("key", (2, 3, 4, 1))
