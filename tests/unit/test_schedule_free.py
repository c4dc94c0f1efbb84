"""ScheduleFree against closed forms: the weighted mean, the rate's fall, bounds, preconditioning."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from unrender.core import tables
from unrender.core.errors import InputError
from unrender.estimators.base import Estimate
from unrender.estimators.capabilities import AtBounds, FreshGradient
from unrender.optimizers import Adam, ScheduleFree
from unrender.optimizers.transforms import agreement_rate, fitted_sobolev, lasting_agreement
from unrender.optimizers.transforms.agreement_rate import Agreement
from unrender.optimizers.transforms.averages import Iterates
from unrender.optimizers.transforms.base import StepUpdate
from unrender.optimizers.transforms.fitted_sobolev import FittedSobolevState, StrengthFit
from unrender.optimizers.transforms.scale import MeanSquare
from unrender.optimizers.transforms.shrinkage import GradientProducts, PullToStart
from unrender.preconditioners import Sobolev
from unrender.runs.folder.state import check_alike
from unrender.schedules import Cosine


def descend(
    optimizer: Any, start: Any, gradient: Any, steps: int, low: float = -math.inf
) -> tuple[list[Any], list[Any]]:
    """Parameters before each step and states after it; `gradient` is a function of step and parameters."""
    x = {"x": np.array(start, float)}
    state = optimizer.init(x)
    seen, states = [], []
    for step in range(steps):
        seen.append(x["x"])
        found, state = optimizer.update(Estimate(0.0, {"x": np.asarray(gradient(step, x["x"]), float)}), state, x)
        x = {"x": np.maximum(x["x"] + found["x"], low)}
        states.append(state)
    return [*seen, x["x"]], states


def noise(step: int, x: np.ndarray) -> np.ndarray:
    return np.random.default_rng(step).normal(size=x.shape)


@pytest.mark.parametrize("power", [0, 1, 4])
def test_the_average_has_weights_that_grow_as_a_power_of_the_step(power: int):
    optimizer = ScheduleFree(0.1, averaging=power)
    _, states = descend(optimizer, np.zeros(5), noise, 40)
    iterates = np.array([state.of(Iterates).fast["x"] for state in states])
    weights = np.array([math.comb(step + power, power) for step in range(40)], float)
    for count in (1, 2, 17, 40):
        expected = np.tensordot(weights[:count] / weights[:count].sum(), iterates[:count], 1)
        np.testing.assert_allclose(states[count - 1].of(Iterates).average["x"], expected, rtol=1e-10, atol=1e-14)


def test_the_average_of_a_texture_forgets_the_first_iterates_sooner():
    optimizer = ScheduleFree(0.1, averaging=2, preconditioner=Sobolev(), preconditioned=("x",))
    _, states = descend(optimizer, np.zeros((4, 4, 1)), noise, 40)
    iterates, weights = np.array([state.of(Iterates).fast["x"] for state in states]), np.zeros(0)
    for step in range(40):
        power = 2 * (step + 48) / (step + 16)
        share = (1 + power) / (step + 1 + power)
        weights = np.append((1 - share) * weights, share)
        average = np.tensordot(weights, iterates[: step + 1], 1)
        np.testing.assert_allclose(states[step].of(Iterates).average["x"], average, rtol=1e-5, atol=1e-6)
        if step == 19:  # the first half of the steps, with r alone 0.14
            assert weights[:10].sum() < 0.07


def test_the_parameters_lie_between_iterate_and_average():
    seen, states = descend(ScheduleFree(0.1, beta=0.8), np.zeros(5), noise, 20)
    for x, state in zip(seen[1:], states, strict=True):
        np.testing.assert_allclose(
            x, 0.2 * state.of(Iterates).fast["x"] + 0.8 * state.of(Iterates).average["x"], rtol=1e-12
        )


def test_the_rate_of_a_constant_gradient_stays_or_grows():
    def along(step: int, x: np.ndarray) -> np.ndarray:
        return np.array([1.0, -2.0, 0.5])

    _, states = descend(ScheduleFree(0.1, growth=0.0), np.zeros(3), along, 30)
    assert states[-1].of(Agreement).log_rate["x"] == pytest.approx(0.0, abs=1e-12)
    moved = states[-1].of(Iterates).fast["x"] - states[-2].of(Iterates).fast["x"]
    np.testing.assert_allclose(moved, [-0.1, 0.1, -0.1], rtol=1e-9)
    rises = [
        states[0].of(Iterates).fast["x"][1],
        states[1].of(Iterates).fast["x"][1] - states[0].of(Iterates).fast["x"][1],
    ]
    np.testing.assert_allclose(rises, [0.05, 0.1], rtol=1e-9)
    _, states = descend(ScheduleFree(0.1, growth=0.1), np.zeros(3), along, 12)
    expected = sum(0.1 * (1 - 2 * 0.8**step / math.sqrt(27)) for step in range(1, 12))
    assert states[-1].of(Agreement).log_rate["x"] == pytest.approx(expected)
    _, states = descend(ScheduleFree(0.1), np.zeros(1), lambda step, x: np.ones(1), 24)
    assert states[-1].of(Agreement).factors["x"] > 3.0  # a single number's, too


def test_the_rate_grows_no_further_than_the_parameter():
    """From 1 along a constant gradient: at most 3 times the first rate, and times what the root mean square has grown by."""
    _, states = descend(ScheduleFree(0.01, growth=0.2), np.ones(20), lambda step, x: np.ones_like(x), 40)
    assert states[-1].of(Agreement).log_rate["x"] == pytest.approx(math.log(3.0), abs=1e-9)  # it has come near 0
    xs, states = descend(ScheduleFree(0.1, growth=0.2), np.ones(20), lambda step, x: -np.ones_like(x), 60)
    assert states[-1].of(Agreement).log_rate["x"] > math.log(5.0)
    assert states[-1].of(Agreement).log_rate["x"] <= math.log(3.0 * np.abs(xs[-1]).max())
    _, states = descend(ScheduleFree(0.1, growth=0.2), np.zeros(20), lambda step, x: np.ones_like(x), 30)
    assert states[0].of(Agreement).sizes == {"x": 1.0}


def test_steps_that_gradients_contradict_become_shorter():
    """A gradient that turns at every step: the mean correlation is -1 at last, and the rate shrinks by 2 q (1 - s) a step."""
    _, states = descend(ScheduleFree(0.1, decay=0.0), np.zeros(9), lambda step, x: (-1.0) ** step * np.ones(9), 60)
    shrunk = states[-1].of(Agreement).log_rate["x"] - states[-2].of(Agreement).log_rate["x"]
    assert shrunk == pytest.approx(-2 * 0.1 * (1 - 1 / 9), rel=1e-3)


def test_single_numbers_that_agree_by_chance_do_not_speed_up(monkeypatch: pytest.MonkeyPatch):
    """The gradients of forty numbers are noise: without the standard error of their correlation many rates grow by half, with it few."""

    def grown() -> int:
        found = (
            descend(ScheduleFree(0.1, decay=0.0), np.zeros(1), lambda step, x, n=n: noise(100 * n + step, x), 60)[1]
            for n in range(40)
        )
        return sum(max(state.of(Agreement).log_rate["x"] for state in states) > 0.4 for states in found)

    assert grown() <= 2
    monkeypatch.setattr(agreement_rate, "_PAIRS", math.inf)
    assert grown() >= 8


def test_the_rate_of_uncorrelated_gradients_falls_by_its_power():
    """Gradients that alternate between two axes have no correlation at all: the mean correlation is then 0.8^t."""
    _, states = descend(ScheduleFree(0.1, decay=0.4, growth=0.0), np.zeros(2), lambda step, x: np.eye(2)[step % 2], 200)
    expected = -0.4 * sum((1 - 0.8**step) / (step + 10) for step in range(1, 200))
    assert states[-1].of(Agreement).log_rate["x"] == pytest.approx(expected, rel=1e-9)
    _, states = descend(
        ScheduleFree(0.1, decay=50.0, growth=0.0), np.zeros(2), lambda step, x: np.eye(2)[step % 2], 200
    )
    assert states[-1].of(Agreement).log_rate["x"] == pytest.approx(
        -0.6 * sum(1 / (step + 10) for step in range(1, 200)), rel=1e-9
    )
    _, states = descend(ScheduleFree(0.1, decay=0.0, growth=0.0), np.zeros(2), noise, 50)
    assert states[-1].of(Agreement).log_rate["x"] == 0.0


def test_the_schedule_is_a_further_factor():
    def along(step: int, x: np.ndarray) -> np.ndarray:
        return np.ones_like(x)

    _, plain = descend(ScheduleFree(0.1, growth=0.0), np.zeros(1), along, 12)
    _, scheduled = descend(ScheduleFree(0.1, growth=0.0, schedule=Cosine(10, 0.25)), np.zeros(1), along, 12)
    for step in range(1, 12):
        moved, as_scheduled = (
            found[step].of(Iterates).fast["x"] - found[step - 1].of(Iterates).fast["x"] for found in (plain, scheduled)
        )
        np.testing.assert_allclose(as_scheduled, Cosine(10, 0.25)(step) * moved, rtol=1e-9)


def test_the_mean_square_is_of_all_gradients_once_there_are_many():
    """Twenty gradients of 1, then of 0: the decay of 0.95 until then, and their share of all steps from then on."""
    _, states = descend(ScheduleFree(0.1), np.zeros(2), lambda step, x: np.full_like(x, float(step < 20)), 60)
    for made, expected in (
        (5, 1 - 0.95**5),
        (20, 1 - 0.95**20),
        (30, 2 / 3 * (1 - 0.95**20)),
        (60, (1 - 0.95**20) / 3),
    ):
        np.testing.assert_allclose(states[made - 1].of(MeanSquare).second_moment["x"], expected, rtol=1e-12)
    _, states = descend(ScheduleFree(0.1, growth=0.0), np.zeros(2), lambda step, x: 2.0 + 0 * x, 60)
    moved = states[-1].of(Iterates).fast["x"] - states[-2].of(Iterates).fast["x"]
    np.testing.assert_allclose(moved, -0.1, rtol=1e-9)  # debiased by the sum of these weights


@pytest.mark.parametrize("gain", [0.5, 1.0, 4.0])
def test_where_smoothing_becomes_stronger_the_iterate_begins_again_at_the_mean(
    gain: float, monkeypatch: pytest.MonkeyPatch
):
    """At the third step; and the mean square is that of the gradients of then, 4 in each of 16 texels, and the new one's, 1. Where it
    becomes weaker, the rate is 0.3 of the first."""
    changed = StrengthFit(gain=gain, level=64.0)
    monkeypatch.setattr(
        StrengthFit, "after", lambda *args: changed if args[0].count == 9 else replace(args[0], count=9)
    )
    optimizer = ScheduleFree(0.1, preconditioner=Sobolev(), preconditioned=("x",), growth=0.0, decay=0.0)
    g = np.ones((4, 4, 1), np.float32)
    _, states = descend(optimizer, np.zeros((4, 4, 1)), lambda step, x: g, 3)
    begun = states[1].of(Iterates).average["x"] if gain < 1 else states[1].of(Iterates).fast["x"]
    expected = 0.95 * (1 - 0.95**2) * 4 + 0.05
    np.testing.assert_allclose(states[2].of(MeanSquare).second_moment["x"], expected, rtol=1e-3)
    root = math.sqrt(expected / (1 - 0.95**3))
    rate = 0.03 if gain > 1 else 0.1
    np.testing.assert_allclose(states[2].of(Iterates).fast["x"] - begun, -rate / root, rtol=0.04)
    assert np.abs(states[1].of(Iterates).fast["x"] - states[1].of(Iterates).average["x"]).min() > 0.01


def test_noise_is_averaged_where_a_constant_rate_leaves_it():
    """A bowl under noise: more steps come closer, at a rate with which Adam stays where it is."""

    def bowl(step: int, x: np.ndarray) -> np.ndarray:
        return x - 0.3 + 2.0 * np.random.default_rng(1000 + step).normal(size=x.shape)

    def error(optimizer: Any, steps: int) -> float:
        seen, _ = descend(optimizer, np.zeros(2000), bowl, steps)
        return float(np.sqrt(np.mean((seen[-1] - 0.3) ** 2)))

    early, late = (error(ScheduleFree(0.1), steps) for steps in (100, 1600))
    constant = error(Adam(0.1), 1600)
    assert late < 0.5 * early
    assert late < 0.35 * constant


def errors_under_reused_noise(steps: int, sigma: float, independent: float) -> tuple[list[float], list[float]]:
    """Return errors before each step and factors of the rate after it, on a bowl under noise of which 95 % is reused at each step, and
    under independent noise."""
    rng, memory = np.random.default_rng(0), np.zeros(1000)

    def bowl(step: int, x: np.ndarray) -> np.ndarray:
        reused = min(0.95, step / (step + 1.0))
        memory[:] = reused * memory + (1.0 - reused) * sigma * rng.normal(size=x.shape)
        return x - 0.3 + memory + independent * rng.normal(size=x.shape)

    seen, states = descend(ScheduleFree(0.1), np.zeros(1000), bowl, steps)
    errors = [float(np.sqrt(np.mean((x - 0.3) ** 2))) for x in seen]
    return errors, [state.of(Agreement).factors["x"] for state in states]


def test_the_average_does_not_follow_an_iterate_whose_rate_falls_at_once(monkeypatch: pytest.MonkeyPatch):
    """Agreement that does not last is taken back at step 144. Where z keeps its displacement, the error first rises further."""

    def rise() -> float:
        errors, rates = errors_under_reused_noise(240, 6.0, 0.0)
        fallen = next(step for step in range(1, 240) if rates[step] < 0.5 * rates[step - 1])
        assert fallen == 144
        assert errors[fallen] > 0.9
        return max(errors[fallen:]) / errors[fallen]

    assert rise() < 1.02
    monkeypatch.setattr(agreement_rate, "_FALL", 0.0)
    assert rise() > 1.4


def test_steps_are_shorter_where_reused_noise_adds_up(monkeypatch: pytest.MonkeyPatch):
    """The error over the limit, the noise of a step over the root of the steps: 1.42, without the inflation of the noise 1.70."""
    limit = math.hypot(3.0, 0.75) / math.sqrt(512)
    inflated = errors_under_reused_noise(512, 3.0, 0.75)[0][-1]
    monkeypatch.setattr(lasting_agreement, "_inflation", lambda *args: 1.0)
    assert inflated < 1.5 * limit
    assert inflated < 0.88 * errors_under_reused_noise(512, 3.0, 0.75)[0][-1]


def test_steps_are_longer_where_noise_hides_a_signal_that_lasts(monkeypatch: pytest.MonkeyPatch):
    """A flat bowl under independent noise, which successive gradients hardly share: errors of 0.25 and 0.54."""

    def error() -> float:
        rng = np.random.default_rng(0)
        seen, _ = descend(ScheduleFree(0.03), np.zeros(500), lambda _, x: 0.2 * (x - 1.0) + rng.normal(size=500), 600)
        return float(np.sqrt(np.mean((seen[-1] - 1.0) ** 2)))

    longer = error()
    monkeypatch.setattr(lasting_agreement, "_PERSISTENT", 2.0)
    assert longer < 0.55 * error()


def test_parameters_at_a_bound_leave_it_as_soon_as_the_gradient_turns():
    """50 steps into the bound are no debt: 5 back lead as far from it as 5 from a start there."""

    def gradient(step: int, x: np.ndarray) -> np.ndarray:
        return np.full_like(x, 1.0 if step < 50 else -1.0)

    seen, _ = descend(ScheduleFree(0.05, growth=0.0), np.full(2, 0.1), gradient, 56, low=0.0)
    assert (seen[50] == 0.0).all()
    assert (seen[56] > 0.02).all()


def test_the_preconditioner_acts_on_gradient_and_direction():
    smooth = Sobolev(3.0)
    optimizer = ScheduleFree(0.1, preconditioner=smooth, preconditioned=("x",))
    g = np.random.default_rng(0).normal(size=(6, 5, 1))
    _, states = descend(optimizer, np.zeros((6, 5, 1)), lambda step, x: g, 1)
    inner = smooth.apply(g.astype(np.float32))
    expected = -0.05 * smooth.apply(inner / (np.abs(inner) + 1e-12))
    np.testing.assert_allclose(states[0].of(Iterates).fast["x"], expected, rtol=1e-4, atol=1e-7)
    plain = ScheduleFree(0.1, preconditioner=smooth)
    _, states = descend(plain, np.zeros((6, 5, 1)), lambda step, x: g, 1)
    np.testing.assert_allclose(states[0].of(Iterates).fast["x"], -0.05 * np.sign(g), rtol=1e-6)


def test_steps_are_as_long_as_the_share_of_signal_in_their_neighbourhood(monkeypatch: pytest.MonkeyPatch):
    """The second step against its formula, at full strength: a fifth of what two gradients tell, the rest is not known yet."""
    monkeypatch.setattr(fitted_sobolev, "_LEAST_DESCENT", 0.0)
    smooth = Sobolev(3.0)
    optimizer = ScheduleFree(0.1, preconditioner=smooth, preconditioned=("x",), growth=0.0, decay=0.0)
    gradients = np.random.default_rng(0).normal(size=(2, 6, 5, 2)).astype(np.float32)
    gradients[1] += 0.8 * gradients[0]
    _, states = descend(optimizer, np.zeros((6, 5, 2)), lambda step, x: gradients[step], 2)
    g, h = (np.asarray(smooth.apply(gradient), np.float64) for gradient in gradients)
    product, square = (smooth.apply(smooth.apply(x.mean(axis=-1, keepdims=True))) for x in (g * h, (g * g + h * h) / 2))
    assert product.min() > 0
    share = 0.2 * np.minimum(product / square, 1) + 0.8
    second = (0.95 * 0.05 * g * g + 0.05 * h * h) / (1 - 0.95**2)
    moved = states[1].of(Iterates).fast["x"] - states[0].of(Iterates).fast["x"]
    np.testing.assert_allclose(moved, -0.1 * smooth.apply(h / np.sqrt(second)) * share, rtol=1e-3, atol=1e-6)
    _, states = descend(replace(optimizer, wiener=False), np.zeros((6, 5, 2)), lambda step, x: gradients[step], 2)
    assert states[1].of(GradientProducts).product == states[1].of(GradientProducts).square == {}
    moved = states[1].of(Iterates).fast["x"] - states[0].of(Iterates).fast["x"]
    np.testing.assert_allclose(moved, -0.1 * smooth.apply(h / np.sqrt(second)), rtol=1e-3, atol=1e-6)


def test_texels_that_nothing_is_told_of_stay_where_they_are():
    """One half of a texture has a gradient, the other noise: only without the share of signal does it walk."""

    def gradient(step: int, x: np.ndarray) -> np.ndarray:
        found = np.random.default_rng(step).normal(size=x.shape)
        found[:, :16] = np.sign(x[:, :16] - 1.0)
        return found

    def walked(wiener: bool) -> tuple[float, float]:
        options: dict[str, Any] = {"preconditioner": Sobolev(4.0), "preconditioned": ("x",), "wiener": wiener}
        optimizer = ScheduleFree(0.02, **options, decay=0.0, growth=0.0)
        seen, _ = descend(optimizer, np.zeros((32, 32, 1)), gradient, 60)
        return float(np.sqrt(np.mean(seen[-1][:, 20:] ** 2))), float(np.median(seen[-1][:, :12]))

    noise_of, signal_of = walked(True)
    noise_without, signal_without = walked(False)
    assert noise_of < 0.4 * noise_without
    assert signal_of > 0.7 * signal_without > 0.3


def test_a_pull_keeps_what_pictures_hardly_show_from_making_up_for_errors_of_others():
    """A sky adds little to the pixels of a wall that is too bright at first. Adam darkens both."""

    def ends(pulled: dict[str, float]) -> dict[str, float]:
        random = np.random.default_rng(1)
        seen, truth = 0.01 * random.uniform(size=(64, 8)), {"wall": np.full(64, 0.3), "sky": np.full(8, 0.1)}
        x = {"wall": np.full(64, 0.8), "sky": np.zeros(8)}
        optimizer = ScheduleFree(0.1, pulled=pulled)
        state = optimizer.init(x)
        for _ in range(150):
            away = x["wall"] - truth["wall"] + seen @ (x["sky"] - truth["sky"]) + 0.02 * random.normal(size=64)
            gradient = {"wall": 2 * away / 64, "sky": 2 * seen.T @ away / 64}
            found, state = optimizer.update(Estimate(float(np.mean(away * away)), gradient), state, x)
            x = {key: value + found[key] for key, value in x.items()}
        return {key: float(np.sqrt(np.mean((value - truth[key]) ** 2))) for key, value in x.items()}

    free, pulled = ends({}), ends({"sky": 2 / (64 * 0.7**2)})
    assert pulled["sky"] < 0.7 * free["sky"]
    assert pulled["wall"] < free["wall"]


def test_a_pull_is_the_derivative_of_a_normal_distribution_and_acts_on_new_gradients_too():
    start, here = {"x": np.array([1.0, 2.0])}, {"x": np.array([1.5, 0.0])}
    pull = PullToStart({"x": 0.25})
    estimate = Estimate(4.0, {"x": np.zeros(2)}, (FreshGradient({"x": np.ones(2)}),))
    update = StepUpdate(estimate, here, 0, {"x": 0.1}, estimate.gradient, estimate.gradient)
    found, _ = pull.update(update, pull.init(start, {}))
    for values, added in (
        (found.gradient, 0.0),
        (found.direction, 0.0),
        (found.estimate.require("test", FreshGradient).values, 1.0),
    ):
        np.testing.assert_allclose(values["x"], np.array([0.5, -2.0]) + added)


def test_rates_of_their_own():
    optimizer = ScheduleFree({"*": 0.1, "b": 3.0, "c": 5.0})
    state = optimizer.init({"a": np.zeros(2), "b": np.zeros(2), "c": np.zeros(2)}, {"c": 7.0})
    assert state.learning_rates == {"a": 0.1, "b": 3.0, "c": 7.0}


def test_it_is_stored_and_made_again():
    optimizer = ScheduleFree(
        {"*": 0.1, "a.b": 3.0}, decay=1.0, schedule=Cosine(10), preconditioner=Sobolev(), preconditioned=("a.b",)
    )
    assert tables.component(tables.table(optimizer)) == optimizer


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"learning_rate": 0.0}, "learning_rate"),
        ({"learning_rate": {"a": 0.1}}, "needs a rate for the other parameters"),
        ({"learning_rate": {"*": -1.0}}, "learning_rate"),
        ({"beta": 1.0}, "beta"),
        ({"beta_2": -0.1}, "beta_2"),
        ({"decay": -1.0}, "decay"),
        ({"growth": -1.0}, "growth"),
        ({"averaging": float("nan")}, "averaging"),
        ({"preconditioned": "key"}, "preconditioned must be keys"),
    ],
)
def test_refuses_options(options: dict[str, Any], message: str):
    with pytest.raises(InputError, match=message):
        ScheduleFree(**options)


def test_refuses_parameters_that_do_not_suit():
    x = {"x": np.zeros(3)}
    with pytest.raises(InputError, match='unknown parameter "y"'):
        ScheduleFree(preconditioner=Sobolev(), preconditioned=("y",)).init(x)
    with pytest.raises(InputError, match="needs a texture"):
        ScheduleFree(preconditioner=Sobolev(), preconditioned=("x",)).init(x)
    with pytest.raises(InputError, match='unknown parameter "y"'):
        ScheduleFree({"*": 0.1, "y": 0.2}).init(x)


def within_bounds(wanted: Callable[[int], np.ndarray], steps: int, known: bool) -> np.ndarray:
    """Return the parameter after some steps towards `wanted(step)` within [0, 1], with bounds known to the optimizer or not."""
    x = np.full(wanted(0).shape, 0.4)
    optimizer = ScheduleFree(0.1, preconditioner=Sobolev(), preconditioned=("x",))
    state = optimizer.init({"x": x})
    for number in range(steps):
        at = AtBounds(lambda x=x: {"x": np.where(x >= 1.0, 1.0, np.where(x <= 0.0, -1.0, 0.0))})
        estimate = Estimate(0.0, {"x": x - wanted(number)}, (at,) if known else ())
        step, state = optimizer.update(estimate, state, {"x": x})
        x = np.clip(x + step["x"], 0.0, 1.0)
    return x


@pytest.mark.parametrize("known", [True, False])
def test_texels_beside_saturated_ones_are_not_led_astray(known: bool):
    """A square whose minimum is above the upper bound. Its gradient remains, and smoothing spreads it where bounds are unknown."""
    wanted = np.full((16, 16, 1), 0.5)
    wanted[4:9, 4:9] = 1.6
    error = float(np.abs(within_bounds(lambda step: wanted, 160, known) - np.minimum(wanted, 1.0)).max())
    assert error < 0.02 if known else error > 0.2


def test_texels_leave_a_bound_as_soon_as_their_gradient_turns_in_the_first_steps():
    """As those of a texture beside a lamp that starts too dim do, when the lamp becomes bright."""

    def wanted(step: int) -> np.ndarray:
        return np.full((16, 16, 1), 1.6 if step < 20 else 0.5)

    saturated, known, unknown = (within_bounds(wanted, *of) for of in ((20, True), (40, True), (40, False)))
    assert saturated.min() == 1.0
    assert known.max() < 0.95
    np.testing.assert_array_equal(known, unknown)


def test_states_stored_without_the_mean_gradient_go_on():
    """As checkpoints of versions before it: they have the form of a state, and the mean begins with the next gradient."""
    optimizer, x = ScheduleFree(0.1, preconditioner=Sobolev(), preconditioned=("x",)), {"x": np.full((8, 8, 1), 0.4)}
    fresh = optimizer.init(x)
    after = optimizer.update(Estimate(0.0, {"x": x["x"] - 1.0}), fresh, x)[1]
    stored = [replace(part, mean={}) if isinstance(part, FittedSobolevState) else part for part in after.states]
    stored = replace(after, states=tuple(stored))
    check_alike(stored, [fresh, after])
    again = optimizer.update(Estimate(0.0, {"x": x["x"] - 1.0}), stored, x)[1]
    check_alike(again, [after])
    np.testing.assert_allclose(again.of(FittedSobolevState).mean["x"], -0.06)
