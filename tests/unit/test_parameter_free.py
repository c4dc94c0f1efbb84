"""DoWG and Prodigy: closed forms, no unit, no rate, the distance that they find."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest

import kernels
import unrender as ur
from unrender.core import arrays, registry, tables
from unrender.estimators.base import Estimate
from unrender.optimizers import DoWG, Prodigy
from unrender.problem.upsampling import restarted
from unrender.schedules.functions import Constant, Cosine

EVERY = [DoWG(), Prodigy(), DoWG(0.5, Constant(0.5)), Prodigy(first=0.1, beta_1=0.5, beta_2=0.9, factor=0.7)]


def descend(optimizer: Any, start: Any, gradient: Any, steps: int, own: Any = None) -> tuple[list[Any], Any]:
    """Points, the start first, and the last state."""
    x = {"x": np.array(start, float)}
    state = optimizer.init(x, own)
    points = [x["x"]]
    for _ in range(steps):
        step, state = optimizer.update(Estimate(0.0, {"x": gradient(x["x"])}), state, x)
        x = {"x": x["x"] + step["x"]}
        points.append(x["x"])
    return points, state


def test_dowg_is_its_algorithm() -> None:
    center = np.array([3.0, -1.0, 0.5])
    points, state = descend(DoWG(first=0.1), np.ones(3), lambda x: 2 * (x - center), 40)
    r, v, x = 0.1 * np.sqrt(3.0), 0.0, np.ones(3)
    for found in points[1:]:
        g = 2 * (x - center)
        r = max(r, float(np.linalg.norm(x - 1.0)))
        v += r**2 * float(g @ g)
        x = x - r**2 / np.sqrt(v) * g
        np.testing.assert_allclose(found, x, rtol=1e-9)
    assert state.distance["x"] == pytest.approx(r)


def test_prodigy_is_its_algorithm() -> None:
    center = np.array([3.0, -1.0, 0.5])
    points, state = descend(Prodigy(first=0.01, beta_2=0.99, factor=0.8), np.ones(3), lambda x: 2 * (x - center), 40)
    d, m, v, r, s, x = 0.01, np.zeros(3), np.zeros(3), 0.0, np.zeros(3), np.ones(3)
    b = np.sqrt(0.99)
    for found in points[1:]:
        g = 2 * (x - center)
        m = 0.9 * m + 0.1 * d * g
        v = 0.99 * v + 0.01 * d**2 * g**2
        r = b * r + (1 - b) * 0.8 * d**2 * float(g @ (1.0 - x))
        s = b * s + (1 - b) * 0.8 * d**2 * g
        x = x - 0.8 * d * m / (np.sqrt(v) + d * 1e-8)
        d = max(d, r / np.abs(s).sum())
        np.testing.assert_allclose(found, x, rtol=1e-9)
    assert state.distance["x"] == pytest.approx(d)
    assert d > 0.5, "the distance was found"


@pytest.mark.parametrize("optimizer", [DoWG(), Prodigy(epsilon=1e-300)], ids=repr)
@pytest.mark.parametrize("scale", [1e-6, 1e6])
def test_neither_unit_matters(optimizer: Any, scale: float) -> None:
    """Of the parameter, nor of the loss."""
    center = np.array([3.0, -1.0])
    plain, _ = descend(optimizer, np.ones(2), lambda x: x - center, 60)
    other, _ = descend(optimizer, scale * np.ones(2), lambda x: 1e3 * (x / scale - center), 60)
    np.testing.assert_allclose(np.array(other) / scale, plain, rtol=1e-6)


@pytest.mark.parametrize("optimizer", [DoWG(), Prodigy(schedule=Cosine(2000))], ids=repr)
@pytest.mark.parametrize("distance", [1e-2, 1.0, 100.0])
def test_the_bottom_is_reached_from_any_distance(optimizer: Any, distance: float) -> None:
    curvature = np.array([1.0, 3.0, 10.0])
    points, state = descend(optimizer, np.ones(3), lambda x: curvature * (x - 1.0 - distance), 2000)
    np.testing.assert_allclose(points[-1], 1.0 + distance, atol=0.02 * distance)
    assert 0.2 < state.distance["x"] / distance < 5.0


@pytest.mark.mitsuba
@pytest.mark.parametrize("optimizer", EVERY, ids=repr)
def test_pure_and_on_the_device(optimizer: Any) -> None:
    random = np.random.default_rng(6)
    gradients = [{"a": random.normal(size=(4, 3)), "b": 1e-3 * random.normal(size=(2,))} for _ in range(12)]
    parameters = {"a": np.ones((4, 3)), "b": np.full(2, 0.1)}

    def take(convert: Any) -> list[Any]:
        x = {key: convert(value) for key, value in parameters.items()}
        state, found = optimizer.init(x), []
        for gradient in gradients:
            estimate = Estimate(0.0, {key: convert(value) for key, value in gradient.items()})
            before = dataclasses.replace(state)
            steps, state = optimizer.update(estimate, before, x)
            again, _ = optimizer.update(estimate, before, x)
            for key in steps:
                np.testing.assert_array_equal(arrays.numpy(steps[key]), arrays.numpy(again[key]))
            x = {key: x[key] + steps[key] for key in x}
            arrays.evaluate(x, state)
            found.append({key: arrays.numpy(value) for key, value in steps.items()})
        return found

    for ours, theirs in zip(take(np.asarray), take(kernels.on_device), strict=True):
        for key in ours:
            np.testing.assert_allclose(ours[key], theirs[key], rtol=2e-3, atol=1e-7)


@pytest.mark.parametrize("optimizer", EVERY, ids=repr)
def test_a_gradient_of_zero_makes_no_step(optimizer: Any) -> None:
    points, _ = descend(optimizer, np.ones(3), np.zeros_like, 3)
    np.testing.assert_array_equal(points[-1], 1.0)


def test_the_first_length_is_a_share_of_the_size_or_the_parameters_own() -> None:
    x = {"a": np.full(4, 5.0), "b": np.zeros(2), "c": np.ones(9)}
    state = Prodigy(first=0.01).init(x, {"c": 0.5})
    assert state.distance == pytest.approx({"a": 0.05, "b": 0.01, "c": 0.5})
    assert DoWG(0.01).init(x, {"c": 0.5}).distance == pytest.approx({"a": 0.1, "b": 0.01 * 2**0.5, "c": 1.5})


@pytest.mark.parametrize("optimizer", [DoWG(), Prodigy()], ids=repr)
def test_another_resolution(optimizer: Any) -> None:
    _, state = descend(optimizer, np.ones(3), lambda x: x - 2.0, 20)
    after = restarted(state, optimizer.init({"x": np.ones(6)}))
    assert after.step == 20
    assert after.start["x"].shape == (6,)


@pytest.mark.parametrize("optimizer", EVERY, ids=repr)
def test_they_are_stored_and_made_again(optimizer: Any) -> None:
    assert registry.components("optimizer")[type(optimizer).__name__] is type(optimizer)
    if optimizer.schedule is None:
        assert tables.component(tables.table(optimizer)) == optimizer


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: DoWG(0.0), "DoWG: first must be"),
        (lambda: Prodigy(-1.0), "Prodigy: first must be"),
        (lambda: Prodigy(beta_2=1.0), "Prodigy: beta_2 must be"),
        (lambda: Prodigy(factor=0.0), "Prodigy: factor must be"),
        (lambda: Prodigy(schedule=3), "Prodigy: schedule must be"),  # pyright: ignore[reportArgumentType]
        (lambda: DoWG().init({"x": np.ones(2)}, {"y": 1.0}), 'DoWG: learning rate given for unknown parameter "y"'),
    ],
)
def test_bad_arguments_are_named(make: Any, message: str) -> None:
    with pytest.raises(ur.InputError, match=message):
        make()
