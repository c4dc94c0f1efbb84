"""Rules of control weights in the benchmarks, against closed forms: on scenes at rest all are known, of heuristics everywhere."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import unrender as ur
from benchmarks import weight_rules
from benchmarks.rcv.fig12_start import run as start
from benchmarks.weight_rules import RULES, Simulated, one_run
from tests.analytic import AnalyticRenderer

STEPS = 9


def problem() -> ur.Problem:
    """Noise that grows with the parameter, and noise that does not."""
    matrix = np.random.default_rng(0).uniform(0.2, 1.0, (36, 1))
    renderer = AnalyticRenderer({"x": np.array([0.5])}, matrix, noise=0.6, grain=0.2, shape=(3, 4))
    return ur.Problem(renderer, [ur.Parameter("x", initial=0.5)], [ur.View(renderer.exact({"x": np.array([0.5])}))])


def at_rest() -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    asked = problem()
    return one_run(asked, [asked.initial()] * STEPS, 2, seed=3)


def test_at_rest_every_weight_and_image_is_known() -> None:
    images, weights = at_rest()
    plain = images["plain"]
    means = np.cumsum(plain, axis=0) / np.arange(1, STEPS + 1)[:, None, None, None]
    steps = np.arange(STEPS)[:, None, None, None]
    for rule in ("analytic", "greater"):
        np.testing.assert_allclose(images[rule], means, rtol=1e-9)
        np.testing.assert_allclose(weights[rule], np.broadcast_to(steps / (steps + 1), plain.shape), rtol=1e-9)
    np.testing.assert_allclose(images["one"], np.broadcast_to(plain[0], plain.shape), rtol=1e-9)
    # Without statistics the paper's weights are 0 at steps 1 and 2: what was rendered before step 2 is lost.
    late = np.maximum(steps - 2, 0) / np.maximum(steps - 1, 1)
    np.testing.assert_allclose(weights["relative"], np.broadcast_to(late, plain.shape), rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(images["relative"][-1], plain[2:].mean(axis=0), rtol=1e-9)


def test_weights_a_tenth_too_small_are_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    right = Simulated._weight
    monkeypatch.setattr(Simulated, "_weight", lambda self, F: 0.9 * right(self, F))
    with pytest.raises(AssertionError):
        test_at_rest_every_weight_and_image_is_known()


def test_moving_a_weight_of_one_is_a_sum_of_differences() -> None:
    asked = problem()
    path: list[Any] = [{"x": np.array([0.5 + 0.1 * step])} for step in range(STEPS)]
    images, weights = one_run(asked, path, 2, seed=5, rules=("plain", "one"))
    renderer: Any = asked.renderer
    pairs = weight_rules._pairs(renderer, 0, path, 2, 5)
    expected = pairs[0][0] + sum(F - H for F, H in pairs[1:])
    np.testing.assert_allclose(images["one"][-1], expected, rtol=1e-9)
    np.testing.assert_allclose(images["plain"][-1], pairs[-1][0])
    assert weights["one"][1:].min() == 1
    assert not weights["plain"].any()


@pytest.mark.parametrize("rule", ["online", "absolute", "relative"])
def test_statistics_find_less_to_keep_where_states_are_not_alike(rule: str) -> None:
    """F and H independent: nothing is to be gained, and the weight is small. Alike: it nears n/(n+1)."""
    rng = np.random.default_rng(0)

    def last(alike: bool) -> float:
        simulated = Simulated(rule, rng.normal(size=(20, 20, 3)))
        for _ in range(30):
            F = rng.normal(size=(20, 20, 3))
            weight = simulated.advance(F, F if alike else rng.normal(size=F.shape))
        return float(weight.mean())

    assert last(False) < 0.2
    assert last(True) > 0.75


def test_all_rules_are_told() -> None:
    for rule in RULES:
        assert f"- {rule}:" in (weight_rules.__doc__ or "")


@pytest.mark.parametrize("alpha", [0.9, 0.99])
def test_the_weights_of_both_means_sum_to_one_and_are_those_of_the_library(alpha: float) -> None:
    """Each value's weight is what the mean of a sequence of zeros with a one in its place is."""
    count = 12
    found = start.means(np.eye(count), alpha)
    for name, weights in start.WEIGHTS.items():
        assert weights(alpha, count).sum() == pytest.approx(1.0)
        np.testing.assert_allclose(found[name][:, -1], weights(alpha, count), rtol=1e-9)
    assert start.first_kept(alpha, count)[0] == pytest.approx(alpha ** (count - 1))
    assert start.forgotten_after(alpha, "first kept") > 2 * start.forgotten_after(alpha, "corrected")
    assert not np.allclose(start.first_kept(alpha, count), start.corrected(alpha, count), rtol=0.1)
