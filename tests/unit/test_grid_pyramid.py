"""The pyramid in place of transforms on large grids: closed forms, what it leaves of waves, and the descent that it gives."""

from __future__ import annotations

import numpy as np
import pytest

from unrender.core import arrays, memory
from unrender.estimators.base import Estimate
from unrender.optimizers import ScheduleFree
from unrender.optimizers.transforms.fitted_sobolev import FittedSobolevState
from unrender.optimizers.transforms.shrinkage import signal_share
from unrender.preconditioners import Sobolev, grid
from unrender.preconditioners.grid import GridPyramid


def shrink(monkeypatch: pytest.MonkeyPatch) -> None:
    """Grids of more than 256 cells count as large."""
    monkeypatch.setattr(grid, "LARGEST_EXACT", 256)
    monkeypatch.setattr(grid, "_COARSEST", 256)
    monkeypatch.setattr(grid, "pyramid", GridPyramid)


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    shrink(monkeypatch)


def normal(seed: int, shape: tuple[int, ...]) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=shape).astype(np.float32)


@pytest.mark.usefixtures("small")
@pytest.mark.parametrize("power", [0.5, 1.0])
@pytest.mark.parametrize("strength", [0.1, 4.0])
@pytest.mark.parametrize("cells", [(64, 48), (33, 50), (12, 9, 10)])
def test_it_is_near_the_power(cells: tuple[int, ...], strength: float, power: float):
    pyramid, transform = GridPyramid(cells), grid.transform(cells, (False,) * len(cells))
    gain = ((1.0 + strength * transform.eigenvalues) ** -power).astype(np.float32)

    def near(x: np.ndarray) -> np.ndarray:
        return np.asarray(pyramid.apply(x, strength, power))

    x, y = normal(0, (*cells, 2)), normal(1, (*cells, 2))
    assert near(x).dtype == np.float32
    exact = transform.backward(transform.forward(x) * gain)
    assert np.corrcoef(near(x).ravel(), exact.ravel())[0, 1] > 0.97
    np.testing.assert_allclose(near(np.ones_like(x)), 1.0, atol=1e-5)
    waves = transform.backward(np.where(transform.eigenvalues < 0.3, transform.forward(x), np.float32(0)))
    exact = transform.backward(transform.forward(waves) * gain)
    assert (near(waves) * exact).sum() == pytest.approx((exact * exact).sum(), rel=0.02)
    apart = (near(x) * y).sum() - (near(y) * x).sum()
    assert abs(apart) < 0.003 * np.sqrt(np.square(near(x)).sum() * np.square(y).sum()), "symmetric but at odd sides"


@pytest.mark.usefixtures("small")
@pytest.mark.parametrize("cells", [(64, 48), (33, 50)])
def test_products_of_summaries_are_those_of_gradients(cells: tuple[int, ...]):
    smooth, shares = Sobolev(6.0), np.array([1.0, 0.25, 0.0625])
    transform = grid.transform(cells, (False, False))
    one = normal(0, (*cells, 3))
    other = 0.5 * one + normal(1, (*cells, 3))
    first, second = smooth.summary(one), smooth.summary(other)
    assert first is not None
    assert second is not None
    found = smooth.descents_of_summaries(one.shape, first, second, shares)
    spectra = [transform.forward(x).astype(float) for x in (one, other)]
    for share, (product, square) in zip(shares, found.T, strict=True):
        gain = 1.0 / (1.0 + 6.0 * share * transform.eigenvalues)
        assert square == pytest.approx((gain * spectra[0] ** 2).sum(), rel=0.12)
        assert product == pytest.approx((gain * spectra[0] * spectra[1]).sum(), rel=0.2)


def test_the_share_of_signal_is_that_of_transforms(monkeypatch: pytest.MonkeyPatch):
    shape = (64, 48, 3)
    signal = np.broadcast_to(np.linspace(0, 1, 48, dtype=np.float32)[:, None] > 0.5, shape)
    product, square = signal + 0.3 * normal(0, shape), 1.0 + 0.1 * normal(1, shape) ** 2
    exact = signal_share(Sobolev(16.0), product, square, 0.1, 0.8, 0)
    shrink(monkeypatch)
    found = signal_share(Sobolev(16.0), product, square, 0.1, 0.8, 0)
    assert not np.array_equal(found, exact)
    np.testing.assert_allclose(found, exact, atol=0.06)


def test_a_pattern_of_noise_and_detail_is_recovered_as_with_transforms(monkeypatch: pytest.MonkeyPatch):
    """A bowl under noise: after 30 steps the error is that with transforms, to a tenth."""
    shape = (48, 40, 3)
    rows, columns, _ = np.indices(shape)
    truth = (0.5 + 0.3 * np.sin(rows / 5.0) * np.cos(columns / 7.0) + 0.1 * ((rows + columns) % 2)).astype(np.float32)

    def error() -> float:
        optimizer = ScheduleFree(0.1, preconditioner=Sobolev(), preconditioned=("x",))
        x = {"x": np.full(shape, 0.2, np.float32)}
        state = optimizer.init(x)
        for step in range(30):
            estimate = Estimate(0.0, {"x": x["x"] - truth + 0.3 * normal(step, shape)})
            steps, state = optimizer.update(estimate, state, x)
            x = {"x": x["x"] + steps["x"]}
        assert bool(len(state.of(FittedSobolevState).strengths["x"].last)) == (grid.LARGEST_EXACT == 256)
        return float(np.sqrt(np.mean((x["x"] - truth) ** 2)))

    exact = error()
    shrink(monkeypatch)
    assert error() == pytest.approx(exact, rel=0.1)


def test_sums_of_products_in_parts(monkeypatch: pytest.MonkeyPatch):
    drjit = pytest.importorskip("drjit")
    x, y = normal(0, (1001,)), normal(1, (1001,))
    monkeypatch.setattr(memory, "LARGE", 100)
    pairs = [tuple(drjit.llvm.Float(z) for z in pair) for pair in ((x, y), (x, x))]
    found = [arrays.number(z) for z in memory.inner_products(pairs)]
    np.testing.assert_allclose(found, [np.dot(x, y), np.dot(x, x)], rtol=1e-4)
