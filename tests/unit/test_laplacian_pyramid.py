"""LaplacianPyramid against the sum of its levels, made texel by texel, and the properties that descent relies on."""

from __future__ import annotations

import numpy as np
import pytest

import unrender as ur
from unrender.core import tables
from unrender.core.errors import InputError
from unrender.preconditioners import LaplacianPyramid
from unrender.rendering.numpy.linear import AnalyticRenderer

SHAPES = [(7, 5, 3), (1, 9, 1), (12, 12, 2), (4, 5, 6, 1), (2, 2, 1)]


def data(shape: tuple[int, ...], seed: int = 3) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=shape).astype(np.float32)


def interpolation(size: int, wraps: bool) -> np.ndarray:
    """Between the centres of half as many texels, one basis vector at a time."""
    coarse = (size + 1) // 2
    at, centres = (np.arange(size) + 0.5) / size, (np.arange(coarse) + 0.5) / coarse
    period = 1.0 if wraps else None
    return np.stack([np.interp(at, centres, unit, period=period) for unit in np.eye(coarse)], axis=-1)


def matrix(grid: tuple[int, ...], wrap: tuple[bool, ...], falloff: float, levels: int | None) -> np.ndarray:
    """S: the sum over levels of U D^-1 Uᵀ, U the product of the interpolations of the levels between."""
    to_texture, parts, sides = np.eye(int(np.prod(grid))), [], list(grid)
    while True:
        parts.append(to_texture @ np.diag(1 / to_texture.sum(axis=0)) @ to_texture.T)
        if max(sides) == 1 or len(parts) == levels:
            break
        step = np.eye(1)
        for axis, size in enumerate(sides):
            step = np.kron(step, interpolation(size, wrap[axis]) if size > 1 else np.eye(1))
            sides[axis] = (size + 1) // 2
        to_texture = to_texture @ step
    shares = falloff ** -np.arange(len(parts), dtype=float)
    return np.einsum("l,lij->ij", shares / shares.sum(), parts)


@pytest.mark.parametrize("wrap", [False, True])
@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize(("falloff", "levels"), [(0.5, None), (1.0, 2), (0.7, 99)])
def test_is_the_sum_of_its_levels(shape: tuple[int, ...], wrap: bool, falloff: float, levels: int | None) -> None:
    grid = shape[:-1]
    dense = matrix(grid, (wrap,) * len(grid), falloff, levels)
    x = data(shape)
    found = LaplacianPyramid(levels, falloff, wrap).apply(x)
    np.testing.assert_allclose(found, (dense @ x.reshape(len(dense), -1)).reshape(shape), atol=2e-6)
    np.testing.assert_allclose(dense, dense.T, atol=1e-12)
    count = min(levels or 99, 1 + int(np.ceil(np.log2(max(grid)))))
    least = 1 / np.sum(falloff ** -np.arange(count, dtype=float))
    spectrum = np.linalg.eigvalsh(dense)
    assert least - 1e-9 <= spectrum[0]
    assert spectrum[-1] == pytest.approx(1.0)


@pytest.mark.parametrize("shape", SHAPES)
def test_constants_pass_unchanged_and_channels_do_not_mix(shape: tuple[int, ...]) -> None:
    smooth = LaplacianPyramid()
    np.testing.assert_allclose(smooth.apply(np.full(shape, 0.7, np.float32)), 0.7, rtol=1e-5)
    x = data(shape)
    x[..., 0] = 0.0
    np.testing.assert_array_equal(smooth.apply(x)[..., 0], 0.0)


def test_a_checkerboard_moves_by_the_share_of_the_finest_level() -> None:
    board = (np.indices((16, 8)).sum(0)[..., None] % 2 * 2.0 - 1.0).astype(np.float32)
    found = LaplacianPyramid(3, 0.5, True).apply(board)
    np.testing.assert_allclose(found, board / (1 + 2 + 4), atol=1e-6)


def test_a_single_level_does_nothing() -> None:
    np.testing.assert_array_equal(LaplacianPyramid(1).apply(data((5, 4, 3))), data((5, 4, 3)))


def test_an_environment_map_wraps_in_u_alone() -> None:
    """Turning it by what the coarsest texel covers turns the result; across the poles it does not."""
    x, smooth = data((16, 16, 3)), LaplacianPyramid(3, wrap=(False, True))
    turned, tipped = (smooth.apply(np.roll(x, 4, axis)) for axis in (1, 0))
    np.testing.assert_allclose(turned, np.roll(smooth.apply(x), 4, 1), atol=1e-6)
    assert np.abs(tipped - np.roll(smooth.apply(x), 4, 0)).max() > 0.01


def test_arguments_stay_as_they_were_and_strides_do_not_matter() -> None:
    x = data((6, 8, 3))
    kept, smooth = x.copy(), LaplacianPyramid()
    np.testing.assert_array_equal(smooth.apply(x[::-1, ::2]), smooth.apply(x[::-1, ::2].copy()))
    np.testing.assert_array_equal(x, kept)


@pytest.mark.mitsuba
def test_device_agrees_with_numpy() -> None:
    import mitsuba as mi

    x = data((7, 5, 3))
    found = LaplacianPyramid().apply(mi.TensorXf(x))
    assert isinstance(found, mi.TensorXf)
    np.testing.assert_array_equal(np.array(found), LaplacianPyramid().apply(x))


def test_a_table_makes_one_and_says_what_is_wrong() -> None:
    made = LaplacianPyramid(3, 0.7, (False, True))
    assert tables.component(tables.table(made), "preconditioner") == made
    assert tables.component({"type": "LaplacianPyramid"}, "preconditioner") == LaplacianPyramid()
    with pytest.raises(InputError, match="LaplacianPyramid has no option level; did you mean levels"):
        tables.component({"type": "LaplacianPyramid", "level": 3}, "preconditioner")


@pytest.mark.parametrize(
    "options",
    [
        {"levels": 0},
        {"levels": 2.5},
        {"falloff": 0.0},
        {"falloff": 1.5},
        {"falloff": 1e-200},
        {"falloff": "x"},
        {"wrap": 1},
    ],
)
def test_refuses_options(options: dict) -> None:
    with pytest.raises(InputError, match=r"LaplacianPyramid: (levels|falloff|wrap) must"):
        LaplacianPyramid(**options)


def test_refuses_what_is_no_texture() -> None:
    with pytest.raises(InputError, match="LaplacianPyramid needs a texture"):
        LaplacianPyramid().check("key", (3,))
    with pytest.raises(InputError, match="must have 3 entries"):
        LaplacianPyramid(wrap=(True, False)).check("key", (2, 3, 4, 1))


def test_a_descent_through_it_recovers_every_texel() -> None:
    """Of a checkerboard, too: no detail is out of reach."""
    truth = {"map": 0.3 + 0.4 * (np.indices((6, 5)).sum(0)[..., None] % 2)}
    renderer = AnalyticRenderer(truth, np.eye(75, 30) + np.eye(75, 30, -30), 0.1, 0.0, shape=(5, 5))
    smooth = LaplacianPyramid()
    asked = ur.Problem(
        renderer,
        [ur.Parameter("map", initial=0.4, bounds=(0, 1), preconditioner=smooth)],
        [ur.View(renderer.exact(truth))],
        truth=truth,
    )
    found = ur.optimize(asked, ur.PathGradient(), ur.optimizers.Adam(0.05), steps=300)
    np.testing.assert_allclose(found.parameters["map"], truth["map"], atol=0.02)
