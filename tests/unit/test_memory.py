"""Large arrays: sums in place, evaluation in turn, and the noise of a part of a gradient's elements."""

from __future__ import annotations

from typing import Any

import drjit as dr
import numpy as np
import pytest

import kernels
from unrender.core import arrays, memory
from unrender.estimators.gradient_sum import GradientSum
from unrender.runs.run import GradientNoise

pytestmark = pytest.mark.mitsuba

SIZE = 1 << 20


@pytest.mark.parametrize("count", [1, 2, 3, 5])
@pytest.mark.parametrize("large", [False, True])
def test_gradients_are_summed_in_double_precision(count: int, large: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(memory, "LARGE", 100 if large else 1000)
    random = np.random.default_rng(count)
    parts = [
        (random.normal(size=(20, 10, 3)) * 10.0 ** random.integers(-6, 6)).astype(np.float32) for _ in range(count)
    ]
    total = GradientSum()
    for part in parts:
        total.add({"x": kernels.on_device(part), "colour": kernels.on_device(part[0, 0])})
    found = total.result()
    assert total.result() == {}
    for key, given in (("x", parts), ("colour", [part[0, 0] for part in parts])):
        expected = np.sum(np.stack(given), axis=0, dtype=np.float64).astype(np.float32)
        assert found[key].shape == expected.shape
        np.testing.assert_array_equal(found[key].numpy(), expected)


def watermark(evaluate: Any) -> float:
    """The greatest number of arrays in memory while six are made of six others that nobody else holds."""
    before = {str(n): kernels.on_device(np.full(SIZE, n, np.float32)) for n in range(6)}
    dr.eval(before)
    dr.sync_thread()
    dr.detail.malloc_clear_statistics()
    after = {key: x * 2.0 + 1.0 for key, x in before.items()}
    del before
    evaluate({"state": (after,)})
    dr.sync_thread()
    assert [float(x.numpy()[0]) for x in after.values()] == [1.0, 3.0, 5.0, 7.0, 9.0, 11.0]
    return dr.detail.malloc_watermark(dr.backend_v(after["0"])) / (4 * SIZE)


def test_large_arrays_are_evaluated_in_turn() -> None:
    in_turn, at_once = watermark(memory.evaluate_in_turn), watermark(arrays.evaluate)
    assert in_turn <= at_once - 3


@pytest.mark.parametrize("large", [False, True])
def test_noise_is_seen_in_a_part_of_large_gradients(large: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Half of the second moment is noise: the elements of a large array have noise alone, those of a small one signal alone."""
    monkeypatch.setattr(memory, "LARGE", 1000 if large else 100_000)
    random, noise, share = np.random.default_rng(1), GradientNoise(), None
    signal = np.full(10, (7000 / 10) ** 0.5, np.float32)
    for _ in range(60):
        grid = random.normal(size=(70, 100)).astype(np.float32)
        share = noise.update({"grid": kernels.on_device(grid), "numbers": kernels.on_device(signal)})
    assert noise.mean is not None
    assert (noise.mean["grid"].shape == (1000,)) == large
    # Ten independent gradients of 1000 elements at least: a standard error of 0.5 √(2 / 10^4), and that of ‖ḡ‖², both below 0.02.
    assert share == pytest.approx(0.5, abs=0.05)


def test_elements_at_equal_distances() -> None:
    x = kernels.on_device(np.arange(20, dtype=np.float32).reshape(4, 5))
    np.testing.assert_array_equal(memory.every(x, 7).numpy(), [0, 7, 14])
