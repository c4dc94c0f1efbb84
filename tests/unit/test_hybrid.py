"""Path gradients of some parameters and perturbed renders for the others, in one estimate."""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import unrender as ur
from tests.analytic import AnalyticRenderer
from unrender.core.random import Key
from unrender.estimators.capabilities import BlockEstimate
from unrender.images.base import PairRequest
from unrender.methods import method
from unrender.protocols import Callback
from unrender.rendering.partial import HeldParameters
from unrender.rendering.renderer import ParameterInfo
from unrender.scene.batches import PixelBatch

CV = ur.images.RecursiveControlVariate
SHAPE = (4, 4)
TRUTH = {"map": np.random.default_rng(0).uniform(0.3, 0.9, (2, 2, 1)), "pose": np.array([0.4, 0.7])}


class PosedRenderer(AnalyticRenderer):
    """One of whose parameters has no path gradient, and shares no paths."""

    MOVES = "pose"

    def parameters(self) -> dict[str, ParameterInfo]:
        known = {"pose": ParameterInfo((2,), differentiable=False, shares_paths=False, reason="it moves", rigid=True)}
        return {**super().parameters(), **known}

    def prepare(self, keys: list[str], space: Any, derivatives: Any = True) -> Any:
        if self.MOVES in keys and (derivatives is True or (derivatives and self.MOVES in derivatives)):
            raise ur.InputError(f"parameter {self.MOVES}: no path gradient")
        if self.MOVES in keys and space == "path":
            raise ur.InputError(f"parameter {self.MOVES}: no paths shared")
        return super().prepare(keys, space, derivatives)


def problem(noise: float = 0.5, views: int = 2, keys: tuple[str, ...] = ("map", "pose")) -> ur.Problem:
    matrix = np.random.default_rng(1).uniform(0.0, 1.0, (SHAPE[0] * SHAPE[1] * 3, 6))
    renderer = PosedRenderer(TRUTH, matrix, 0.1, noise, shape=SHAPE, sensors=views)
    views_ = [ur.View(renderer.exact(TRUTH), sensor=view) for view in range(views)]
    return ur.Problem(
        renderer, [ur.Parameter(key, 0.5, (0, 1)) for key in keys], views_, truth={k: TRUTH[k] for k in keys}
    )


def absolute() -> ur.Problem:
    """The problem with L1, of which a smoothed loss serves poses."""
    made = problem()
    return ur.Problem(made.renderer, made.parameters, made.views, ur.losses.L1())


def smoothed(**options: Any) -> ur.SmoothedDerivatives:
    return ur.SmoothedDerivatives(0.05, **{"samples": 16, "spp": 2, "debiased": True} | options)


def exact(asked: ur.Problem, at: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    renderer = asked.renderer
    assert isinstance(renderer, AnalyticRenderer)
    flat = sum(
        asked.loss_derivative(view, renderer.exact(at)).reshape(-1) @ renderer.matrix
        for view in range(len(asked.views))
    )
    assert isinstance(flat, np.ndarray)
    return {"map": flat[:4].reshape(2, 2, 1), "pose": flat[4:]}


def all_four(whole_views: int = 3) -> ur.estimators.HybridGradient:
    adaptive = ur.pixels.Adaptive(16, denoiser="none")
    path = ur.MetaEstimator(coupled=True, spp=2, image=CV("primary", whole_views=whole_views), pixels=adaptive)
    return ur.estimators.HybridGradient(path, smoothed())


@pytest.mark.parametrize("pixels", [ur.pixels.All(), ur.pixels.Uniform(16)])
def test_the_path_s_part_is_that_of_its_estimator_to_the_bit(pixels: Any) -> None:
    """For a remembering estimator, over steps at which both groups move."""
    both, alone = problem(), problem(keys=("map",))
    image = CV("primary") if pixels == ur.pixels.All() else CV("primary", whole_views=2)
    path = ur.PathGradient(image, pixels, spp=4)
    hybrid = ur.estimators.HybridGradient(path, smoothed())
    state, own = hybrid.init(both, both.initial()), path.init(alone, alone.initial())
    for step in range(5):
        at = {"map": both.initial()["map"] + 0.02 * step, "pose": both.initial()["pose"]}
        found, state = hybrid.estimate(both, at, state, Key(3, step))
        # The renderer without the pose has its own: the same image where these are equal.
        renderer = alone.renderer
        assert isinstance(renderer, AnalyticRenderer)
        renderer._values["pose"] = at["pose"]
        expected, own = path.estimate(alone, {"map": at["map"]}, own, Key(3, step))
        np.testing.assert_array_equal(found.gradient["map"], expected.gradient["map"])
        assert found.loss == expected.loss
        assert found.info["samples"] > expected.info["samples"]


def worst(rows: np.ndarray, mean: np.ndarray) -> float:
    return float(np.abs((rows.mean(0) - mean) / (rows.std(0, ddof=1) / np.sqrt(len(rows)))).max())


@pytest.mark.slow
def test_both_parts_are_unbiased() -> None:
    """Loss and image are quadratic and linear, so the smoothed gradient is the gradient; with the loss of noisy images it is not."""
    asked, at = problem(), problem().initial()
    expected = exact(asked, at)
    rows: dict[bool, list[np.ndarray]] = {True: [], False: []}
    for debiased, found in rows.items():
        estimator = ur.estimators.HybridGradient(ur.PathGradient(spp=2), smoothed(debiased=debiased))
        state = estimator.init(asked, at)
        for seed in range(300):
            gradient = estimator.estimate(asked, at, state, Key(seed))[0].gradient
            found.append(np.concatenate([gradient["map"].ravel(), gradient["pose"]]))
    mean = np.concatenate([expected["map"].ravel(), expected["pose"]])
    assert worst(np.array(rows[True]), mean) < 3.9
    assert worst(np.array(rows[True]) * 1.1, mean) > 3.9, "a planted bias of 10 % went unseen"
    assert worst(np.array(rows[False])[:, 4:], mean[4:]) > 3.9, "the noise of the images adds to the loss"


def test_a_perturbed_texture_with_a_preconditioner_and_a_path_gradient_are_by_the_same_coordinates() -> None:
    """The perturbed gradient is by those of the descent; the path's is brought to them, by its own preconditioner and parameterisation."""
    matrix = np.random.default_rng(1).standard_normal((48, 8))
    renderer = AnalyticRenderer({"a": TRUTH["map"], "b": TRUTH["map"]}, matrix, noise=0.0)
    smooth, log = ur.preconditioners.LargeSteps(2.0), ur.parameterisations.Log()
    a = ur.Parameter("a", 0.5, preconditioner=smooth)
    b = ur.Parameter("b", 0.5, (0.1, 2.0), parameterisation=log)
    asked = ur.Problem(renderer, [a, b], [ur.View(renderer.exact({}))])
    perturbed = smoothed(samples=64, orthogonal=True)
    found = ur.estimate(asked, ur.estimators.HybridGradient(ur.PathGradient(), perturbed, ("a",)))
    plain = ur.Problem(renderer, [ur.Parameter("a", 0.5), ur.Parameter("b", 0.5)], asked.original_views)
    exactly = ur.estimate(plain, ur.PathGradient()).gradient
    assert found.preconditioned
    np.testing.assert_allclose(found.gradient["b"], 0.4 * exactly["b"], rtol=1e-5)  # x = 0.1 + exp u
    runs = [
        ur.estimate(asked, ur.estimators.HybridGradient(ur.PathGradient(), perturbed, ("a",)), seed=seed)
        .gradient["a"]
        .ravel()
        for seed in range(50)
    ]
    assert worst(np.stack(runs), smooth.apply(exactly["a"]).ravel()) < 3.9
    assert worst(np.stack(runs), exactly["a"].ravel()) > 3.9, "a gradient by the texture went unseen"


@pytest.mark.parametrize("first", [1, 2, 3])
def test_a_debiased_loss_is_unbiased_for_any_number_of_samples(first: int) -> None:
    from unrender.estimators.loss_values import BlackBox

    asked = problem(noise=0.9, views=1)
    at = asked.initial()
    renderer = asked.renderer
    assert isinstance(renderer, AnalyticRenderer)
    expected = float(asked.loss_value(0, renderer.exact(at)))
    found = [[BlackBox(asked, at, first + 1, Key(seed), on).center() for seed in range(300)] for on in (True, False)]
    assert worst(np.array(found[0])[:, None], np.array([expected])) < 3.3
    assert worst(np.array(found[1])[:, None], np.array([expected])) > 3.3


def test_halves_that_are_the_same_render_are_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    """A planted fault: with one seed for both halves, the product of their errors is a square, and biased like one."""
    from unrender.estimators import loss_values

    asked = problem(noise=0.9, views=1)
    at = asked.initial()
    renderer = asked.renderer
    assert isinstance(renderer, AnalyticRenderer)
    expected = np.array([float(asked.loss_value(0, renderer.exact(at)))])

    def found() -> np.ndarray:
        return np.array([[loss_values.BlackBox(asked, at, 2, Key(seed), True).center()] for seed in range(300)])

    assert worst(found(), expected) < 3.3
    monkeypatch.setattr(loss_values, "_other", lambda seed: seed)
    assert worst(found(), expected) > 3.3


def test_a_snapshot_s_image_of_a_state_in_between_is_unbiased() -> None:
    """What the gradient's memory needs of a control variate with mini-batches: the image of the last step, not of the snapshot's."""
    asked = problem(keys=("map",), views=1)
    image, pixels = CV("primary"), ur.pixels.Uniform(16)
    renderer = asked.renderer
    assert isinstance(renderer, AnalyticRenderer)
    at = [{"map": asked.initial()["map"] + 0.1 * step} for step in range(3)]
    rows, told = [], []
    for seed in range(300):
        path = ur.PathGradient(image, pixels, spp=2)
        _, state = path.estimate(asked, at[0], path.init(asked, at[0]), Key(seed))
        batch, _ = pixels.draw(asked, at[2], state.pixels, Key(0))
        assert batch.sample is not None
        request = PairRequest(at[1], "primary", 1, 1)
        frame = PixelBatch(asked, batch.sample)
        found, _ = image.estimate(asked, at[2], state.image, frame, 2, 2, Key(seed, 7), request)
        assert found.previous is not None
        rows.append(found.previous.mean(axis=0).ravel())
        told = renderer.exact(at[1]).reshape(-1, 3)[batch.sample.pixels].ravel()
        other = renderer.exact(at[0]).reshape(-1, 3)[batch.sample.pixels].ravel()
    assert worst(np.array(rows), np.array(told)) < 4.2
    assert worst(np.array(rows), np.array(other)) > 4.2, "the snapshot's own image would have passed"


@pytest.mark.slow
@pytest.mark.mitsuba  # a run folder asks for it
def test_all_four_recover_both_and_resume_to_the_bit(tmp_path: Path) -> None:
    rates = {"*": 0.01, "pose": 0.01}
    optimizer = ur.optimizers.MetaAdam(rates, schedule=ur.schedules.Exponential(60))
    whole = ur.optimize(problem(), all_four(), optimizer, steps=150, run_directory=tmp_path / "whole")
    error = problem().parameter_error(whole.parameters)
    before = problem().parameter_error(whole.initial)
    assert all(error[key] < 0.4 * before[key] for key in error), (before, error)
    ur.optimize(problem(), all_four(), optimizer, steps=67, run_directory=tmp_path / "part")
    ended = ur.resume(tmp_path / "part", problem(), steps=150)
    for key, value in whole.parameters.items():
        np.testing.assert_array_equal(ended.parameters[key], value)


def block(**options: Any) -> ur.estimators.HybridGradient:
    return ur.estimators.HybridGradient(ur.PathGradient(spp=2), ur.GaussNewton(8, 4), **options)


def solver(radius: float = 2.0) -> ur.optimizers.Optimizer:
    newton = ur.optimizers.AveragedNewton(trust_radius=radius)
    return ur.optimizers.Partitioned(("pose",), newton, ur.optimizers.Adam(0.02))


@pytest.mark.slow
@pytest.mark.mitsuba  # a run folder asks for it
def test_a_block_of_numbers_is_solved_beside_a_texture(tmp_path: Path) -> None:
    """In the steps that `wait` and `every` say; with the estimate of its estimator alone; and to the bit after a pause."""
    asked, estimator = problem(), block(wait=3, every=2)
    poses: list[np.ndarray] = []

    class Poses(Callback):
        def on_step(self, run: Any, record: Any) -> None:
            poses.append(np.array(run.parameters["pose"]))

    whole = ur.optimize(asked, estimator, solver(), steps=80, callbacks=[Poses()])
    moved = [bool(np.any(a != b)) for a, b in itertools.pairwise(poses)]
    assert np.all(poses[2] == asked.initial()["pose"])
    assert moved[2:10] == [True, False, True, False, True, False, True, False]
    errors = asked.parameter_error(whole.parameters)
    assert errors["pose"] < 0.04
    assert errors["map"] < 0.05
    first = ur.optimize(asked, block(wait=9), solver(), steps=6)
    assert not [line for line in first.warnings if "gradient is zero" in line]
    ur.optimize(asked, estimator, solver(), steps=20, run_directory=tmp_path / "run")
    resumed = ur.resume(tmp_path / "run", asked, steps=80)
    for key in TRUTH:
        np.testing.assert_array_equal(resumed.parameters[key], whole.parameters[key])


@pytest.mark.parametrize("radius", [2.0, 0.01])
def test_a_block_on_its_way_has_too_few_steps_to_judge(radius: float) -> None:
    """It has no standard error that could tell, and ended as finished without a word."""
    found = ur.optimize(problem(), block(), solver(radius), steps=12)
    line = "12 steps are too few to judge whether pose converged: give more steps"
    assert found.warnings == [line] * (radius < 1.0)


def test_a_block_is_the_estimate_of_the_numbers_alone() -> None:
    asked, estimator = problem(), block()
    point = asked.initial()
    found, _ = estimator.estimate(asked, point, estimator.init(asked, point), Key(3))
    own = found.require("test", BlockEstimate)
    alone = HeldParameters(asked.renderer, {"map": point["map"]})
    inner = ur.GaussNewton(8, 4)
    part = asked.with_parts(renderer=alone)
    expected, _ = inner.estimate(
        part, {"pose": point["pose"]}, inner.init(part, {"pose": point["pose"]}), Key(3).fold(1 << 33)
    )
    assert own.keys == ("pose",)
    np.testing.assert_array_equal(own.estimate.gradient["pose"], expected.gradient["pose"])
    np.testing.assert_array_equal(own.estimate.hessian, expected.hessian)


def test_a_block_keeps_no_mean_residuals() -> None:
    """No error is stated of a block, which takes the other unknowns as known. Alone, 24 bytes per pixel are kept."""
    asked, estimator = problem(), block()
    point = asked.initial()
    _, state = estimator.estimate(asked, point, estimator.init(asked, point), Key(3))
    assert state.perturbed.widths  # pyright: ignore[reportAttributeAccessIssue]
    assert state.perturbed.residuals == ()  # pyright: ignore[reportAttributeAccessIssue]
    alone = asked.with_parts(renderer=HeldParameters(asked.renderer, {"map": point["map"]}))
    inner, part = ur.GaussNewton(8, 4), {"pose": point["pose"]}
    _, own = inner.estimate(alone, part, inner.init(alone, part), Key(3))
    assert sum(mean.one.nbytes + mean.other.nbytes for mean in own.residuals) == 24 * asked.pixels


def test_auto_gives_poses_beside_a_texture_a_block_of_their_own() -> None:
    plan = method("auto").plan(problem())
    assert isinstance(plan.estimator, ur.estimators.HybridGradient)
    assert isinstance(plan.estimator.perturbed, ur.GaussNewton)
    assert isinstance(plan.optimizer, ur.optimizers.Partitioned)
    assert plan.optimizer.keys == plan.estimator.keys == ("pose",)
    assert plan.estimator.wait == 8
    assert "Gauss-Newton steps for 2 numbers" in plan.reasons[0]
    assert "pose" not in plan.reasons[-1]
    other = method("auto").plan(absolute()).estimator
    assert isinstance(other, ur.estimators.HybridGradient)
    assert isinstance(other.perturbed, ur.SmoothedDerivatives)


def test_textures_beside_poses_trace_no_sample_of_noise() -> None:
    """It decides first rates of optimizers that see all unknowns, and costs an adjoint."""
    truth = {"map": np.full((8, 8, 1), 0.6), "pose": TRUTH["pose"]}
    renderer = PosedRenderer(truth, np.random.default_rng(1).uniform(0.0, 1.0, (48, 66)), 0.1, 0.5, shape=SHAPE)
    views = [ur.View(renderer.exact(truth))]
    for loss in (ur.losses.L2(), ur.losses.L1()):  # with a block, and with a smoothed loss
        for keys, sampled in ((("map",), True), (("map", "pose"), False)):
            asked = ur.Problem(renderer, [ur.Parameter(key, 0.5, (0, 1)) for key in keys], views, loss)
            plan = method("auto").plan(asked).estimator
            path = plan.path if isinstance(plan, ur.estimators.HybridGradient) else plan
            assert isinstance(path, ur.PathGradient)
            assert path.noise_sample == sampled


def test_the_variance_of_what_is_perturbed_is_a_mean_square() -> None:
    """So that MetaAdam's steps are no longer than its learning rate."""
    asked = problem(noise=0.0)
    estimator = ur.estimators.HybridGradient(ur.MetaEstimator(coupled=True), smoothed(samples=64))
    found = ur.estimate(asked, estimator)
    assert found.variance is not None
    assert (found.variance["pose"] > found.gradient["pose"] ** 2).all()
    state = (optimizer := ur.optimizers.MetaAdam(0.1)).init(asked.initial())
    steps, _ = optimizer.update(found, state, asked.initial())
    assert (np.abs(steps["pose"]) < 0.1).all()


def test_what_is_perturbed_has_running_means_where_asked_for() -> None:
    """So that MetaAdam's steps are Adam's, and no longer than its learning rate."""
    asked, at = problem(noise=0.0), problem().initial()
    hybrid, alone = (
        ur.estimators.HybridGradient(ur.MetaEstimator(coupled=True), smoothed(), averaged=True),
        ur.estimators.HybridGradient(perturbed=smoothed()),
    )
    state, own = hybrid.init(asked, at), alone.init(asked, at)
    rule, adam = ur.optimizers.MetaAdam(0.1), ur.optimizers.Adam(0.1)
    moments, steps, expected = adam.init(at), {}, {}
    for seed in range(4):
        found, state = hybrid.estimate(asked, at, state, Key(seed))
        steps, _ = rule.update(found, rule.init(at), at)
        expected, moments = adam.update(alone.estimate(asked, at, own, Key(seed))[0], moments, at)
    np.testing.assert_allclose(steps["pose"], expected["pose"], rtol=1e-5)
    assert (np.abs(steps["pose"]) < 0.1001).all()


def test_methods_choose_it_and_give_what_is_perturbed_a_rate_of_its_own() -> None:
    asked = problem()
    choice = method("auto").plan(absolute(), {"sigma": "0.3, pose=0.4"})
    assert isinstance(choice.estimator, ur.estimators.HybridGradient)
    assert choice.estimator.keys == ("pose",)
    assert isinstance(choice.estimator.path, ur.PathGradient)
    assert choice.estimator.path.image == CV("primary", max_weight=0.97)
    assert isinstance(choice.optimizer, ur.optimizers.ScheduleFree)
    assert dict(choice.optimizer.learning_rate)["pose"] == pytest.approx(0.2)  # pyright: ignore[reportArgumentType, reportCallIssue]
    assert choice.reasons[0] == "perturbed renders of pose: it moves"
    settings = {"sigma": "0.3", "step": 0.1, "gradient": "coupled", "image": "rcv", "pixels": 16, "spp": 2}
    choice = method("hybrid").plan(asked, settings)
    estimator, optimizer = choice.estimator, choice.optimizer
    assert isinstance(estimator, ur.estimators.HybridGradient)
    image, drawn = CV("primary", max_weight=0.95), ur.pixels.Adaptive(16)
    assert estimator.path == ur.MetaEstimator(
        coupled=True, spp=2, image=image, space="primary", pixels=drawn, max_weight=0.8
    )
    assert isinstance(optimizer, ur.optimizers.MetaAdam)
    assert optimizer.learning_rate == pytest.approx({"*": 0.01, "pose": 0.03})
    assert ur.optimize(asked, estimator, optimizer, steps=2).skipped == 0
    assert isinstance(method("auto").plan(problem(keys=("pose",))).estimator, ur.GaussNewton)
    assert isinstance(method("auto").plan(problem(keys=("map",))).estimator, ur.PathGradient)


def wrong(given: Any) -> Any:
    """An argument of the wrong type."""
    return given


@pytest.mark.parametrize(
    ("made", "said"),
    [
        (lambda: ur.estimators.HybridGradient(wrong(ur.PathGradient)), "path must be one of unrender.estimators"),
        (lambda: ur.estimators.HybridGradient(ur.SmoothedDerivatives(0.1)), "of path gradients"),
        (lambda: ur.estimators.HybridGradient(ur.estimators.LossValues()), "of path gradients"),
        (lambda: ur.estimators.HybridGradient(perturbed=ur.SmoothedDerivatives(0.1, order="hvp")), "no curvature"),
        (lambda: ur.estimators.HybridGradient(keys=wrong("pose")), "keys must be a list"),
        (lambda: ur.SmoothedDerivatives(0.1, spp=1, debiased=True), "spp must be"),
    ],
)
def test_what_makes_no_sense_is_refused_at_once(made: Any, said: str) -> None:
    with pytest.raises(ur.InputError, match=said):
        made()


@pytest.mark.parametrize(
    ("options", "keys", "said"),
    [
        ({"keys": ("pole",)}, ("map", "pose"), "pole, which is not a parameter; did you mean pose"),
        ({"keys": ()}, ("map", "pose"), "at least one"),
        ({"keys": ("map", "pose")}, ("map", "pose"), "use SmoothedDerivatives"),
        ({}, ("map",), "path gradients suit all"),
        ({"path": ur.PathGradient(CV())}, ("map", "pose"), "no paths shared"),
        ({"keys": ("map",)}, ("map", "pose"), "no path gradient"),
        ({"perturbed": ur.SmoothedDerivatives({"map": 0.1, "*": 0.1})}, ("map", "pose"), "sigma names map"),
    ],
)
def test_what_does_not_suit_a_problem_is_refused_before_the_first_step(options: Any, keys: Any, said: str) -> None:
    asked = problem(keys=keys)
    with pytest.raises(ur.InputError, match=said):
        ur.estimators.HybridGradient(**options).init(asked, asked.initial())
