"""Transforms of steps: every registered one by one contract, and chains against the recipes and formulas that they are."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from unrender.core import registry, tables
from unrender.core.errors import InputError
from unrender.estimators.base import Estimate
from unrender.estimators.capabilities import NoiseSample, Variance
from unrender.optimizers import Adam, AveragedNewton, Chain, Partitioned, ScheduleFree
from unrender.optimizers.transforms import (
    AgreementRate,
    ApplyPreconditioner,
    ClipDirection,
    DecayingSum,
    FittedSobolev,
    GradientMean,
    LastingAgreement,
    PullToStart,
    ScaleByDeviation,
    ScaleByRms,
    ScheduleFreeAverage,
    WienerShrinkage,
)
from unrender.optimizers.transforms.agreement_rate import Agreement
from unrender.optimizers.transforms.base import SmoothingChange, StepUpdate, checked_keys
from unrender.optimizers.transforms.lasting_agreement import GradientBlocks
from unrender.preconditioners import Sobolev
from unrender.runs.folder.state import Packed, check_alike, pack, unpack
from unrender.scene.upsampling import NotCarried, restarted, upsampled
from unrender.schedules import Cosine

SMOOTH = FittedSobolev(Sobolev(2.0), ("map",))
CHAINS: dict[str, Callable[[], tuple[Any, ...]]] = {
    "AgreementRate": lambda: (FittedSobolev(), AgreementRate()),
    "ApplyPreconditioner": lambda: (SMOOTH, ApplyPreconditioner()),
    "ClipDirection": lambda: (ClipDirection(0.5),),
    "DecayingSum": lambda: (DecayingSum(0.5),),
    "FittedSobolev": lambda: (SMOOTH,),
    "GradientMean": lambda: (GradientMean(),),
    "LastingAgreement": lambda: (SMOOTH, LastingAgreement(2), AgreementRate()),
    "PullToStart": lambda: (PullToStart({"map": 0.1}), ScaleByRms()),
    "ScaleByDeviation": lambda: (ScaleByDeviation(),),
    "ScaleByRms": lambda: (ScaleByRms(long_memory=True),),
    "ScheduleFreeAverage": lambda: (ScaleByRms(), ScheduleFreeAverage()),
    "WienerShrinkage": lambda: (SMOOTH, WienerShrinkage(("map",))),
}
"""{a registered transform: a chain that it is part of}."""

START = {"map": np.full((5, 4, 2), 0.5, np.float32), "number": np.full(1, 0.2, np.float32)}


def estimates(steps: int, seed: int = 0) -> list[Estimate]:
    rng = np.random.default_rng(seed)
    found = []
    for _ in range(steps):
        gradient = {key: rng.normal(0.3, 1.0, x.shape).astype(np.float32) for key, x in START.items()}
        variance = Variance({key: np.full_like(x, 0.5) for key, x in START.items()})
        found.append(Estimate(0.0, gradient, (variance,)))
    return found


def take(optimizer: Any, given: list[Estimate], state: Any = None, x: Any = None) -> tuple[list[Any], Any, Any]:
    """Steps, state and parameters after the estimates."""
    x = dict(START) if x is None else x
    state = optimizer.init(x) if state is None else state
    made = []
    for estimate in given:
        steps, state = optimizer.update(estimate, state, x)
        x = {key: x[key] + steps[key] for key in x}
        made.append(steps)
    return made, state, x


def same(one: Any, other: Any) -> None:
    for key in one:
        np.testing.assert_array_equal(one[key], other[key])


def test_every_registered_transform_is_here() -> None:
    own = {name for name, kind in registry.components("step transform").items() if "unrender" in kind.__module__}
    assert own == set(CHAINS)


@pytest.mark.parametrize("name", CHAINS)
def test_an_update_is_pure_and_finite_and_of_the_parameters_shapes(name: str) -> None:
    chain = Chain(CHAINS[name](), 0.1)
    _, state, x = take(chain, estimates(5))
    (estimate,) = estimates(1, seed=9)
    steps, after = chain.update(estimate, state, x)
    again, repeated = chain.update(estimate, state, x)
    same(steps, again)
    assert repr(after) == repr(repeated)
    assert after.step == 6
    for key, step in steps.items():
        assert step.shape == START[key].shape
        assert np.isfinite(step).all()


@pytest.mark.parametrize("name", CHAINS)
def test_a_chain_goes_on_from_its_table_and_its_checkpoint(name: str) -> None:
    chain = Chain(CHAINS[name](), {"*": 0.1, "number": 0.02}, Cosine(20))
    made = tables.component(json.loads(json.dumps(tables.table(chain))))
    assert made == chain
    whole, _, _ = take(chain, estimates(9))
    _, state, x = take(chain, estimates(9)[:4])
    packed = pack(state)
    stored = unpack(Packed(json.loads(json.dumps(packed.skeleton)), packed.tensors))
    check_alike(stored, [state])
    same(take(made, estimates(9)[4:], stored, x)[0][-1], whole[-1])


@pytest.mark.parametrize("name", CHAINS)
def test_a_chain_that_starts_anew_makes_a_first_step(name: str) -> None:
    """The schedule goes on, and a pull keeps its start. Everything else is as before the first step."""
    chain = Chain(CHAINS[name](), 0.1)
    _, state, x = take(chain, estimates(5))
    fresh, first = restarted(state, chain.init(x)), chain.init(x)
    assert (fresh.step, fresh.begun) == (5, 5)
    if name == "PullToStart":
        first = replace(first, states=(state.states[0], *first.states[1:]))
    (estimate,) = estimates(1, seed=3)
    same(chain.update(estimate, fresh, x)[0], chain.update(estimate, first, x)[0])


def test_adam_is_a_mean_over_a_root_mean_square() -> None:
    chain = Chain((GradientMean(0.9), ScaleByRms(0.999)), 0.01)
    same(take(chain, estimates(6))[2], take(Adam(0.01), estimates(6))[2])
    swapped = Chain((ScaleByRms(0.999), GradientMean(0.9)), 0.01)
    assert np.abs(take(swapped, estimates(6))[2]["map"] - take(chain, estimates(6))[2]["map"]).max() > 1e-4


def test_elements_of_uniform_keys_are_all_divided_by_the_largest_root() -> None:
    """An element of a thousandth of the largest gradient moves by a thousandth of its step, not by as much."""
    gradient = np.array([1.0, 1e-3], np.float32)
    for keys, ratio in (((), 1.0), (("list",), 1e-3)):
        recipe = ScheduleFree(0.1, uniform=keys)
        start = {"list": np.zeros(2, np.float32)}
        steps, _ = recipe.update(Estimate(1.0, {"list": gradient}), recipe.init(start), start)
        assert steps["list"][1] / steps["list"][0] == pytest.approx(ratio, rel=1e-4)
    with pytest.raises(InputError, match="uniform"):
        ScheduleFree(uniform=("other",)).init({"list": np.zeros(2, np.float32)})


def test_schedule_free_is_its_chain() -> None:
    smooth = Sobolev(2.0)
    recipe = ScheduleFree(0.1, preconditioner=smooth, preconditioned=("map",))
    parts = (
        FittedSobolev(smooth, ("map",)),
        LastingAgreement(),
        AgreementRate(),
        ScaleByRms(0.95, 1e-12, long_memory=True),
        ApplyPreconditioner(),
        WienerShrinkage(("map",)),
        ScheduleFreeAverage(),
    )
    same(take(Chain(parts, 0.1), estimates(8))[2], take(recipe, estimates(8))[2])


def reused(memory: float, signal: float, steps: int, parts: tuple[Any, ...]) -> Any:
    """Return the state of a chain after gradients of a constant signal and of noise that fades by `memory` a step."""
    rng, noise = np.random.default_rng(1), np.zeros((16, 16, 1), np.float32)
    start = {"map": noise}
    chain = Chain(parts, 1e-3)
    state = chain.init(start)
    for _ in range(steps):
        noise = memory * noise + np.sqrt(1 - memory**2) * rng.normal(0.0, 1.0, noise.shape).astype(np.float32)
        _, state = chain.update(Estimate(0.0, {"map": signal + noise}), state, start)
    return state


def lasting(signal: float, memory: float) -> float:
    parts = (FittedSobolev(), LastingAgreement(64))
    return reused(memory, signal, 400, parts).of(GradientBlocks).fractions["map"]


def test_noise_that_gradients_reuse_does_not_last() -> None:
    assert abs(lasting(0.0, 0.9)) < 0.1
    assert lasting(3.0, 0.9) == pytest.approx(9.0 / 9.9, abs=0.05)
    assert lasting(0.5, 0.9) == pytest.approx(0.25 / 1.15, abs=0.1)
    assert lasting(0.0, 0.999) > 0.5, "noise that lasts as long as blocks cannot be told from a signal"


def inflation(signal: float, memory: float) -> float:
    return reused(memory, signal, 400, (FittedSobolev(), LastingAgreement(64))).of(GradientBlocks).inflations["map"]


def test_the_inflation_of_noise_is_that_of_its_mean_over_a_block() -> None:
    """The last block has 66 gradients, and half of the weight. Sum of the correlations of noise that fades by 0.9 a step. Its relative
    standard error is 0.09 for the 256 elements of one block, and 0.06 to 0.07 for the mean of three."""
    lags = np.arange(-65, 66)
    expected = float(((1.0 - np.abs(lags) / 66.0) * 0.9 ** np.abs(lags)).sum())
    assert expected == pytest.approx(16.3, abs=0.1)
    for signal in (0.0, 0.5):
        assert inflation(signal, 0.9) == pytest.approx(expected, rel=0.25)
    assert inflation(0.0, 0.0) < 1.15


def growth(signal: float, memory: float) -> float:
    return reused(memory, signal, 600, (FittedSobolev(), LastingAgreement())).of(GradientBlocks).growths["map"]


def test_the_rate_grows_where_blocks_agree_and_not_with_noise() -> None:
    """Of the squared means over 48 to 100 steps a signal of 0.15 is a half to 0.7, while successive gradients correlate by 0.02."""
    assert growth(0.0, 0.0) == 0.0
    assert growth(0.0, 0.9) < 0.1
    assert 2.0 < growth(0.15, 0.0) < 5.0


def test_the_rate_decays_although_gradients_reuse_noise() -> None:
    with_it, without = (
        reused(0.95, 0.0, 900, parts).of(Agreement).log_rate["map"]
        for parts in ((FittedSobolev(), LastingAgreement(), AgreementRate()), (FittedSobolev(), AgreementRate()))
    )
    assert with_it < without - 0.5
    steps = (FittedSobolev(), LastingAgreement(), AgreementRate())
    assert reused(0.95, 3.0, 900, steps).of(Agreement).log_rate["map"] > 0.9, "a signal that lasts"


def test_what_agreement_added_to_the_rate_is_taken_back_if_it_does_not_last() -> None:
    """After noise that gradients reuse, the rate is near that after independent noise: at most a fifth of the growth is left, two standard
    errors of the lasting fraction among 256 elements and its own error. A signal keeps what its agreement added."""
    steps = (FittedSobolev(), LastingAgreement(), AgreementRate())
    early, late, independent = (
        reused(memory, 0.0, count, steps).of(Agreement).log_rate["map"]
        for memory, count in ((0.95, 120), (0.95, 500), (0.0, 500))
    )
    assert early > independent + 3.0, "agreement is taken for a signal until it is known not to last"
    assert late < np.log(np.exp(independent) + 0.2 * np.exp(early))
    signal = reused(0.0, 3.0, 500, steps).of(Agreement)
    assert signal.log_rate["map"] == pytest.approx(signal.log_most["map"], abs=0.1)


def test_the_first_rate_is_longer_the_less_noise_the_first_gradient_has() -> None:
    """The noise in the first step is at most a sixth of an unchanged step, up to a factor of 3; few elements tell nothing of noise."""
    rng, start = np.random.default_rng(0), {"map": np.zeros((16, 16, 1)), "few": np.zeros(3)}
    gradient = {key: np.ones_like(x) for key, x in start.items()}
    chain = Chain((FittedSobolev(), AgreementRate()), 0.1)

    def first_step(noise: float) -> tuple[float, float]:
        sample = {key: noise * np.sign(rng.normal(size=x.shape)) for key, x in start.items()}
        steps, state = chain.update(Estimate(0.0, gradient, (NoiseSample(sample),)), chain.init(start), start)
        again, _ = chain.update(Estimate(0.0, gradient), state, start)
        np.testing.assert_allclose(again["map"], steps["map"], rtol=0.2)
        return -float(steps["map"].mean()) / 0.1, -float(steps["few"].mean()) / 0.1

    found = {noise: first_step(noise) for noise in (0.0, 0.01, 1 / 12, 1 / 6, 2.0)}
    assert [one for one, _ in found.values()] == pytest.approx([3.0, 3.0, 2.0, 1.0, 1.0])
    assert [few for _, few in found.values()] == pytest.approx([1.0] * 5)
    steps, _ = chain.update(Estimate(0.0, gradient), chain.init(start), start)
    assert -steps["map"].mean() / 0.1 == pytest.approx(1.0), "without a sample of the noise"


def test_less_smoothing_ends_the_longer_first_rate() -> None:
    """The noise was measured in smoothed gradients."""
    update = StepUpdate(
        Estimate(0.0, {}), START, 1, dict.fromkeys(START, 0.1), START, START, previous=START,
        smoothing={"map": SmoothingChange(gain=2.0)},
    )  # fmt: skip
    part = AgreementRate()
    state = replace(part.init(START, dict.fromkeys(START, 0.1)), firsts={"map": 3.0, "number": 2.0})
    after, state = part.update(update, state)
    assert state.firsts == {"map": 1.0, "number": 2.0}
    early, late = (part.update(replace(update, made=n), state)[0].factors["number"] for n in (16, 64))
    assert late / early < 2**-0.7, "the longer rate fades"
    assert after.factors["map"] <= 0.3


def test_it_is_told_what_lasts() -> None:
    chain = Chain((FittedSobolev(), LastingAgreement(2)), 1e-3)
    state = chain.init(START)
    assert chain.choices(state) == ()
    for step in range(30):
        gradient = {"map": START["map"], "number": np.full(1, (-1) ** (step // 6), np.float32)}
        _, state = chain.update(Estimate(0.0, gradient), state, START)
    (line,) = chain.choices(state)
    assert line.startswith("agreement of gradients that lasts: number ")


def test_a_clipped_mean_is_clipped_after_debiasing() -> None:
    """The first mean is 0.1 g before debiasing: clipping that at 0.5 would let a direction of 5 pass."""
    gradient = {"x": np.array([3.0, -0.2, 9.0])}
    chain = Chain((GradientMean(0.9), ClipDirection(0.5)), 1.0)
    steps, _ = chain.update(Estimate(0.0, gradient), chain.init(gradient), gradient)
    np.testing.assert_allclose(steps["x"], [-0.5, 0.2, -0.5], rtol=1e-12)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Chain((AgreementRate(),)), "AgreementRate: no transform before it stores .* FittedSobolev"),
        (lambda: Chain((FittedSobolev(), WienerShrinkage(("map",)))), "FittedSobolev must precondition map"),
        (lambda: Chain((WienerShrinkage(("mop",)),)), 'unknown parameter "mop"'),
        (lambda: Chain((FittedSobolev(Sobolev(), ("mop",)),)), 'unknown parameter "mop"'),
        (lambda: Chain((FittedSobolev(Sobolev(), ("number",)),)), "needs a texture"),
        (lambda: Chain((Adam(),)), r"Chain: transforms: expected transforms such as ScaleByRms\(\), got Adam"),  # type: ignore
        (lambda: Chain(GradientMean()), "Chain: transforms: expected a list of transforms"),  # type: ignore
        (lambda: Chain((ScheduleFreeAverage(), ClipDirection())), "ScheduleFreeAverage sets the steps"),
        (lambda: tables.component({"type": "Chain", "transforms": [{"type": "Adam"}]}), r"transforms\[0\]: .*Adam"),
    ],
)
def test_mistakes_are_told_in_a_line(make: Callable[[], Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        take(make(), estimates(1))


def test_what_a_transform_requires_the_chain_requires() -> None:
    assert set(Chain((GradientMean(), ScaleByDeviation())).requires) == {"gradient", "variance"}
    with pytest.raises(InputError, match="variance"):
        take(Chain((ScaleByDeviation(),)), [replace(estimates(1)[0], capabilities=())])


def test_keys_are_read_once_and_nothing_else_is_accepted() -> None:
    assert checked_keys("A: keys", (key for key in "ab")) == ("a", "b")
    for keys in (5, None, "ab", ["a", 1]):
        with pytest.raises(InputError, match=r"^A: keys must be keys of parameters"):
            checked_keys("A: keys", keys)


def test_a_restart_keeps_the_start_that_pulls() -> None:
    pull = PullToStart({"a": 1.0, "b": 1.0})
    state = pull.init({"a": np.zeros(2), "b": np.zeros(2)}, {})
    again = restarted(state, pull.init({"a": np.ones(2), "b": np.ones(4)}, {}))
    np.testing.assert_array_equal(again.values["a"], np.zeros(2))
    np.testing.assert_array_equal(again.values["b"], np.ones(4))  # of another resolution


@pytest.mark.parametrize("refined", ["grid", "number"])
def test_numbers_beside_a_refined_grid_keep_their_models(refined: str) -> None:
    start = {"grid": np.zeros((2, 2, 1)), "number": np.zeros(1)}
    optimizer = Partitioned(("number",), AveragedNewton(), Adam())
    state = optimizer.init(start)
    upsampler: Any = SimpleNamespace(shares={refined: 0.25}, tree=lambda tree, power=0.0: tree)
    if refined == "number":
        with pytest.raises(NotCarried, match="AveragedNewton"):
            upsampled(state, upsampler)
    else:
        assert upsampled(state, upsampler).own is state.own
