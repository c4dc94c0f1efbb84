"""Every estimator with every optimizer that fits, on problems whose answers are known."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy import stats

import unrender as ur
from analytic import exact_gradient, others, problem
from tests.analytic import AnalyticRenderer
from tiers import quick, slow
from unrender.core import registry
from unrender.core.random import Key
from unrender.estimators.base import pixel_weights
from unrender.estimators.capabilities import FreshGradient, NoiseSample
from unrender.estimators.path_then_newton import PathThenNewtonState
from unrender.estimators.sample_groups import fresh_weights
from unrender.images.base import ImageEstimate
from unrender.optimizers import transforms
from unrender.rendering.renderer import SampleRequest
from unrender.runs.callbacks import Callback
from unrender.runs.run import Run
from unrender.runs.verification import DIFFERS
from unrender.scene.batches import FullView
from unrender.scene.bounds import MARGIN

Denoised = ur.images.Denoised
CV = ur.images.RecursiveControlVariate


def hybrid(path: Any) -> ur.estimators.HybridGradient:
    """Path gradients of the map, perturbed renders for the colour."""
    return ur.estimators.HybridGradient(path, ur.SmoothedDerivatives(0.03, samples=16, debiased=True), keys=("colour",))


ESTIMATORS: dict[str, Callable[[], Any]] = {
    "plain, dual buffers": lambda: ur.PathGradient(spp=2),
    "plain, leave-one-out groups": lambda: ur.PathGradient(spp=6),
    "plain, own paths": lambda: ur.PathGradient(spp=1),
    "plain, other spp": lambda: ur.PathGradient(spp=4, adjoint_spp=1),
    "control variate, path space": lambda: ur.PathGradient(CV(), spp=2),
    "control variate, primary space": lambda: ur.PathGradient(CV(space="primary"), spp=2),
    "control variate, fresh gradients too": lambda: ur.PathGradient(CV(), spp=2, fresh_from=8),
    "control variate, own paths": lambda: ur.PathGradient(CV(), spp=1),
    "plain, uniform pixels": lambda: ur.PathGradient(pixels=ur.pixels.Uniform(24), spp=2),
    "plain, independent pixels": lambda: ur.PathGradient(pixels=ur.pixels.Uniform(24, stratified=False), spp=2),
    "plain, pixels by loss": lambda: ur.PathGradient(pixels=ur.pixels.LossProportional(24, denoiser="none"), spp=2),
    "plain, adaptive pixels": lambda: ur.PathGradient(
        pixels=ur.pixels.Adaptive(24, denoiser="none", levels=2, refresh=3), spp=2
    ),
    "plain, adaptive pixels, own paths": lambda: ur.PathGradient(pixels=ur.pixels.Adaptive(24, denoiser="none"), spp=1),
    "control variate, adaptive pixels": lambda: ur.PathGradient(
        CV(whole_views=3), ur.pixels.Adaptive(24, denoiser="none"), spp=2
    ),
    "control variate, adaptive counts": lambda: ur.PathGradient(CV(), ur.pixels.AdaptiveCounts(refresh=2), spp=3),
    "meta, adaptive pixels": lambda: ur.MetaEstimator(pixels=ur.pixels.Adaptive(24, denoiser="none")),
    "meta, adaptive pixels, other statistics": lambda: ur.MetaEstimator(
        pixels=ur.pixels.Adaptive(24, denoiser="none"), statistics="independent"
    ),
    "coupled, adaptive pixels": lambda: ur.MetaEstimator(
        coupled=True, spp=2, pixels=ur.pixels.Adaptive(24, denoiser="none")
    ),
    "meta": lambda: ur.MetaEstimator(),
    "meta, several of each": lambda: ur.MetaEstimator(4, 3, space="primary"),
    "meta, other statistics": lambda: ur.MetaEstimator(statistics="independent"),
    "meta, images of F": lambda: ur.MetaEstimator(difference_images="proportional"),
    "meta, images of F, other statistics": lambda: ur.MetaEstimator(
        1, 2, statistics="independent", difference_images="proportional"
    ),
    "coupled": lambda: ur.MetaEstimator(coupled=True, spp=3),
    "smoothed gradient": lambda: ur.SmoothedDerivatives(0.03, samples=16),
    "smoothed Hessian": lambda: ur.SmoothedDerivatives(0.03, samples=32, order="hessian", joint=False),
    "smoothed products": lambda: ur.SmoothedDerivatives(0.03, samples=32, order="hvp", joint=False),
    "smoothed Hessian, joint": lambda: ur.SmoothedDerivatives(0.03, samples=64, order="hessian"),
    "smoothed products, joint": lambda: ur.SmoothedDerivatives({"colour": 0.03, "*": 0.02}, samples=64, order="hvp"),
    "smoothed products, diagonal": lambda: ur.SmoothedDerivatives(
        0.03, 32, "hvp", joint=False, hessian_rate=0.5, hessian_form="diagonal", orthogonal=True
    ),
    "smoothed products, joint diagonal": lambda: ur.SmoothedDerivatives(
        0.03, 32, "hvp", hessian_rate=0.5, hessian_form="diagonal", orthogonal=True
    ),
    "loss values": lambda: ur.estimators.LossValues(spp=4),
    "Gauss-Newton": lambda: ur.GaussNewton(spp=8, derivative_spp=4),
    "paths, then Gauss-Newton": lambda: ur.estimators.PathThenNewton(
        ur.PathGradient(spp=6), ur.GaussNewton(spp=8, derivative_spp=4)
    ),
    "coupled, own paths": lambda: ur.MetaEstimator(coupled=True, spp=1),
    "coupled, other statistics": lambda: ur.MetaEstimator(coupled=True, spp=2, statistics="independent"),
    "coupled, control variate": lambda: ur.MetaEstimator(coupled=True, spp=2, image=CV()),
    "coupled, control variate, adaptive pixels": lambda: ur.MetaEstimator(
        coupled=True, spp=2, image=CV(whole_views=3), pixels=ur.pixels.Adaptive(24, denoiser="none")
    ),
    "hybrid": lambda: hybrid(ur.PathGradient(spp=6)),
    "hybrid, all four": lambda: hybrid(
        ur.MetaEstimator(coupled=True, spp=2, image=CV(whole_views=3), pixels=ur.pixels.Adaptive(24, denoiser="none"))
    ),
    "stock": lambda: ur.estimators.StockGradient(spp=2),
    "denoised": lambda: ur.PathGradient(Denoised(by="variation"), spp=4),
    "denoised control variate": lambda: ur.PathGradient(Denoised(CV(), by="variation"), spp=6),
    "denoised, own paths": lambda: ur.PathGradient(Denoised(CV(), by="variation"), spp=1),
    "coupled, denoised control variate": lambda: ur.MetaEstimator(
        coupled=True, spp=2, image=Denoised(CV(), by="variation")
    ),
}
ESTIMATORS |= others("estimator")
# What the docstrings say of bias: a weight that knows its samples pulls toward zero.
BIASED = {
    "meta, adaptive pixels",
    "coupled, adaptive pixels",
    "meta",
    "meta, several of each",
    "meta, images of F",
    "coupled",
    "coupled, own paths",
    "coupled, control variate",
    "coupled, control variate, adaptive pixels",
}
# A black box's loss is that of noisy images: a test of its own.
BIASED |= {name for name in ESTIMATORS if "denoised" in name}
BIASED |= {name for name in ESTIMATORS if name.startswith(("smoothed", "loss values", "hybrid"))}
BIASED |= set(others("estimator"))
DEAR = {
    "meta, other statistics",
    "meta, images of F, other statistics",
    "meta, adaptive pixels, other statistics",
    "coupled, other statistics",
    "Gauss-Newton",
    "control variate, own paths",
    "plain, adaptive pixels, own paths",
    "plain, adaptive pixels",
    "plain, pixels by loss",
    "control variate, primary space",
    "control variate, fresh gradients too",
    "control variate, adaptive counts",
    "control variate, adaptive pixels",
}
"""Their means take many runs of a few steps each: in the quick tier, the drift of a coupled gradient and estimators that differ by one
option stand for them."""
OPTIMIZERS: dict[str, Callable[[], Any]] = {
    "Adam": lambda: ur.optimizers.Adam(learning_rate=0.02, schedule=ur.optimizers.schedules.Exponential(100)),
    "SGD": lambda: ur.optimizers.SGD(learning_rate=0.1),
    "SGD with momentum": lambda: ur.optimizers.SGD(learning_rate=0.02, momentum=0.8),
    "MetaAdam": lambda: ur.optimizers.MetaAdam(learning_rate=0.004),
    "Chain": lambda: ur.optimizers.Chain(
        (transforms.GradientMean(), transforms.ScaleByRms()),
        0.02,
        ur.optimizers.schedules.Exponential(100),
    ),
    "ScheduleFree": lambda: ur.optimizers.ScheduleFree(0.03),
    "Newton": lambda: ur.optimizers.Newton(trust_radius=15.0, step_scale=0.1),
    "AveragedNewton": lambda: ur.optimizers.AveragedNewton(trust_radius=0.3),
    "NewtonCG": lambda: ur.optimizers.NewtonCG(trust_radius=15.0, step_scale=0.1),
    "LBFGS": lambda: ur.optimizers.LBFGS(
        trust_radius=0.1, curvature=0.5, history=20, inner_optimizer=OPTIMIZERS["Adam"]()
    ),
    "CMAES": lambda: ur.optimizers.CMAES(sigma0=0.1),
    "Partitioned": lambda: ur.optimizers.Partitioned((), OPTIMIZERS["SGD"](), OPTIMIZERS["ScheduleFree"]()),
}
OPTIMIZERS["Successive"] = lambda: ur.optimizers.Successive(
    OPTIMIZERS["ScheduleFree"](), OPTIMIZERS["AveragedNewton"]()
)
OPTIMIZERS |= others("optimizer")
FITTING = [
    (estimator, optimizer)
    for estimator, optimizer in itertools.product(ESTIMATORS, OPTIMIZERS)
    if OPTIMIZERS[optimizer]().requires <= ESTIMATORS[estimator]().provides
    and "denoised"
    not in estimator  # pictures without structure are noise to a denoiser: tests/unit/test_denoised.py has others
]


@pytest.mark.parametrize(("kind", "made"), [("estimator", ESTIMATORS), ("optimizer", OPTIMIZERS)])
def test_every_registered_one_is_here(kind: str, made: dict[str, Callable[[], Any]]) -> None:
    assert {type(make()) for make in made.values()} == set(registry.components(kind).values())


def in_turn() -> list[tuple[str, str]]:
    """Of each estimator one run of each length in the quick tier, with the optimizer that fits and had the fewest before."""
    used = dict.fromkeys(OPTIMIZERS, 0)
    found = []
    for name in ESTIMATORS:
        fitting = [optimizer for estimator, optimizer in FITTING if estimator == name]
        if fitting:
            chosen = min(fitting, key=used.__getitem__)
            used[chosen] += 1
            found.append((name, chosen))
    return found


IN_TURN = in_turn()


def test_every_optimizer_has_its_turn() -> None:
    assert {optimizer for _, optimizer in IN_TURN} == set(OPTIMIZERS)


QUICK_PAIRS = [pair if pair in IN_TURN else slow(*pair) for pair in FITTING]


@pytest.mark.parametrize(("estimator", "optimizer"), QUICK_PAIRS)
def test_a_few_steps_of_every_pair(estimator: str, optimizer: str) -> None:
    """What they hand one another fits: parameters move, stay finite and in their bounds, and equal seeds give equal runs."""
    found, again = (
        ur.optimize(problem(views=2), ESTIMATORS[estimator](), OPTIMIZERS[optimizer](), steps=4, seed=5)
        for _ in range(2)
    )
    assert (found.steps, found.stopped, found.skipped) == (4, "steps", 0)
    assert all(line.startswith("4 steps are too few to judge") for line in found.warnings)
    assert any((value != found.initial[key]).any() for key, value in found.parameters.items())
    for key, value in found.parameters.items():
        assert value.shape == found.initial[key].shape
        assert np.isfinite(value).all()
        assert (value >= 0).all()
        assert (value <= 1).all()
        np.testing.assert_array_equal(value, again.parameters[key])


class Recovered(Callback):
    """Ends a run at twice the steps, 80 at least, that its error took to fall below `share` of that at the start: it has to stay there."""

    def __init__(self, share: float):
        self.share, self.first, self.until = share, 0.0, 0

    def on_start(self, run: Run) -> None:
        self.first = self.error(run)

    def on_step(self, run: Run, record: dict[str, Any]) -> None:
        if not self.until and run.step % 5 == 0 and self.error(run) < self.share * self.first:
            self.until = max(2 * run.step, 80)
        if run.step == self.until:
            run.stop("recovered")

    @staticmethod
    def error(run: Run) -> float:
        return max(run.problem.parameter_error(run.parameters).values())


KINDS = {
    "plain, leave-one-out groups",
    "control variate, path space",
    "control variate, adaptive counts",
    "meta, images of F",
    "coupled",
    "coupled, control variate, adaptive pixels",
    "smoothed gradient",
    "smoothed Hessian, joint",
    "smoothed products, joint diagonal",
    "loss values",
    "Gauss-Newton",
    "paths, then Gauss-Newton",
    "hybrid",
    "stock",
}
"""Estimators whose whole runs are in the quick tier. Others differ from one of them by an option, or join two."""


@pytest.mark.parametrize(
    ("estimator", "optimizer"), [pair if pair in IN_TURN and pair[0] in KINDS else slow(*pair) for pair in FITTING]
)
def test_the_truth_is_recovered(estimator: str, optimizer: str) -> None:
    steps = {"Newton": 100, "NewtonCG": 100, "CMAES": 600}.get(optimizer, 200)
    asked, listener = problem(views=2), Recovered(0.35)
    found = ur.optimize(asked, ESTIMATORS[estimator](), OPTIMIZERS[optimizer](), steps=steps, callbacks=[listener])
    assert listener.until, "it never came near"
    assert max(asked.parameter_error(found.parameters).values()) < 0.4 * listener.first
    assert found.skipped == 0
    # the result may be that of an earlier step, or not all the way there: .4 of the error at the start is enough here
    expected = ("the final picture is worse than that of step", DIFFERS)
    short = "are too few to judge"  # steps that a trust region still limits
    assert [line for line in found.warnings if not line.startswith(expected) and short not in line] == []


@pytest.mark.parametrize("name", ESTIMATORS)
def test_the_shape_of_an_estimate(name: str) -> None:
    asked = problem(views=2)
    found = ur.estimate(asked, ESTIMATORS[name]())
    provides = ESTIMATORS[name]().provides
    known = asked.initial() if "gradient" in provides else {}
    assert {k: g.shape for k, g in found.gradient.items()} == {k: v.shape for k, v in known.items()}
    assert np.isfinite(found.loss)
    assert found.info["samples"] > 0
    assert (found.losses is not None) == ("losses" in provides)
    assert (found.variance is not None) == ("variance" in provides)
    if found.variance is not None:
        assert all(found.variance[k].shape == v.shape for k, v in asked.initial().items())
        assert all((v >= 0).all() for v in found.variance.values())
    size = sum(value.size for value in asked.initial().values())
    assert (found.hessian is not None) == ("hessian" in provides)
    assert found.hessian is None or found.hessian.shape == (size, size)
    assert (found.hvp is not None) == ("hvp" in provides)


@pytest.mark.parametrize("limit", [None, 3.0])
@pytest.mark.parametrize("kind", ["alone", "after paths", "beside paths"])
def test_weights_of_pixels_have_the_shape_of_the_views(kind: str, limit: float | None) -> None:
    """Those of Gauss-Newton steps with a noise limit, also as a part of another estimator; others have none."""
    newton = ur.GaussNewton(spp=8, derivative_spp=4, noise_limit=limit)
    kinds = {"alone": newton, "after paths": ur.estimators.PathThenNewton(newton=newton)}
    made: Any = kinds.get(kind) or ur.HybridGradient(perturbed=newton, keys=("colour",))
    asked, weights = problem(views=2), []
    state = made.init(asked, asked.initial())
    for step in range(3):
        if isinstance(state, PathThenNewtonState):
            state = replace(state, changed=True)
        _, state = made.estimate(asked, asked.initial(), state, Key(0, step))
        weights = pixel_weights(made, state)
    assert [x.shape[:2] for x in weights] == list(asked.sizes) * (limit is not None)
    assert all(((x > 0) & (x <= 1)).all() for x in weights)


DRIFT = -0.06


def gradients(asked: ur.Problem, estimator: Any, count: int, steps: int = 6) -> np.ndarray:
    """(count, n): independent estimates at one drifting point, each at the end of a run of its own, of `steps` steps."""
    rows = []
    for seed in range(count):
        state, found = estimator.init(asked, asked.initial()), None
        for step in range(6 - steps, 6):
            parameters = {k: v + step * DRIFT for k, v in asked.initial().items()}
            found, state = estimator.estimate(asked, parameters, state, Key(seed, step))
        assert found is not None
        rows.append(np.concatenate([g.ravel() for g in found.gradient.values()]))
    return np.stack(rows)


def remembers(asked: ur.Problem, estimator: Any) -> bool:
    """Whether an estimate depends on the steps before it."""
    return not np.array_equal(gradients(asked, estimator, 3), gradients(asked, estimator, 3, steps=1))


def worst_z(rows: np.ndarray, exact: np.ndarray) -> tuple[float, float]:
    """The largest |z| of the mean against the exact value, and its limit at 1e-3 after Šidák."""
    z = (rows.mean(0) - exact) / (rows.std(0, ddof=1) / np.sqrt(len(rows)))
    return float(np.abs(z).max()), float(stats.norm.isf((1 - (1 - 1e-3) ** (1 / z.size)) / 2))


@pytest.mark.parametrize("name", [slow(name) if name in DEAR else name for name in ESTIMATORS if name not in BIASED])
@pytest.mark.parametrize("loss", [ur.losses.L2(), slow(ur.losses.RelativeL2())], ids=["L2", "RelativeL2"])
def test_gradients_are_unbiased_for_linear_losses(name: str, loss: Any) -> None:
    """For the control variate too: here its weight, from five steps, is all but independent of what it weighs."""
    asked = problem(loss, views=2)
    at = {k: v + 5 * DRIFT for k, v in asked.initial().items()}
    exact = np.concatenate([g.ravel() for g in exact_gradient(asked, at).values()])
    estimator = ESTIMATORS[name]()
    rows = (
        gradients(asked, estimator, 200, steps=6)
        if remembers(asked, estimator)
        else gradients(asked, estimator, 400, steps=1)
    )
    worst, limit = worst_z(rows, exact)
    assert worst < limit
    assert worst_z(rows * 1.1, exact)[0] > limit, "a planted bias of 10 % went unseen"


@pytest.mark.parametrize("noise", [0.0, slow(0.5)])
def test_fresh_gradients_know_nothing_of_earlier_samples(noise: float) -> None:
    """Their mean is the gradient, and over runs they are uncorrelated with the gradient of the step before, where the next is."""
    asked = problem(noise=noise)
    estimator = ur.PathGradient(CV(), spp=2, fresh_from=8)
    rows = []
    for seed in range(300 if noise else 3):
        parameters, state, last = asked.initial(), estimator.init(asked, asked.initial()), None
        for step in range(9):
            before = last
            last, state = estimator.estimate(asked, parameters, state, Key(seed, step))
            assert (last.get(FreshGradient) is not None) == (step >= 8)
        assert before is not None
        assert last is not None
        trees = (before.gradient, last.gradient, last.require("the test", FreshGradient).values)
        rows.append([np.concatenate([g.ravel() for g in tree.values()]) for tree in trees])
    found = np.array(rows)
    exact = np.concatenate([g.ravel() for g in exact_gradient(asked, asked.initial()).values()])
    if not noise:
        np.testing.assert_allclose(found, np.broadcast_to(exact, found.shape), rtol=1e-5)
        return
    worst, limit = worst_z(found[:, 2], exact)
    assert worst < limit
    assert worst_z(found[:, 2] * 1.3, exact)[0] > limit, "a planted bias of 30 % went unseen"
    before, after, fresh = (found[:, n] - found[:, n].mean(0) for n in range(3))
    scale = np.sqrt((before**2).mean(0) * (fresh**2).mean(0)) / np.sqrt(len(found))
    assert np.abs((before * fresh).mean(0) / scale).max() < limit
    assert (before * after).mean() > 0.3 * (before**2).mean(), "gradients that remember agree on their noise"


@pytest.mark.parametrize("spp", [2, 8])
def test_a_noise_sample_has_no_mean_and_the_variance_of_the_gradient(spp: int) -> None:
    """With two groups, whose weights come from one another, its variance is up to twice as large."""
    asked = problem(noise=0.5)
    estimator = ur.PathGradient(CV(), spp=spp, noise_sample=True)
    rows = []
    for seed in range(300):
        found, state = estimator.estimate(asked, asked.initial(), estimator.init(asked, asked.initial()), Key(seed))
        trees = (found.gradient, found.require("the test", NoiseSample).values)
        rows.append([np.concatenate([g.ravel() for g in tree.values()]) for tree in trees])
    gradients, noise = np.array(rows).swapaxes(0, 1)
    worst, limit = worst_z(noise, np.zeros(noise.shape[1]))
    assert worst < limit
    assert worst_z(noise + 0.5 * noise.std(0), np.zeros(noise.shape[1]))[0] > limit, "a planted mean went unseen"
    assert 0.7 < noise.var(0).sum() / gradients.var(0).sum() < 2.2
    found, _ = estimator.estimate(asked, asked.initial(), state, Key(1))
    assert found.get(NoiseSample) is None, "only the first estimate has one"
    odd = ur.PathGradient(CV(), spp=3, noise_sample=True)
    found, _ = odd.estimate(asked, asked.initial(), odd.init(asked, asked.initial()), Key(0))
    assert found.get(NoiseSample) is None, "groups of an odd number do not cancel"


def test_a_fresh_gradient_follows_the_secant_of_a_loss_that_is_not_linear() -> None:
    """Of L1, a residual of the samples twice that of the image weighs twice as much; its sign alone would weigh the same."""
    asked = problem(ur.losses.L1())
    reference = asked.reference(0)
    residual = np.random.default_rng(0).choice([-0.3, 0.2], size=(1, *reference.shape))
    seen = ImageEstimate(reference + residual, None, fresh=reference + 2 * residual)
    weights = FullView(asked, 0).loss_derivative(seen.images)
    np.testing.assert_allclose(
        fresh_weights(asked, FullView(asked, 0), seen, seen.images, weights), 2 * weights, rtol=1e-6
    )
    assert np.abs(weights).max() == pytest.approx(np.abs(weights).min())


def test_fresh_gradients_come_eight_at_a_time_and_ever_more_rarely() -> None:
    asked = problem()
    estimator = ur.PathGradient(CV(), fresh_from=9)
    state, having = estimator.init(asked, asked.initial()), []
    for step in range(50):
        found, state = estimator.estimate(asked, asked.initial(), state, Key(step))
        having += [step] if found.get(FreshGradient) else []
    assert having == [*range(9, 17), *range(18, 26), *range(36, 44)]
    estimator = ur.PathGradient(fresh_from=9)  # a plain image remembers nothing: its gradient is fresh
    found, _ = estimator.estimate(
        asked, asked.initial(), replace(estimator.init(asked, asked.initial()), step=9), Key(0)
    )
    assert found.get(FreshGradient) is None
    for tolerance in (0.0, 2.0):  # L1's secant at no residual has no bound, but where it is damped
        estimator = ur.PathGradient(CV(), spp=2, tolerance=tolerance, fresh_from=8)
        absolute = problem(ur.losses.L1())
        _, state = estimator.estimate(
            absolute, absolute.initial(), estimator.init(absolute, absolute.initial()), Key(0)
        )
        found, _ = estimator.estimate(absolute, absolute.initial(), replace(state, step=8), Key(1))
        assert (found.get(FreshGradient) is not None) == (tolerance > 0)
    for wrong in (-1, 3, 8.5):
        with pytest.raises(ur.InputError, match="fresh_from"):
            ur.PathGradient(fresh_from=wrong)  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize(
    ("order", "joint"),
    [("gradient", True), ("hessian", True), ("hvp", True), slow("hessian", False), slow("hvp", False)],
)
def test_smoothed_derivatives_are_unbiased_where_images_have_no_noise(order: Any, joint: bool) -> None:
    """The loss is quadratic, and so its smoothed derivatives are its own."""
    asked = problem(ur.losses.RelativeL2(), views=2, noise=0.0)
    at = asked.initial()
    estimator = ur.SmoothedDerivatives({"colour": 0.03, "map": 0.05}, samples=256, order=order, joint=joint)

    def flat(tree: dict[str, np.ndarray]) -> np.ndarray:
        return np.concatenate([x.ravel() for x in tree.values()])

    direction = {"colour": np.array([0.3, -0.2, 0.5]), "map": np.array([0.1, 0.4, -0.6, 0.2]).reshape(2, 2, 1)}
    gradient = flat(exact_gradient(asked, at))
    moved = {key: x + direction[key] for key, x in at.items()}
    product = flat(exact_gradient(asked, moved)) - gradient
    rows = []
    for seed in range(60):
        found, _ = estimator.estimate(asked, at, estimator.init(asked, at), Key(seed))
        told = [flat(found.gradient)]
        if order == "hessian":
            assert isinstance(found.hessian, np.ndarray)
            told.append(found.hessian @ flat(direction))
        if order == "hvp":
            assert found.hvp is not None
            told.append(flat(found.hvp(direction)))
        rows.append(np.concatenate(told))
    exact = gradient if order == "gradient" else np.concatenate([gradient, product])
    worst, limit = worst_z(np.array(rows), exact)
    assert worst < limit
    assert worst_z(np.array(rows) * 1.2, exact)[0] > limit, "a planted bias of 20 % went unseen"


@pytest.mark.parametrize(
    "options",
    quick([{}, {"difference_images": "proportional"}, {"coupled": True, "spp": 2}], {"coupled": True, "spp": 2}),
    ids=str,
)
def test_a_meta_gradient_is_unbiased_at_every_step_of_a_drift(options: dict[str, Any]) -> None:
    """200 runs, alpha bounded, statistics from independent samples: the mean gradient is the true one at each of ten steps."""
    asked = problem(noise=0.9)
    estimator = ur.MetaEstimator(**options, statistics="independent")
    path = [{k: v - 0.02 * step for k, v in asked.initial().items()} for step in range(10)]
    exact = [np.concatenate([g.ravel() for g in exact_gradient(asked, p).values()]) for p in path]
    rows = np.zeros((200, len(path), exact[0].size))
    for seed in range(len(rows)):
        state = estimator.init(asked, path[0])
        for step, parameters in enumerate(path):
            found, state = estimator.estimate(asked, parameters, state, Key(seed, step))
            rows[seed, step] = np.concatenate([g.ravel() for g in found.gradient.values()])
    for step in range(len(path)):
        worst, limit = worst_z(rows[:, step], exact[step])
        assert worst < limit, step
    assert worst_z(rows[:, -1] * 1.1, exact[-1])[0] > limit, "a planted bias of 10 % went unseen"
    assert (rows[:, -1].std(0) < 0.7 * rows[:, 0].std(0)).all(), "it should be quieter than its samples"


def test_the_noise_that_history_tells_is_the_share_that_the_variance_has() -> None:
    """Though gradients that remember look alike from step to step."""
    asked = problem(noise=0.9)
    told: list[float] = []

    class Listener(ur.protocols.Callback):
        def on_step(self, run: Any, record: dict[str, Any]) -> None:
            variance = sum(v.sum() for v in run.estimate.variance.values())
            energy = sum((g * g).sum() for g in run.estimate.gradient.values())
            told.append(min(variance / energy, 1.0))

    found = ur.optimize(asked, ur.MetaEstimator(), ur.optimizers.MetaAdam(1e-4), steps=12, callbacks=[Listener()])
    assert [record["gradient_noise"] for record in found.history] == pytest.approx(told)
    assert told[0] == 1.0  # a first sample's variance is its square
    assert told[-1] < 0.5


def test_meta_refuses_what_makes_no_sense() -> None:
    refused: list[dict[str, Any]] = [
        {"proportional_spp": 0},
        {"difference_spp": 1.5},
        {"spp": True},
        {"beta_difference": 1.0},
        {"max_weight": 0.0},
        {"max_weight": 1.5},
        {"space": "pixel"},
        {"difference_images": "F"},
        {"difference_images": "proportional", "coupled": True},
        {"difference_images": "proportional", "pixels": ur.pixels.Uniform(24)},
        {"difference_images": "proportional", "pixels": ur.pixels.AdaptiveCounts(), "difference_spp": 4},
    ]
    for bad in refused:
        with pytest.raises(ur.InputError, match=next(iter(bad))):
            ur.MetaEstimator(**bad)
    with pytest.raises(ur.InputError, match="coupled=True"):
        ur.MetaEstimator(image=CV())
    with pytest.raises(ur.InputError, match="spp is for the coupled form"):
        ur.MetaEstimator(spp=8)
    with pytest.raises(ur.InputError, match="difference_spp is for the independent form"):
        ur.MetaEstimator(coupled=True, difference_spp=1)
    with pytest.raises(ur.InputError, match="plain images"):
        ur.MetaEstimator(coupled=True, image=CV(), statistics="independent")
    with pytest.raises(ur.InputError, match="space"):
        ur.MetaEstimator(coupled=True, image=CV(space="primary"), space="path")
    with pytest.raises(ur.InputError, match=r'"variance".*does not provide'):
        ur.optimize(problem(), ur.PathGradient(), ur.optimizers.MetaAdam(), steps=1)
    with pytest.raises(ur.InputError, match='space="primary"'):
        ur.optimize(problem(shares_paths=False), ur.MetaEstimator(space="path"), ur.optimizers.MetaAdam(), steps=1)


@pytest.mark.parametrize(("spp", "own", "proportional"), [((2, 1), 4, 3), ((1, 1), 4, 3), ((2, 4), 6, 6)])
def test_images_of_f_save_the_passes_that_they_say(
    spp: tuple[int, int], own: int, proportional: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """After the first step; the samples told are those that the renderer traced, and the images those of F."""
    traced: list[tuple[str, int]] = []
    for name in ("image", "image_pair"):
        sound = getattr(AnalyticRenderer, name)

        def counted(self: Any, *arguments: Any, name: str = name, sound: Any = sound) -> Any:
            traced.append((name, next(x.spp for x in arguments if isinstance(x, SampleRequest))))
            return sound(self, *arguments)

        monkeypatch.setattr(AnalyticRenderer, name, counted)
    asked, parameters = problem(views=2), problem().initial()
    pixels = asked.pixels
    pairs, images = {}, {}
    for choice, samples in (("own", own), ("proportional", proportional)):
        estimator = ur.MetaEstimator(*spp, difference_images=choice)  # pyright: ignore[reportArgumentType]
        _, state = estimator.estimate(asked, parameters, estimator.init(asked, parameters), Key(0))
        traced.clear()
        moved = {key: x + DRIFT for key, x in parameters.items()}
        found, _ = estimator.estimate(asked, moved, state, Key(1))
        assert found.info["samples"] == samples * pixels == sum(n for _, n in traced) * pixels // 2
        pairs[choice], images[choice] = [n for name, n in traced if name == "image_pair"], found.info["images"]
    assert sorted(images["own"]) == [0, 1]
    assert all(np.array_equal(images["own"][view], images["proportional"][view]) for view in (0, 1))
    assert pairs["proportional"] == [*spp] * 2
    assert sum(pairs["own"]) == 2 * spp[1] * (2 if spp[1] == 1 else 1)


def test_meta_takes_the_space_that_its_parameters_allow() -> None:
    for shares_paths, space in ((True, "path"), (False, "primary")):
        found = ur.estimate(problem(shares_paths=shares_paths), ur.MetaEstimator())
        assert found.info["space"] == dict.fromkeys(found.gradient, space)


def test_groups_that_are_not_left_out_are_biased(monkeypatch: pytest.MonkeyPatch) -> None:
    """The test above sees what crossing is for."""
    monkeypatch.setattr(ImageEstimate, "others", lambda self: self.images)
    asked = problem(views=1, noise=0.9)
    at = {k: v + 5 * DRIFT for k, v in asked.initial().items()}
    exact = np.concatenate([g.ravel() for g in exact_gradient(asked, at).values()])
    worst, limit = worst_z(gradients(asked, ur.PathGradient(spp=2), 400, steps=1), exact)
    assert worst > limit


def test_the_control_variate_reduces_the_noise_of_the_image() -> None:
    asked = problem(noise=0.9)
    exact = asked.renderer
    assert isinstance(exact, AnalyticRenderer)

    def error(image: Any) -> float:
        squares = []
        for seed in range(100):
            parameters = asked.initial()
            state, found = image.init(asked, parameters), None
            for step in range(8):
                parameters = {k: v - 0.02 for k, v in parameters.items()}
                found, keep = image.estimate(asked, parameters, state, FullView(asked, 0), 2, 2, Key(seed, step))
                state = image.advance(parameters, state, (keep,))
            assert found is not None
            squares.append(np.mean((found.mean() - exact.exact(parameters)) ** 2))
        return float(np.mean(squares))

    assert error(CV()) < 0.3 * error(ur.images.Plain())


def test_equal_seeds_give_equal_runs_and_others_do_not() -> None:
    def go(seed: int) -> dict[str, np.ndarray]:
        return ur.optimize(
            problem(), ESTIMATORS["control variate, path space"](), OPTIMIZERS["Adam"](), steps=20, seed=seed
        ).parameters

    a, b, c = go(0), go(0), go(1)
    assert all(np.array_equal(a[k], b[k]) for k in a)
    assert any(not np.array_equal(a[k], c[k]) for k in a)


def test_memory_starts_anew_when_a_parameter_changes_its_shape() -> None:
    asked = problem()
    estimator = ur.PathGradient(CV(), spp=2)
    parameters = asked.initial()
    state = estimator.init(asked, parameters)
    for step in range(5):
        _, state = estimator.estimate(asked, parameters, state, Key(0, step))
    other = dataclasses.replace(state.image, parameters={**parameters, "map": np.zeros((4, 4, 1))})
    found, after = estimator.estimate(asked, parameters, dataclasses.replace(state, image=other), Key(0, 5))
    assert "control_weight" not in found.info
    assert float(np.max(after.image.views[0].current.moment_weight)) == 0.0


def test_a_gradient_that_is_not_finite_is_neither_applied_nor_remembered() -> None:
    asked = problem()
    estimator = ur.PathGradient(CV(), spp=2)
    calls = itertools.count()

    @dataclasses.dataclass(frozen=True)
    class Faulty:
        provides = estimator.provides
        init = estimator.init

        def estimate(self, problem: Any, parameters: Any, state: Any, key: Key) -> Any:
            found, after = estimator.estimate(problem, parameters, state, key)
            if next(calls) % 4 == 3:
                bad = {k: g * np.nan for k, g in found.gradient.items()}
                return dataclasses.replace(found, gradient=bad), None
            return found, after

    found = ur.optimize(asked, Faulty(), OPTIMIZERS["Adam"](), steps=40)
    assert found.skipped == 10
    assert all(np.isfinite(value).all() for value in found.parameters.values())


def test_a_difference_that_is_not_finite_is_neither_applied_nor_remembered(monkeypatch: pytest.MonkeyPatch) -> None:
    """One element of one previous state's gradient: the next gradient is finite, its variance would not be."""
    asked = problem()
    sound = AnalyticRenderer.adjoint_pair
    calls = itertools.count()

    def faulty(self: Any, *arguments: Any) -> Any:
        current, previous = sound(self, *arguments)
        if next(calls) % 7 == 5:
            previous["colour"][0] = np.nan
        return current, previous

    monkeypatch.setattr(AnalyticRenderer, "adjoint_pair", faulty)
    for estimator in (ur.MetaEstimator(), ur.MetaEstimator(coupled=True)):
        found = ur.optimize(asked, estimator, ur.optimizers.MetaAdam(0.004), steps=60)
        assert 5 < found.skipped < 12
        assert all(np.isfinite(value).all() for value in found.parameters.values())
        assert max(found.history[-1]["parameter_error"].values()) < 0.3


def test_a_run_without_a_finite_gradient_is_given_up() -> None:
    asked = problem()

    estimator = ur.PathGradient(spp=2)

    @dataclasses.dataclass(frozen=True)
    class Faulty:
        provides = estimator.provides
        init = estimator.init

        def estimate(self, problem: Any, parameters: Any, state: Any, key: Key) -> Any:
            found, after = estimator.estimate(problem, parameters, state, key)
            return dataclasses.replace(found, loss=float("nan")), after

    found = ur.optimize(asked, Faulty(), OPTIMIZERS["Adam"](), steps=1000)
    assert found.stopped == "non-finite"
    assert found.steps < 1000
    assert found.warnings
    initial = asked.initial()
    assert all(np.allclose(found.parameters[k], initial[k]) for k in initial)


def test_a_parameter_without_influence_is_warned_of() -> None:
    matrix = np.random.default_rng(0).random((4 * 4 * 3, 2))
    matrix[:, 1] = 0
    renderer = AnalyticRenderer({"seen": np.array([0.5]), "unseen": np.array([0.5])}, matrix)
    views = [ur.View(renderer.exact({}))]
    asked = ur.Problem(renderer, [ur.Parameter("seen", 0.2), ur.Parameter("unseen", 0.2)], views)
    found = ur.optimize(asked, ur.PathGradient(spp=2), OPTIMIZERS["Adam"](), steps=10)
    assert len(found.warnings) == 1
    assert "unseen" in found.warnings[0]


def test_bounds_hold_and_do_not_stall() -> None:
    """A parameter driven against its bound by a large step comes back."""
    asked = problem()
    pushed = ur.optimize(asked, ur.PathGradient(spp=4), ur.optimizers.SGD(learning_rate=50.0), steps=1).last
    assert all((v >= MARGIN * 0.999).all() and (v <= 1 - MARGIN * 0.999).all() for v in pushed.values())
    assert any((np.isclose(v, MARGIN) | np.isclose(v, 1 - MARGIN)).any() for v in pushed.values())
    again = ur.Problem(
        asked.renderer,
        [ur.Parameter(k, initial=v, bounds=(0, 1)) for k, v in pushed.items()],
        asked.views,
        truth=asked.truth,
    )
    found = ur.optimize(again, ur.PathGradient(spp=4), OPTIMIZERS["Adam"](), steps=600)
    assert max(found.history[-1]["parameter_error"].values()) < 0.1


def test_what_does_not_fit_is_refused() -> None:
    class NeedsHessian(ur.optimizers.SGD):
        @property
        def requires(self) -> frozenset[str]:
            return frozenset({"hessian"})

    with pytest.raises(ur.InputError, match=r"hessian.*does not provide"):
        ur.optimize(problem(), ur.PathGradient(), NeedsHessian(learning_rate=1.0), steps=1)
    with pytest.raises(ur.InputError, match="budget"):
        ur.optimize(problem(), ur.PathGradient(), OPTIMIZERS["SGD"]())
    for bad in ({"steps": 0}, {"steps": 1.5}, {"seconds": -1.0}, {"seconds": float("nan")}):
        with pytest.raises(ur.InputError):
            ur.optimize(problem(), ur.PathGradient(), OPTIMIZERS["SGD"](), **bad)  # pyright: ignore[reportArgumentType]
    with pytest.raises(ur.InputError, match='space="primary"'):
        ur.optimize(problem(shares_paths=False), ur.PathGradient(CV()), OPTIMIZERS["SGD"](), steps=1)
    for spp in (0, -4, 1.5, True):
        with pytest.raises(ur.InputError, match="spp"):
            ur.PathGradient(spp=spp)  # pyright: ignore[reportArgumentType]
    with pytest.raises(ur.InputError, match="space"):
        CV(space="pixel")  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize(("spp", "groups"), [(1, 1), (2, 2), (3, 3), (6, 6), (17, 1), (24, 12), (64, 16)])
def test_samples_form_as_many_leave_one_out_groups_as_divide_them(spp: int, groups: int) -> None:
    assert ur.PathGradient(spp=spp).groups == groups
    assert ur.PathGradient(spp=spp, adjoint_spp=2).groups == 1


def test_callbacks_hear_and_can_stop() -> None:
    heard: list[str] = []

    class Listener(ur.protocols.Callback):
        def on_start(self, run: Any) -> None:
            heard.append("start")

        def on_step(self, run: Any, record: dict[str, Any]) -> None:
            heard.append(f"step {record['step']}")
            if record["step"] == 2:
                run.stop()

        def on_end(self, run: Any, result: ur.Result) -> None:
            heard.append(result.stopped)

    ur.optimize(problem(), ur.PathGradient(), OPTIMIZERS["SGD"](), steps=100, callbacks=[Listener()])
    assert heard == ["start", "step 0", "step 1", "step 2", "callback"]


def test_ctrl_c_returns_what_was_reached() -> None:
    import os
    import signal

    class Interrupt(ur.protocols.Callback):
        def on_step(self, run: Any, record: dict[str, Any]) -> None:
            if record["step"] == 3:
                os.kill(os.getpid(), signal.SIGINT)

    before = signal.getsignal(signal.SIGINT)
    found = ur.optimize(problem(), ur.PathGradient(), OPTIMIZERS["SGD"](), steps=100000, callbacks=[Interrupt()])
    assert found.stopped == "interrupted"
    assert found.steps <= 5
    assert signal.getsignal(signal.SIGINT) is before


@pytest.mark.parametrize(("kind", "missing"), [("Estimator", "provides"), ("Optimizer", "requires")])
def test_a_part_that_lacks_a_method_of_its_protocol_is_refused(kind: str, missing: str) -> None:
    """Inherited from the protocol it returned None."""
    part: Any = type("Mine", (getattr(ur.protocols, kind),), {})()
    parts = (part, ur.optimizers.Adam()) if kind == "Estimator" else (ur.PathGradient(), part)
    with pytest.raises(ur.InputError, match=f"Mine has no {missing}, which an {kind} needs"):
        ur.optimize(problem(), *parts, steps=1)
