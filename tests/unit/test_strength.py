"""How strongly gradients are smoothed: closed forms, and what is chosen for detail, for regions, for noise."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from unrender.estimators.base import Estimate
from unrender.optimizers import ScheduleFree
from unrender.optimizers.transforms import fitted_sobolev
from unrender.optimizers.transforms.fitted_sobolev import STEPS, FittedSobolevState, StrengthFit
from unrender.preconditioners import LargeSteps, Sobolev

SHAPE = (32, 32, 1)
BOARD = (np.indices(SHAPE[:2]).sum(0)[..., None] % 2 * 2.0 - 1.0).astype(np.float32)


def normal(seed: int, shape: tuple[int, ...] = SHAPE) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=shape).astype(np.float32)


def fitted(gradient: Callable[[int], np.ndarray], steps: int = STEPS) -> StrengthFit:
    """After the gradients of a function of the step."""
    smooth = Sobolev()
    fit, previous = StrengthFit(), smooth.apply(gradient(0))
    for step in range(1, steps + 1):
        found = gradient(step)
        fit = fit.after(smooth, previous, found)
        previous = smooth.scaled(fit.share).apply(found)
    return fit


@pytest.mark.parametrize("wrap", [False, True, (True, False)])
def test_descents_are_products_of_smoothed_gradients(wrap: bool | tuple[bool, ...]):
    smooth, shares = Sobolev(6.0, wrap), np.array([1.0, 0.25, 0.0])
    one, other = normal(0, (9, 7, 2)), normal(1, (9, 7, 2))
    found = smooth.descents(smooth.apply(one), other, shares)
    for share, (product, square) in zip(shares, found.T, strict=True):
        smoothed, as_much = (Sobolev(6.0 * share, wrap).apply(x).astype(float) for x in (one, other))
        assert product == pytest.approx((smoothed * as_much).sum(), rel=1e-3, abs=1e-3)
        assert square == pytest.approx((smoothed * smoothed).sum(), rel=1e-4)


def test_a_share_of_the_strength_is_that_of_a_given_and_of_a_found_one():
    assert Sobolev(8.0).scaled(0.25) == Sobolev(2.0)
    assert Sobolev().scaled(0.25).strength_of(SHAPE) == pytest.approx(0.25 * Sobolev().strength_of(SHAPE))


def test_regions_and_noise_keep_the_strength_and_detail_takes_it_away():
    assert fitted(lambda step: np.ones(SHAPE, np.float32)).share == 1.0
    assert fitted(lambda step: 0.2 + normal(step)).share == 1.0
    assert fitted(lambda step: BOARD).share < 0.1
    assert fitted(lambda step: np.zeros(SHAPE, np.float32)).share == 1.0
    assert fitted(lambda step: (-1.0) ** step * BOARD).share == 1.0, "gradients that contradict each other tell nothing"


def test_the_share_is_where_steps_descend_by_the_least():
    """A gradient of white noise that stays: its descent by the share chosen, over that by the least smoothing."""
    signal, smooth = normal(5), Sobolev()
    fit = fitted(lambda step: signal)
    assert 0.01 < fit.share < 0.9
    product, square = smooth.descents(smooth.apply(signal), signal, np.array([fit.share, 0.25 ** (len(fit.sums) - 1)]))
    chosen, weakest = product / np.sqrt(square)
    assert chosen == pytest.approx(0.55 * weakest, rel=0.1)


def test_it_is_fitted_to_the_first_gradients_alone():
    def turning(step: int) -> np.ndarray:
        return np.ones(SHAPE, np.float32) if step <= STEPS else BOARD

    assert fitted(turning, 3 * STEPS).share == 1.0
    assert fitted(turning, 3 * STEPS).count == STEPS


def remembered(step: int) -> np.ndarray:
    """Detail and the noise that an image remembers: it changes by a twentieth from step to step."""
    found = normal(0)
    for n in range(1, step + 1):
        found = 0.95 * found + np.sqrt(1 - 0.95**2) * normal(n)
    return found.astype(np.float32)


def watched(
    detail: float, memory: float, rows: int = 2, late: float = 1.0, scales: tuple[float, ...] = (1.0, 1.0, 1.0)
) -> list[StrengthFit]:
    """First of constant gradients, then of a checkerboard under remembered noise; fresh gradients do not have that noise, but their own.

    In the last row the detail has become `late` of itself; `scales` are of all gradients in each row.
    """
    smooth = Sobolev()
    fits = [fitted(lambda step: np.ones(SHAPE, np.float32))]
    for row in range(rows):
        now = detail * (late if row == rows - 1 else 1.0) * scales[row]
        kept = memory * scales[row]
        previous = smooth.scaled(fits[-1].share).apply(now * BOARD + kept * remembered(0))
        fit = fits[-1]
        for step in range(1, 9):
            found = now * BOARD + kept * remembered(step)
            noise = 3.0 * scales[row] * normal(1000 * (row + 1) + step)
            fit = fit.after(smooth, previous, found, now * BOARD + noise)
            previous = smooth.scaled(fit.share).apply(found)
        fits.append(fit)
    return fits


def test_detail_that_fresh_samples_confirm_is_no_longer_smoothed_away():
    first, second, _ = watched(1.0, 0.3)
    assert first.share == 1.0
    assert second.share < 0.1
    squares = (np.square(Sobolev().scaled(fit.share).apply(BOARD)).sum() for fit in (first, second))
    assert second.gain == pytest.approx(1 / np.divide(*squares), rel=0.5), "steps by a gradient that has so grown"


def test_detail_that_falls_in_smoothed_steps_too_is_left_to_them(monkeypatch: pytest.MonkeyPatch):
    """A third of the first gradients is less than step^(-3/4) leaves of them; what then stays waits, what has halved again does not."""
    assert [fit.share < 0.1 for fit in watched(0.3, 0.03)] == [False, False, True]
    assert [fit.share for fit in watched(0.3, 0.03, late=0.5)] == [1.0] * 3
    monkeypatch.setattr(fitted_sobolev, "_SLOWEST", 2.0)
    assert watched(0.3, 0.03, late=0.5)[1].share < 0.1, "without that condition"


def test_little_that_is_left_is_not_worth_the_noise_of_single_texels(monkeypatch: pytest.MonkeyPatch):
    """Detail that waits, of a tenth and of a thirtieth of the first gradients."""
    assert watched(0.3, 0.03, scales=(0.4, 0.4, 0.4))[-1].share < 0.1
    assert [fit.share for fit in watched(0.3, 0.03, scales=(0.1, 0.1, 0.1))] == [1.0] * 3
    monkeypatch.setattr(fitted_sobolev, "_LEAST_LEFT", 0.0)
    assert watched(0.3, 0.03, scales=(0.1, 0.1, 0.1))[-1].share < 0.1, "without that condition"


def test_noise_that_gradients_agree_on_is_no_detail(monkeypatch: pytest.MonkeyPatch):
    assert [fit.share for fit in watched(0.0, 1.0)] == [1.0] * 3
    assert [fit.share for fit in watched(0.7, 1.0)] == [1.0] * 3, "two thirds of it are noise remembered"
    monkeypatch.setattr(fitted_sobolev, "_CONFIRMED", 0.1)
    monkeypatch.setattr(fitted_sobolev, "_REVERTED", 0.1)
    assert watched(0.7, 1.0)[-1].share < 0.1, "without the share that has to be confirmed"


def test_fresh_gradients_that_are_not_finite_are_left_out():
    fit = watched(0.0, 1.0, rows=1)[-1]
    broken = np.where(BOARD > 0, np.nan, BOARD).astype(np.float32)
    for bad in (broken, np.float32(np.inf) * BOARD):
        after = fit.after(Sobolev(), BOARD, BOARD, bad)
        assert len(after.fresh) == len(fit.fresh)
        assert after.unjudged == 0
    after = fit.after(Sobolev(), 0 * BOARD, BOARD, BOARD)
    assert len(after.fresh) == len(fit.fresh), "nor do gradients of nothing count"


def test_gradients_that_have_become_smaller_count_as_much():
    """Noise alone, a hundredth as large as the detail that was there first: the last row decides."""
    steady, faded = (watched(0.4, 1.0, late=0.0, scales=(1.0, scale)) for scale in (1.0, 0.01))
    assert faded[-1].confirmed == pytest.approx(steady[-1].confirmed, rel=0.2)
    assert faded[-1].confirmed < faded[-2].confirmed


def test_where_gradients_contradict_one_another_there_is_nothing_to_refute():
    *_, fit = watched(1.0, 0.3)
    assert fit.share < 0.1
    smooth = Sobolev()
    for step in range(8):
        found = (-1.0) ** step * BOARD
        fit = fit.after(smooth, smooth.scaled(fit.share).apply(-found), found, found)
    assert fit.share < 0.1
    assert fit.confirmed == 1.0


def test_what_gradients_agree_on_counts_as_far_as_fresh_samples_confirm_it():
    confirmed = [watched(detail, 1.0)[-1].confirmed for detail in (0.0, 0.5)]
    assert confirmed[0] < 0.3
    assert confirmed[0] < confirmed[1]
    assert watched(1.0, 0.0, rows=1)[-1].confirmed == 1.0


def test_smoothing_returns_when_fresh_samples_show_no_detail_any_more():
    *_, before, after = watched(1.0, 0.3, rows=3, late=0.0)
    assert before.share < 0.1
    assert after.share == 1.0
    assert after.gain < 0.1


def test_a_checkerboard_is_recovered():
    """A bowl whose minimum alternates from texel to texel, by 60 steps; by full strength most of it is still missing."""

    def error(optimizer: ScheduleFree) -> float:
        x = {"x": np.full(SHAPE, 0.5, np.float32)}
        state = optimizer.init(x)
        truth = 0.5 + 0.4 * BOARD
        for _ in range(60):
            steps, state = optimizer.update(Estimate(0.0, {"x": x["x"] - truth}), state, x)
            x = {"x": np.clip(x["x"] + steps["x"], 0, 1)}
        return float(np.sqrt(np.mean((x["x"] - truth) ** 2)))

    chosen = error(ScheduleFree(0.1, preconditioner=Sobolev(), preconditioned=("x",)))
    full = error(ScheduleFree(0.1, preconditioner=LargeSteps(Sobolev().strength_of(SHAPE)), preconditioned=("x",)))
    assert full > 0.3
    assert chosen < 0.05


def test_the_optimizer_says_what_it_has_chosen():
    optimizer = ScheduleFree(0.1, preconditioner=Sobolev(), preconditioned=("x",))
    x = {"x": np.full(SHAPE, 0.5, np.float32), "y": np.zeros(2, np.float32)}
    state = optimizer.init(x)
    assert optimizer.choices(state) == ()
    for _ in range(3):
        _, state = optimizer.update(Estimate(0.0, {"x": BOARD, "y": np.ones(2, np.float32)}), state, x)
    smoothing, rate = optimizer.choices(state)
    assert (
        smoothing
        == f"smoothing, as a share of the strongest: x {state.of(FittedSobolevState).strengths['x'].share:.2g}"
    )
    assert rate == "learning rate, over the first: x 1.2, y 1.1"
