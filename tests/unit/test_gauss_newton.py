"""`GaussNewton` and `AveragedNewton` against closed forms, on a renderer with known derivatives."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import unrender as ur
from tests.analytic import AnalyticRenderer
from tiers import quick
from unrender.core.random import Key
from unrender.estimators import derivative_images
from unrender.estimators import gauss_newton as module
from unrender.estimators import gauss_newton_system as system
from unrender.estimators.base import Estimate
from unrender.estimators.capabilities import (
    AtBounds,
    GradientNoise,
    Hessian,
    HessianNoise,
    ScoreCovariance,
    Smoothing,
)
from unrender.optimizers import AveragedNewton, Partitioned, Successive, averaged_newton
from unrender.optimizers.newton import trust_region_step
from unrender.optimizers.partitioned import PartitionedState, SuccessiveState
from unrender.runs.callbacks import Callback
from unrender.runs.folder import reader
from unrender.runs.folder.state import not_finite, pack

TRUTH = {"a": np.array([0.4, -0.2]), "b": np.array([0.7])}
START = {"a": np.array([0.55, -0.1]), "b": np.array([0.5])}
MATRIX = np.random.default_rng(3).normal(size=(4 * 5 * 3, 3))


def problem(loss: Any = None, noise: float = 0.6) -> ur.Problem:
    renderer = AnalyticRenderer(TRUTH, MATRIX, 0.1, noise, grain=0.3, shape=(4, 5))
    unknown = [ur.Parameter(key, initial=value) for key, value in START.items()]
    return ur.Problem(renderer, unknown, [ur.View(renderer.exact(TRUTH))], loss or ur.losses.L2(), truth=TRUTH)


def problem_of(matrix: np.ndarray) -> ur.Problem:
    """The problem with another derivative of the image, without grain."""
    renderer = AnalyticRenderer(TRUTH, matrix, 0.1, 0.6, shape=(4, 5))
    unknown = [ur.Parameter(key, initial=value) for key, value in START.items()]
    return ur.Problem(renderer, unknown, [ur.View(renderer.exact(TRUTH))], ur.losses.L2(), truth=TRUTH)


def estimates(
    made: ur.Problem, count: int = 150, coarse: float | None = None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Gradients (count, n), Hessians (count, n, n) and their noise at the start."""
    estimator = ur.GaussNewton(spp=2, derivative_spp=2, coarse=coarse)
    state = module.GaussNewtonState({"a": 0.02, "b": 0.03})
    found = [estimator.estimate(made, START, state, Key(seed))[0] for seed in range(count)]
    gradients = [np.concatenate([one.gradient[key] for key in START]) for one in found]
    hessians = np.stack([one.require("test", Hessian).matrix for one in found])
    return np.stack(gradients), hessians, np.stack([one.require("test", HessianNoise).matrix for one in found])


def off(samples: np.ndarray, expected: np.ndarray) -> float:
    """The largest deviation of a mean, in its standard errors."""
    error = samples.std(axis=0, ddof=1) / np.sqrt(len(samples))
    return float(np.max(np.abs(samples.mean(axis=0) - expected) / error))


def test_gradient_and_matrix_are_unbiased_and_one_half_alone_is_not(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a linear image: g = 2 Aᵀ A (θ - θ*) / N and H = 2 Aᵀ A / N; noise of uniform factors of 1 ± 0.6 adds 0.6² / 3 / 2 of H.

    4.5 standard errors: 1e-5 for each of 21 numbers.
    """
    made = problem()
    hessian = 2.0 * MATRIX.T @ MATRIX / len(MATRIX)
    away = np.concatenate([START[key] - TRUTH[key] for key in START])
    gradients, hessians, noise = estimates(made)
    assert off(gradients, hessian @ away) < 4.5
    assert off(hessians, hessian) < 4.5
    assert off(noise, 0.06 * hessian) < 4.5
    products = system.products
    monkeypatch.setattr(system, "products", lambda halves, *rest: products([halves[0], halves[0]], *rest))
    _, hessians, _ = estimates(made)
    assert off(hessians, hessian) > 4.5


def test_wide_differences_compare_sums_over_blocks_of_pixels() -> None:
    """With S the sums over blocks, over the root of their size: g = 2 (S A)ᵀ S A (θ - θ*) / N. At the border of 4 × 5 pixels, blocks of
    3 × 3 are 1 × 3, 3 × 2 and 1 × 2 pixels."""
    image = MATRIX.reshape(4, 5, 3, 3)
    parts = [block for rows in (image[:3], image[3:]) for block in (rows[:, :3], rows[:, 3:])]
    summed = np.concatenate([part.sum(axis=(0, 1)) / np.sqrt(part.shape[0] * part.shape[1]) for part in parts])
    hessian = 2.0 * summed.T @ summed / len(MATRIX)
    away = np.concatenate([START[key] - TRUTH[key] for key in START])
    gradients, hessians, _ = estimates(problem(), coarse=3.5)
    assert off(gradients, hessian @ away) < 4.5
    assert off(hessians, hessian) < 4.5
    assert off(hessians, 2.0 * MATRIX.T @ MATRIX / len(MATRIX)) > 4.5


def test_differences_become_sharper_once_steps_are_short() -> None:
    made, estimator = problem(), ur.GaussNewton(2, 2, shift=0.5, coarse=4.0)
    state = estimator.init(made, START)
    shifts = []
    for distance in (0.0, 100.0, 0.1, 0.1, 0.1, 0.1):
        point = dict(START)
        if state.point is not None:
            point["b"] = np.array([state.point[2] + distance * state.widths["b"]])
        _, state = estimator.estimate(made, point, state, Key(0))
        shifts.append(state.shift)
    assert shifts == [4.0, 4.0, 2.0, 1.0, 0.5, 0.5]


@pytest.mark.parametrize("loss", [ur.losses.L1(), ur.losses.Censored(white=1e-3)], ids=["L1", "Censored"])
def test_losses_that_are_not_linear_have_a_secant_that_is_damped_by_noise(loss: Any) -> None:
    """L1 of an image without noise: ℓ' is the sign, ℓ'' is 1 / |r|. Darker images count where the reference is saturated; they had no
    weight."""
    made = problem(loss, noise=0.0)
    made.renderer.grain = 0.0  # pyright: ignore[reportAttributeAccessIssue]
    estimate, _ = ur.GaussNewton(2, 2).estimate(made, START, module.GaussNewtonState({"a": 0.1, "b": 0.1}), Key(1))
    away, reference = MATRIX @ np.concatenate([START[key] - TRUTH[key] for key in START]), np.ravel(made.reference(0))
    counts = (away < 0.0) | (reference < getattr(loss, "white", np.inf))
    assert ((away < 0.0) & (reference > 1e-3)).any()
    expected = MATRIX.T @ (np.sign(away) * counts) / len(MATRIX)
    np.testing.assert_allclose(np.concatenate([estimate.gradient[key] for key in START]), expected, rtol=1e-5)
    weighted = MATRIX.T @ (MATRIX * (counts / np.abs(away))[:, None]) / len(MATRIX)
    np.testing.assert_allclose(estimate.require("test", Hessian).matrix, weighted, rtol=1e-3)


@pytest.mark.parametrize("remember", [True, False])
@pytest.mark.parametrize("scores", [True, False])
@pytest.mark.parametrize("spp", [4, 2], ids=["image", "differences"])
def test_steps_with_a_pixel_that_is_not_finite_are_skipped(
    spp: int, scores: bool, remember: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A NaN in every seventh image or difference. The other steps reach the solution; a mean of earlier differences leaves it out.

    The largest error of 20 seeds is 0.027.
    """
    own, renders = system.Point._states, iter(range(1 << 20))

    def states(self: Any, points: np.ndarray, view: int, key: Key, count: int) -> np.ndarray:
        images = own(self, points, view, key, count)
        if count == spp and next(renders) % 7 == 3:
            images[0, 1, 1, 0] = np.nan
        return images

    monkeypatch.setattr(system.Point, "_states", states)
    monkeypatch.setattr("unrender.runs.verify.Verify.on_result", lambda self, descent, result: result)
    estimator = ur.GaussNewton(4, 2, noise_limit=1.0, scores=scores, remember=remember)
    found = ur.optimize(problem(), estimator, AveragedNewton(), steps=40)
    assert found.status == "finished"
    assert 0 < found.skipped < 20
    for key, value in TRUTH.items():
        np.testing.assert_allclose(found.parameters[key], value, atol=0.05)


def test_widths_are_those_of_a_shift_of_the_picture() -> None:
    made = problem(noise=0.0)
    estimator = ur.GaussNewton(64, 64, shift=0.5)
    _, state = estimator.estimate(made, START, estimator.init(made, START), Key(0))
    image = made.renderer.exact(START)  # pyright: ignore[reportAttributeAccessIssue]
    slope = 0.5 * sum(np.square(np.diff(image, axis=axis)).sum() for axis in (0, 1))
    squares = np.square(MATRIX).sum(axis=0)
    for key, part in (("a", squares[:2]), ("b", squares[2:])):
        # The slope is that of an image with noise that two halves do not share: no more than its own noise off.
        assert state.widths[key] == pytest.approx(0.5 * np.sqrt(slope / part.mean()), rel=0.1)


@pytest.mark.parametrize("grows", [True, False])
def test_widths_grow_while_differences_change_no_picture(grows: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """As where few paths hit a lamp behind glass, so that small differences change no sample. The planted fault is a width that stays."""
    own, step = system.Point._states, 0.05

    def rounded(self: Any, points: np.ndarray, view: int, key: Key, spp: int) -> np.ndarray:
        return own(self, step * np.round(points / step), view, key, spp)

    monkeypatch.setattr(system.Point, "_states", rounded)
    if not grows:
        monkeypatch.setattr(module, "_BLIND", 0.0)
    made, estimator = problem_of(MATRIX), ur.GaussNewton(spp=2, derivative_spp=2, width=0.01)
    start = {key: x + 0.2 * step for key, x in START.items()}
    estimate = estimator.estimate(made, start, estimator.init(made, start), Key(0))[0]
    widths = estimate.require("test", Smoothing).sigma
    assert all((float(width) > 0.5 * step) is grows for width in widths.values())
    assert bool(np.diag(estimate.require("test", Hessian).matrix).any()) is grows


def test_views_that_a_parameter_does_not_change_are_not_rendered() -> None:
    renderer = AnalyticRenderer(TRUTH, MATRIX, 0.1, 0.0, shape=(4, 5), sensors=2)
    found = renderer.parameters()
    known = {key: replace(found[key], sensor=index) for index, key in enumerate(found)}
    renderer.parameters = lambda: known  # pyright: ignore[reportAttributeAccessIssue]
    views = [ur.View(renderer.exact(TRUTH), sensor) for sensor in (0, 1)]
    made = ur.Problem(renderer, [ur.Parameter(key) for key in TRUTH], views, ur.losses.L2())
    state = module.GaussNewtonState({"a": 0.1, "b": 0.1})
    estimate, _ = ur.GaussNewton(4, 2).estimate(made, START, state, Key(0))
    assert estimate.info["samples"] == 20 * (2 * 4 + (4 + 2) * 2)
    assert not estimate.hessian[:2, 2:].any()  # pyright: ignore[reportOptionalSubscript]


def test_what_it_refuses() -> None:
    with pytest.raises(ur.InputError, match=r"coarse must be at least shift, 0\.3, got 0\.1"):
        ur.GaussNewton(coarse=0.1)
    with pytest.raises(ur.InputError, match="spp must be a whole number of at least 2, got 1"):
        ur.GaussNewton(spp=1)
    with pytest.raises(ur.InputError, match="shift must be a finite number > 0, got 0"):
        ur.GaussNewton(shift=0)
    with pytest.raises(ur.InputError, match="noise_limit must be a finite number > 0, got 0"):
        ur.GaussNewton(noise_limit=0.0)
    with pytest.raises(ur.InputError, match="damping must be"):
        AveragedNewton(damping=0)
    made = problem()
    with pytest.raises(ur.InputError, match="largest names c, which is not a parameter"):
        ur.GaussNewton(largest={"c": 1.0}).init(made, START)
    with pytest.raises(ur.InputError, match='linear: unknown parameter "c"'):
        AveragedNewton(linear=("c",)).init(START)
    smooth = replace(made.unknowns["a"], preconditioner=ur.preconditioners.LargeSteps(1.0))
    made = made.with_parts(unknowns={**made.unknowns, "a": smooth})
    with pytest.raises(ur.InputError, match="parameter a has a preconditioner"):
        ur.GaussNewton().init(made, START)


# ---------------------------------------------------------------------- steps


def model(hessian: np.ndarray, minimum: np.ndarray, x: np.ndarray, noise: Any = 0.0, **more: Any) -> Estimate:
    """The exact quadratic model at x, with noise on its gradient."""
    return Estimate(0.0, {"x": hessian @ (x - minimum) + noise}, (Hessian(hessian), *more.values()))


HESSIAN = np.array([[3.0, 1.0, 0.0], [1.0, 2.0, 0.0], [0.0, 0.0, 0.5]])
MINIMUM = np.array([0.2, -0.3, 0.4])


def test_the_first_step_is_newtons_and_long_ones_end_at_the_trust_region() -> None:
    optimizer = AveragedNewton(trust_radius=None)
    x = np.zeros(3)
    steps, _ = optimizer.update(model(HESSIAN, MINIMUM, x), optimizer.init({"x": x}), {"x": x})
    np.testing.assert_allclose(steps["x"], MINIMUM, rtol=1e-9)
    assert not not_finite(optimizer.init({"x": x}))  # which no checkpoint could store
    optimizer = AveragedNewton(trust_radius=0.1)
    sigma = {"sigma": Smoothing({"x": 2.0})}
    steps, _ = optimizer.update(model(HESSIAN, MINIMUM, x, **sigma), optimizer.init({"x": x}), {"x": x})
    assert np.linalg.norm(steps["x"][:2]) == pytest.approx(0.2)  # each of what the Hessian does not connect
    assert abs(steps["x"][2]) == pytest.approx(0.2)


@pytest.mark.parametrize("gradient", [(1.0, 0.0), (1.0, 1e-3), (0.0, 2.0)])
def test_directions_without_curvature_end_at_the_trust_region(gradient: tuple[float, float]) -> None:
    """A box that filled the picture had none; NumPy printed that it divides by 0, and the step was not finite."""
    step = trust_region_step(np.array([10.0, 0.0]), np.array(gradient), 0.5)
    along = -np.array(gradient) / 10.0 if gradient[1] == 0.0 else step
    assert step == pytest.approx(along)
    assert step @ gradient < 0.0
    assert np.linalg.norm(step) == pytest.approx(0.1 if gradient[1] == 0.0 else 0.5)


@pytest.mark.parametrize("settled", [None, 1.0])
def test_noise_falls_as_the_root_of_the_steps(settled: float | None) -> None:
    """Near the minimum, where steps are short: the error after n steps is that of the weighted mean of n gradients, H⁻¹ Σ w e.

    Later weights may grow as the number of steps; the variance is then 4 / 3 of the least one. The first step has hardly any weight.
    """
    optimizer, n = AveragedNewton(averaging=2.0, settled_averaging=settled), 60
    weights = np.ones(n)
    for step in range(n):
        growth = 2.0 if step < 8 or settled is None else settled
        share = (1.0 + growth) / (step + 1.0 + growth)
        weights[step] = share
        weights[:step] *= 1.0 - share
    assert n * np.square(weights).sum() == pytest.approx(9.0 / 5.0 if settled is None else 4.0 / 3.0, rel=0.06)
    assert weights[0] < 1e-3
    rng = np.random.default_rng(0)
    x, state = MINIMUM.copy(), optimizer.init({"x": MINIMUM})
    noises = 1e-3 * rng.normal(size=(n, 3))
    for noise in noises:
        steps, state = optimizer.update(model(HESSIAN, MINIMUM, x, noise), state, {"x": x})
        x = x + steps["x"]
    np.testing.assert_allclose(x - MINIMUM, -np.linalg.solve(HESSIAN, weights @ noises), rtol=1e-2, atol=1e-7)


@pytest.mark.parametrize(
    ("rate", "radius", "steps", "short"),
    [(0.01, 1.0, 12, True), (0.3, 1.0, 12, False), (1.0, 0.01, 40, True)],
)
def test_steps_on_the_way_to_the_minimum_are_too_few_to_judge(
    rate: float, radius: float, steps: int, short: bool
) -> None:
    """Steps as long as their region allows have no mean of models, or one whose minimum they have not reached, and no standard error.
    They ended as finished, without a word."""
    optimizer = AveragedNewton(learning_rate=rate, trust_radius=radius)
    found = ur.optimize(problem(), ur.GaussNewton(4, 4), optimizer, steps=steps)
    assert bool(abs(found.parameters["b"] - TRUTH["b"]).max() > 0.1) is short
    line = f"{steps} steps are too few to judge whether a, b converged: give more steps"
    assert found.warnings == [line] * short
    assert bool(found.standard_error) is not short


@pytest.mark.parametrize(("errors", "radius", "told"), [(0.5, 1.0, "xy"), (2.0, 1.0, "y"), (2.0, 3.0, "xy")])
def test_only_numbers_that_the_trust_region_holds_away_from_the_minimum_have_no_standard_error(
    errors: float, radius: float, told: str
) -> None:
    """A point some standard errors away from the mean's minimum, after a step of length 1 in a region of this radius."""
    optimizer, tree = AveragedNewton(), {"x": MINIMUM[:2], "y": MINIMUM[2:]}
    state, rng = optimizer.init(tree), np.random.default_rng(0)
    for noise in 1e-3 * rng.normal(size=(20, 3)):
        parts = Hessian(HESSIAN), ScoreCovariance(np.zeros((3, 3)))
        _, state = optimizer.update(Estimate(0.0, {"x": noise[:2], "y": noise[2:]}, parts), state, tree)
    minimum = np.linalg.solve(state.matrix, state.target)
    tree = {"x": minimum[:2], "y": minimum[2:]}
    known = optimizer.standard_errors(state, tree)
    away = {"x": minimum[:2] + np.array([errors * known["x"][0], 0.0]), "y": minimum[2:]}
    held = replace(state, lengths=np.ones(3), radii=np.full(3, radius))
    assert "".join(optimizer.standard_errors(held, away)) == told
    unsettled = {"x", "y"} - set(told)
    assert optimizer.unsettled(held, away) == unsettled
    assert optimizer.unsettled(replace(held, scores=None), away) == unsettled  # as in a block, which states no errors
    block, after = Partitioned(("x", "y"), optimizer), Successive(then=optimizer)
    assert block.unsettled(PartitionedState(held, None), {"map": np.zeros(9), **away}) == unsettled
    assert after.unsettled(SuccessiveState(None, held, changed=True), away) == unsettled
    assert not after.unsettled(SuccessiveState(None, held), away)
    # Weights that change with the noise leave few models, and steps at noisy references that are shorter than the errors.
    few, error = replace(state, counts=np.ones(3)), np.concatenate([known["x"], known["y"]])
    assert not optimizer.unsettled(replace(few, step=0.5 * error), tree)
    assert optimizer.unsettled(replace(few, step=2.0 * error), tree) == {"x", "y"}


@pytest.mark.slow
def test_standard_errors_cover_the_truth_in_68_percent_of_the_seeds(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Any
) -> None:
    """Of 100 seeds times 3 numbers, within 8 percent. A planted fault, half the scatter, is seen. A run folder has them."""
    monkeypatch.setattr("unrender.runs.verify.Verify.on_result", lambda self, descent, result: result)
    made, scores = problem(), []
    for seed in range(100):
        found = ur.optimize(made, ur.GaussNewton(4, 4), AveragedNewton(), steps=40, seed=seed)
        scores += [
            x for key, error in found.standard_error.items() for x in np.abs(found.parameters[key] - TRUTH[key]) / error
        ]
    assert len(scores) == 300
    assert abs(np.mean(np.array(scores) < 1.0) - 0.683) < 0.08
    assert abs(np.mean(np.array(scores) < 0.7) - 0.683) > 0.08
    kept = ur.optimize(made, ur.GaussNewton(4, 4), AveragedNewton(), steps=40, run_directory=tmp_path / "run")
    record = reader.read_run_record(tmp_path / "run")
    assert {key: len(x) for key, x in record.standard_error.items()} == {"a": 2, "b": 1}
    np.testing.assert_allclose(np.array(record.standard_error["a"], float), kept.standard_error["a"], rtol=1e-5)


WIDE = np.array([[0.1, 0.5, 0.1], [0.5, 1.0, 0.5], [0.1, 0.5, 0.1]])
"""A film filter that neighbours share, whose taps sum to 3.4."""


def noisy(shape: tuple[int, int], seed: int, grey: bool, filtered: bool, size: float = 0.5) -> np.ndarray:
    """Noise of a reference (H, W, 3): equal in all channels, and shared by neighbouring pixels."""
    from scipy.ndimage import convolve

    noise = np.random.default_rng(seed).normal(0.0, size, (*shape, 1 if grey else 3)) * np.ones(3)
    return convolve(noise, WIDE[..., None], mode="wrap") if filtered else noise


@pytest.mark.slow
@pytest.mark.parametrize(("grey", "filtered"), [(False, False), (True, True)])
def test_standard_errors_cover_the_noise_of_the_references(
    monkeypatch: pytest.MonkeyPatch, grey: bool, filtered: bool
) -> None:
    """Of 40 noisy references times 3 numbers of smooth pictures, 68 percent within 10: 2.4 standard errors of 120 draws. A planted fault,
    without the scores, is seen."""
    monkeypatch.setattr("unrender.runs.verify.Verify.on_result", lambda self, descent, result: result)
    shape, scores, planted = (24, 24), [], []
    place = np.stack(np.meshgrid(*(np.linspace(-1.0, 1.0, side) for side in shape), indexing="ij"))
    smooth = [1.0 + 0.3 * place[0], place[1], place[0] * place[1]]
    matrix = np.stack([np.repeat(x.ravel(), 3) for x in smooth], axis=1)
    renderer = AnalyticRenderer(TRUTH, matrix, 0.1, 0.1, shape=shape)
    unknown = [ur.Parameter(key, initial=value) for key, value in START.items()]
    for seed in range(40):
        reference = renderer.exact(TRUTH) + noisy(shape, seed, grey, filtered)
        made = ur.Problem(renderer, unknown, [ur.View(reference.astype(np.float32))], truth=TRUTH)
        for every, without in ((scores, False), (planted, True)):
            if without and seed % 3:
                continue
            with pytest.MonkeyPatch.context() as patch:
                if without:
                    patch.setattr(averaged_newton, "positive_part", np.zeros_like)
                found = ur.optimize(made, ur.GaussNewton(4, 4), AveragedNewton(), steps=24, seed=seed)
            every += [
                x for key, error in found.standard_error.items() for x in (found.parameters[key] - TRUTH[key]) / error
            ]
    assert len(scores) > 90
    assert abs(np.mean(np.abs(scores) < 1.0) - 0.683) < 0.10
    assert abs(np.mean(np.abs(planted) < 1.0) - 0.683) > 0.10


def ratio_of_variances(seeds: int) -> float:
    """Return the stated variance over the true one, where one pixel of four has most of the derivative, and references have noise."""
    shape = (6, 8)
    matrix = 0.2 * np.random.default_rng(5).normal(size=(48, 3, 3))
    matrix[::4] *= 6.0
    matrix = matrix.reshape(-1, 3)
    renderer = AnalyticRenderer(TRUTH, matrix, 0.1, 0.3, shape=shape)
    unknown = [ur.Parameter(key, initial=value) for key, value in START.items()]
    inverse = np.linalg.inv(matrix.T @ matrix)
    grey = matrix.reshape(48, 3, 3).sum(axis=1)
    true = 0.3**2 * np.diag(inverse @ grey.T @ grey @ inverse)
    stated = []
    for seed in range(seeds):
        reference = renderer.exact(TRUTH) + noisy(shape, seed, True, False, 0.3)
        made = ur.Problem(renderer, unknown, [ur.View(reference.astype(np.float32))], truth=TRUTH)
        errors = ur.optimize(made, ur.GaussNewton(4, 4), AveragedNewton(), steps=24, seed=seed).standard_error
        if errors:  # a run whose models are still of other places has none
            stated.append(np.concatenate([np.ravel(errors[key]) for key in TRUTH]) ** 2 / true)
    assert len(stated) > 0.7 * seeds
    return float(np.mean(stated))


@pytest.mark.slow
def test_standard_errors_count_noise_that_the_fit_has_followed(monkeypatch: pytest.MonkeyPatch) -> None:
    """12 pixels decide three numbers. Their residuals are less than the noise, by 1 − h, which the planted fault takes as the noise."""
    monkeypatch.setattr("unrender.runs.verify.Verify.on_result", lambda self, descent, result: result)
    assert 0.85 < ratio_of_variances(16) < 1.4
    monkeypatch.setattr(derivative_images, "_without_own_pixel", lambda residuals, *rest: residuals)
    assert ratio_of_variances(16) < 0.8


def test_exact_references_add_nothing_to_standard_errors(monkeypatch: pytest.MonkeyPatch) -> None:
    """Scores of exact references have mean 0, and their own noise is recognised."""
    monkeypatch.setattr("unrender.runs.verify.Verify.on_result", lambda self, descent, result: result)
    found = ur.optimize(problem(), ur.GaussNewton(4, 4), AveragedNewton(), steps=40)
    monkeypatch.setattr(averaged_newton, "positive_part", np.zeros_like)
    alone = ur.optimize(problem(), ur.GaussNewton(4, 4), AveragedNewton(), steps=40)
    for key, error in found.standard_error.items():
        np.testing.assert_allclose(error, alone.standard_error[key], rtol=0.02)


class Residuals(Callback):
    """Bytes of the mean residuals after each step, and of all arrays that a checkpoint stores of the estimator."""

    def __init__(self) -> None:
        self.kept: set[int] = set()
        self.stored: set[int] = set()

    def on_step(self, run: Any, record: Any) -> None:
        self.kept.add(sum(mean.one.nbytes + mean.other.nbytes for mean in run.state.estimator.residuals))
        tensors = pack(run.snapshot()["estimator"]).tensors
        self.stored.add(sum(x.nbytes for x in tensors.values()))


def test_mean_residuals_are_kept_only_for_an_optimizer_that_states_errors() -> None:
    """Of 20 pixels, 24 bytes each, as many for an earlier image, and the Hessian. A checkpoint of the others has the three parameters of
    the last step and the Hessian."""
    seen = {}
    for optimizer in (AveragedNewton(), ur.optimizers.Newton()):
        one = seen[type(optimizer)] = Residuals()
        ur.optimize(problem(), ur.GaussNewton(2, 2), optimizer, steps=3, callbacks=[one])
    assert seen[AveragedNewton].kept == {20 * 24}
    assert seen[AveragedNewton].stored == {2 * 20 * 24 + 9 * 8 + points * 3 * 8 for points in (1, 2)}
    assert seen[ur.optimizers.Newton].kept == {0}
    assert seen[ur.optimizers.Newton].stored == {3 * 8 + 9 * 8}


@pytest.mark.mitsuba  # which a run folder asks for its version
@pytest.mark.parametrize("most", [20, 19])
def test_references_of_too_many_pixels_for_mean_residuals_leave_no_standard_errors(
    most: int, monkeypatch: pytest.MonkeyPatch, tmp_path: Any
) -> None:
    """Rather than errors of the run's own noise alone. The problem has 20 pixels."""
    monkeypatch.setattr("unrender.runs.verify.Verify.on_result", lambda self, descent, result: result)
    monkeypatch.setattr(system, "MOST_AVERAGED", most)
    seen, parts = Residuals(), (ur.GaussNewton(4, 4), AveragedNewton())
    whole = ur.optimize(problem(), *parts, steps=14, callbacks=[seen])
    assert seen.kept == {20 * 24 if most == 20 else 0}
    assert set(whole.standard_error) == ({"a", "b"} if most == 20 else set())
    ur.optimize(problem(), *parts, steps=12, run_directory=tmp_path / "run")
    again = ur.resume(tmp_path / "run", problem(), steps=14)
    assert not [line for line in again.warnings if "checkpoint" in line]
    for key, value in whole.parameters.items():
        np.testing.assert_array_equal(again.parameters[key], value)


@pytest.mark.parametrize("scores", [(), (ScoreCovariance(np.full((3, 3), np.nan)),)], ids=["none", "not finite"])
def test_an_estimate_without_the_noise_of_the_references_leaves_no_standard_errors(scores: Any) -> None:
    optimizer, rng, x = AveragedNewton(), np.random.default_rng(0), np.zeros(3)
    state = optimizer.init({"x": x})
    for told in (True, False, True):
        for noise in 1e-3 * rng.normal(size=(10, 3)):
            more = (ScoreCovariance(np.zeros((3, 3))),) if told else scores
            estimate = Estimate(0.0, {"x": HESSIAN @ x + noise}, (Hessian(HESSIAN), *more))
            steps, state = optimizer.update(estimate, state, {"x": x})
            x = x + steps["x"]
        assert bool(optimizer.standard_errors(state, {"x": x})) is told


@pytest.mark.parametrize("planted", [False, True])
def test_the_way_to_the_solution_is_no_noise_of_the_references(planted: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Mean residuals of a linear image after three steps are those at the end. The planted fault leaves earlier ones where they were."""
    if planted:
        monkeypatch.setattr(derivative_images.HalvesMean, "plus", lambda mean, change: mean)
    rng = np.random.default_rng(0)
    slopes, reference = rng.normal(size=(2, 4, 5, 3)), rng.normal(size=(4, 5, 3))
    mean, place, step = None, np.zeros(2), np.zeros(2)
    for moved in (0.0, 0.3, 0.2):
        residual = np.tensordot(place, slopes, axes=1) - reference
        weights = derivative_images.LossWeights(residual, np.ones_like(residual), residual, residual)
        derivatives = derivative_images.HalvesMean(slopes, slopes)
        mean = derivative_images.mean_residuals(mean, weights, derivatives, step, moved)
        step = rng.normal(0.0, 0.1, 2)
        place = place + step
    assert mean is not None
    assert np.allclose(mean.one, residual, atol=1e-5) is not planted


def test_an_element_that_changes_no_picture_has_an_infinite_standard_error() -> None:
    matrix = MATRIX.copy()
    matrix[:, 1] = 0.0
    found = ur.optimize(problem_of(matrix), ur.GaussNewton(4, 4), AveragedNewton(), steps=20)
    assert np.isinf(found.standard_error["a"]).tolist() == [False, True]
    assert np.isfinite(found.standard_error["b"]).all()


@pytest.mark.parametrize(("ratio", "told"), [(1e-4, {"y"}), (0.1, {"x", "y"})])
def test_a_direction_that_hardly_shows_has_an_infinite_standard_error(ratio: float, told: set[str]) -> None:
    """A spotlight's turn about its own axis, of which two numbers have a part: their gradients have hardly any noise along it."""
    along, across = np.array([1.0, 2.0]) / np.sqrt(5.0), np.array([2.0, -1.0]) / np.sqrt(5.0)
    hessian = np.zeros((3, 3))
    hessian[:2, :2] = np.outer(across, across) + ratio * np.outer(along, along)
    hessian[2, 2] = 1.0
    optimizer, rng = AveragedNewton(), np.random.default_rng(0)
    tree = {"x": np.zeros(2), "y": np.zeros(1)}
    state = optimizer.init(tree)
    for noise in 1e-3 * rng.normal(size=(20, 3)):
        noise[:2] = noise[0] * across + ratio * noise[1] * along
        place = np.concatenate([tree["x"], tree["y"]])
        gradient = hessian @ place + noise
        steps, state = optimizer.update(
            Estimate(
                0.0, {"x": gradient[:2], "y": gradient[2:]}, (Hessian(hessian), ScoreCovariance(np.zeros((3, 3))))
            ),
            state,
            tree,
        )
        tree = {key: x + steps[key] for key, x in tree.items()}
    errors = optimizer.standard_errors(state, tree)
    assert {key for key, error in errors.items() if np.isfinite(error).all()} == told
    assert errors.keys() == {"x", "y"}


@pytest.mark.parametrize(("noise", "known"), [(0.1, True), (1.0, False)])
def test_a_curvature_that_may_be_noise_leaves_no_standard_error(noise: float, known: bool) -> None:
    """A share of light through a sheet ended at .59 ± .07 instead of .9: noise had made its curvature twice as large as in other runs."""
    optimizer, rng, tree = AveragedNewton(), np.random.default_rng(0), {"x": np.zeros(2)}
    state, hessian = optimizer.init(tree), np.diag([1.0, 0.5])
    for own in 1e-3 * rng.normal(size=(20, 2)):
        parts = Hessian(hessian), HessianNoise(np.diag([0.0, noise])), ScoreCovariance(np.zeros((2, 2)))
        steps, state = optimizer.update(Estimate(0.0, {"x": hessian @ tree["x"] + own}, parts), state, tree)
        tree = {"x": tree["x"] + steps["x"]}
    assert np.isfinite(optimizer.standard_errors(state, tree)["x"]).tolist() == [True, known]


def bounds(x: np.ndarray) -> AtBounds:
    """Return where x is at the bound of x₀ >= 0."""
    return AtBounds(lambda: {"x": np.array([-1.0 if x[0] <= 0.0 else 0.0, 0.0])})


@pytest.mark.parametrize("steps", [6, 7])
@pytest.mark.parametrize("stays", [True, False])
def test_others_take_the_minimum_for_an_element_at_its_bound(stays: bool, steps: int) -> None:
    """x₀ >= 0 with the minimum of the model at x₀ = −1: the other is 1 at the bound, and 1.5 where bounds are unknown."""
    hessian, minimum = np.array([[1.0, 1.0], [1.0, 2.0]]), np.array([-1.0, 1.5])
    optimizer, tree = AveragedNewton(trust_radius=None), {"x": np.array([1.0, 0.0])}
    state = optimizer.init(tree)
    for _ in range(steps):
        gradient, at = hessian @ (tree["x"] - minimum), (bounds(tree["x"]),) if stays else ()
        change, state = optimizer.update(Estimate(0.0, {"x": gradient}, (Hessian(hessian), *at)), state, tree)
        tree = {"x": np.maximum(tree["x"] + change["x"], [0.0, -np.inf])}
    expected = [0.0, 1.0] if stays else [0.0, 1.5]
    np.testing.assert_allclose(tree["x"], expected, atol=1e-6)


def test_a_bound_is_left_where_the_loss_falls_inside() -> None:
    optimizer, tree = AveragedNewton(trust_radius=None), {"x": np.array([1.0, 0.0])}
    state, hessian = optimizer.init(tree), np.array([[1.0, 0.2], [0.2, 2.0]])
    for step in range(12):
        minimum = np.array([-1.0 if step < 3 else 0.5, 1.0])
        gradient = hessian @ (tree["x"] - minimum)
        parts = Hessian(hessian), GradientNoise(1e-8 * np.eye(2)), bounds(tree["x"])
        steps, state = optimizer.update(Estimate(0.0, {"x": gradient}, parts), state, tree)
        tree = {"x": np.maximum(tree["x"] + steps["x"], [0.0, -np.inf])}
    np.testing.assert_allclose(tree["x"], [0.5, 1.0], atol=0.05)


def test_the_curvature_of_another_scene_is_forgotten() -> None:
    """The edge of a lamp in the picture has ten thousand times the curvature: its models held the lamp beside the picture."""
    optimizer, tree = AveragedNewton(), {"x": np.zeros(3)}
    state, minimum = optimizer.init(tree), np.full(3, 1.0)
    for step in range(12):
        curvature, end = (1e4, 0.1 * minimum) if 1 <= step < 4 else (1.0, minimum)
        gradient = curvature * HESSIAN @ (tree["x"] - end)
        steps, state = optimizer.update(
            Estimate(0.0, {"x": gradient}, (Hessian(curvature * HESSIAN), HessianNoise(0.1 * curvature * HESSIAN))),
            state,
            tree,
        )
        tree = {"x": tree["x"] + steps["x"]}
    np.testing.assert_allclose(tree["x"], minimum, atol=0.1)


def test_noise_damps_the_directions_that_it_dominates() -> None:
    """Curvatures 1 and 0.01, noise of variance 4 and Δ = 2 of both: the first step is g / (a + s / (a Δ²))."""
    hessian, optimizer, x = np.diag([1.0, 0.01]), AveragedNewton(), np.zeros(2)
    hessian[0, 1] = hessian[1, 0] = 1e-9  # one block
    noise = GradientNoise(np.diag([0.04, 0.04]))
    steps, _ = optimizer.update(
        Estimate(0.0, {"x": np.array([-0.5, -0.5])}, (Hessian(hessian), noise)), optimizer.init({"x": x}), {"x": x}
    )
    np.testing.assert_allclose(steps["x"], [0.5 / 1.01, 0.5 / 1.01], rtol=1e-6)


def test_directions_of_noise_alone_hardly_move_until_enough_steps_tell_more() -> None:
    """Step 1: (H + N)⁻¹ of the gradient; after k models at one place, (H + σ N)⁻¹, with the sum σ of their squared weights."""
    optimizer, noise, x = AveragedNewton(trust_radius=None), 4.0 * HESSIAN, np.zeros(3)
    state, share = optimizer.init({"x": x}), 0.0
    for step in range(8):
        weight = 3.0 / (step + 3.0)
        share = (1.0 - weight) ** 2 * share + weight**2
        steps, state = optimizer.update(
            model(HESSIAN, 0.1 * MINIMUM, x, noise=0.0, of=HessianNoise(noise)), state, {"x": x}
        )
        np.testing.assert_allclose(steps["x"], 0.1 * MINIMUM / (1.0 + 4.0 * share), rtol=0.1)


def test_models_from_far_away_are_forgotten_and_those_that_are_not_finite_left_out() -> None:
    optimizer = AveragedNewton(trust_radius=None)
    x, state = np.zeros(3), optimizer.init({"x": np.zeros(3)})
    for _ in range(20):
        _, state = optimizer.update(model(HESSIAN, x, x), state, {"x": x})
    away = np.array([50.0, 50.0, 50.0])
    _, state = optimizer.update(model(HESSIAN, 1e4 * away, x), state, {"x": x})  # a long step
    steps, after = optimizer.update(model(HESSIAN, away + MINIMUM, away), state, {"x": away})
    np.testing.assert_allclose(steps["x"], MINIMUM, rtol=1e-2)
    broken, same = optimizer.update(model(HESSIAN, away, away, np.nan), after, {"x": away})
    assert not broken["x"].any()
    assert same is after


@pytest.mark.parametrize(("shrink", "averages"), [(None, True), (1.0, False)])
def test_averaging_begins_where_noise_alone_moves_the_minimum_by_more_than_the_region(
    monkeypatch: pytest.MonkeyPatch, shrink: float | None, averages: bool
) -> None:
    """Noise of the gradient moves the minimum of one model by 3 units. A region that does not shrink never averages."""
    if shrink is not None:
        monkeypatch.setattr(averaged_newton, "_SHRINK", shrink)
    most, wander = [], []
    for seed in range(6):
        optimizer, rng, tree = AveragedNewton(), np.random.default_rng(seed), {"x": np.zeros(3)}
        state, counts, places = optimizer.init(tree), [], []
        for _ in range(60):
            noise = np.linalg.cholesky(HESSIAN) @ rng.normal(size=3) * 3.0
            steps, state = optimizer.update(model(HESSIAN, MINIMUM, tree["x"], noise), state, tree)
            tree = {"x": tree["x"] + steps["x"]}
            counts.append(state.counts.min())
            places.append(tree["x"] - MINIMUM)
        most.append(max(counts[30:]))
        wander.append(np.sqrt(np.mean(np.square(places[30:]))))
    assert bool(np.median(most) > 12.0) is averages
    assert bool(np.mean(wander) < 1.2) is averages


def test_a_region_that_shrank_grows_again_while_the_loss_falls() -> None:
    optimizer, x = AveragedNewton(trust_radius=2.0), {"x": np.array([40.0, 0.0, 0.0])}
    state = replace(optimizer.init(x), radii=np.full(3, 0.1))
    for _ in range(12):
        steps, state = optimizer.update(model(HESSIAN, np.zeros(3), x["x"]), state, x)
        x = {"x": x["x"] + steps["x"]}
    assert state.radii[0] == 2.0


def test_few_noisy_pixels_do_not_outweigh_the_others() -> None:
    """Noise of √c times the usual halves the weight; a noisier half of the gradient has less scatter than with equal weights."""
    variance = np.array([[0.0, 1.0, 1.0, 1.0, 3.0, 300.0]])[..., None]
    np.testing.assert_allclose(
        derivative_images.noise_weights(variance, 3.0)[0, :, 0], [1.0, 0.75, 0.75, 0.75, 0.5, 1 / 101], rtol=1e-12
    )
    assert (derivative_images.noise_weights(np.zeros((1, 2, 1)), 3.0) == 1.0).all()
    lamp = np.ones(MATRIX.shape)
    lamp[:6] = 40.0
    made = problem_of(lamp * MATRIX)
    scatter = {}
    for limit in (None, 3.0):
        estimator, state = ur.GaussNewton(2, 2, noise_limit=limit), module.GaussNewtonState({"a": 0.02, "b": 0.03})
        found = []
        for seed in range(80):
            estimate, state = estimator.estimate(made, START, state, Key(seed))
            matrix = np.asarray(estimate.require("test", Hessian).matrix)
            gradient = np.concatenate([estimate.gradient[key] for key in START])
            found.append(np.linalg.solve(matrix, gradient))
        away = np.concatenate([START[key] - TRUTH[key] for key in START])
        scatter[limit] = float(np.median(np.abs(np.stack(found[8:]) - away)))
    assert scatter[3.0] < 0.8 * scatter[None]


@pytest.mark.slow
def test_noisy_channels_do_not_outweigh_the_others_of_their_pixels(monkeypatch: pytest.MonkeyPatch) -> None:
    """One channel has ten times the noise of the others: weights of whole pixels cannot tell them apart."""
    states = system.Point._states

    def noisy(point: Any, points: np.ndarray, view: int, key: Key, spp: int) -> np.ndarray:
        images = states(point, points, view, key, spp)
        noise = np.random.default_rng(key.uint32()).normal(size=images.shape[1:]) * np.array([1.0, 0.1, 0.1])
        return images + noise if len(points) == 1 else images

    monkeypatch.setattr(system.Point, "_states", noisy)
    made, scatter = problem_of(np.abs(MATRIX)), {}
    for by_channel in (False, True):
        estimator = ur.GaussNewton(2, 2, noise_limit=0.3, by_channel=by_channel)
        state, found = module.GaussNewtonState({"a": 0.02, "b": 0.03}), []
        for seed in range(80):
            estimate, state = estimator.estimate(made, TRUTH, state, Key(seed))
            matrix = np.asarray(estimate.require("test", Hessian).matrix)
            found.append(np.linalg.solve(matrix, np.concatenate([estimate.gradient[key] for key in TRUTH])))
        scatter[by_channel] = float(np.median(np.abs(np.stack(found[8:]))))
    assert scatter[True] < 0.7 * scatter[False]


def test_new_derivative_images_are_worth_their_time() -> None:
    """The variance (1 + ν / K) / N of each rule at equal time, over the best fixed K; ten times as many or as few are planted."""
    noise, image, derivative, time = 4.0, 1.0, 6.0, 3000.0

    def variance(factor: float) -> float:
        images = derivatives = 1.0
        while images * image + derivatives * derivative < time:
            needs = derivative_images.needs_derivatives(
                factor * noise / derivatives, images, derivatives, int(image), int(derivative)
            )
            images, derivatives = images + 1.0, derivatives + float(needs)
        return (1.0 + noise / derivatives) / images

    counts = np.arange(1.0, time / derivative)
    best = ((1.0 + noise / counts) / ((time - counts * derivative) / image)).min()
    assert variance(1.0) < 1.02 * best
    assert variance(100.0) > 1.1 * best
    assert variance(0.01) > 1.1 * best


def test_without_curvature_new_derivative_images_are_always_worth_it() -> None:
    """At a caustic that few paths find, the first derivative images are 0. They are no derivatives without noise."""
    singular = np.array([[1.0, 1.0], [1.0, 1.0 - 1e-9]])
    for hessian in (np.zeros((2, 2)), np.diag([1.0, -0.1]), singular):
        assert module._relative_noise(hessian, np.zeros((2, 2))) == np.inf
    assert module._relative_noise(np.diag([2.0, 4.0]), np.diag([0.2, 0.4])) == pytest.approx(0.1)


def test_settled_steps_use_earlier_derivative_images_and_long_ones_new_ones() -> None:
    made, estimator = problem(), ur.GaussNewton(2, 2, remember=True)
    state, paths = module.GaussNewtonState({"a": 0.02, "b": 0.03}), []
    points = [TRUTH] * 40 + [{**TRUTH, "b": TRUTH["b"] + 0.05}]
    for seed, point in enumerate(points):
        estimate, state = estimator.estimate(made, point, state, Key(seed))
        paths.append(estimate.info["samples"])
    image = made.pixels * estimator.spp
    assert set(paths) == {image, (1 + 2 * 3) * image}
    assert paths[0] == paths[-1] == max(paths)
    assert paths[:40].count(image) > 20


def test_gradient_noise_is_the_scatter_of_gradients() -> None:
    """Mean of the estimates over the variance of 300 gradients, within 4.5 standard errors of a variance. Half of it is seen."""
    made, estimator = problem(), ur.GaussNewton(2, 2)
    state = module.GaussNewtonState({"a": 0.02, "b": 0.03})
    found = [estimator.estimate(made, START, state, Key(seed))[0] for seed in range(300)]
    gradients = np.stack([np.concatenate([one.gradient[key] for key in START]) for one in found])
    told = np.mean([np.diag(one.require("test", GradientNoise).matrix) for one in found], axis=0)
    ratio, error = told / gradients.var(axis=0, ddof=1), np.sqrt(2.0 / 300)
    assert (np.abs(ratio - 1.0) < 4.5 * error).all()
    assert (np.abs(0.5 * ratio - 1.0) > 4.5 * error).all()


@pytest.mark.parametrize("loss", quick([ur.losses.L1(), ur.losses.Huber(0.05)], ur.losses.L1()), ids=["L1", "Huber"])
def test_means_of_models_of_other_losses_average_noise(loss: Any) -> None:
    """The gradient's noise is known to a factor of two; by that of derivative images alone it would be a thirtieth. Without it, models
    would be forgotten as those of another scene."""
    made, estimator = problem(loss), ur.GaussNewton(16, 16)
    _, state = estimator.estimate(made, START, module.GaussNewtonState({"a": 0.02, "b": 0.03}), Key(1000))
    found = [estimator.estimate(made, START, state, Key(seed))[0] for seed in range(100)]
    gradients = np.stack([np.concatenate([one.gradient[key] for key in START]) for one in found])
    told = np.mean([np.diag(one.require("test", GradientNoise).matrix) for one in found], axis=0)
    ratio = told / gradients.var(axis=0, ddof=1)
    assert (ratio > 0.3).all()
    assert (ratio < 1.5).all()
    result = ur.optimize(made, estimator, AveragedNewton(), steps=60)
    errors = {key: result.parameters[key] - TRUTH[key] for key in TRUTH}
    assert max(np.abs(error).max() for error in errors.values()) < 0.01
    assert all((np.abs(error) < 5.0 * result.standard_error[key]).all() for key, error in errors.items())


def test_skewed_noise_does_not_bias_other_losses(monkeypatch: pytest.MonkeyPatch) -> None:
    """Exponential noise of the image: the mean gradient at the truth, of positive derivatives, is 0 within 4.5 standard errors."""
    states = system.Point._states

    def bright(point: Any, points: np.ndarray, view: int, key: Key, spp: int) -> np.ndarray:
        images = states(point, points, view, key, spp)
        noise = np.random.default_rng(key.uint32()).exponential(0.5, images.shape[1:]) - 0.5
        return images + noise if len(points) == 1 else images

    monkeypatch.setattr(system.Point, "_states", bright)
    renderer = AnalyticRenderer(TRUTH, np.abs(MATRIX), 0.1, 0.0, shape=(4, 5))
    unknown = [ur.Parameter(key, initial=value) for key, value in TRUTH.items()]
    made = ur.Problem(renderer, unknown, [ur.View(renderer.exact(TRUTH))], ur.losses.L1(), truth=TRUTH)
    estimator, state, found = ur.GaussNewton(2, 2), module.GaussNewtonState({"a": 0.02, "b": 0.03}), []
    for seed in range(220):
        estimate, state = estimator.estimate(made, TRUTH, state, Key(seed))
        found.append(np.concatenate([estimate.gradient[key] for key in TRUTH]))
    gradients = np.stack(found[20:])
    assert (np.abs(gradients.mean(axis=0)) < 4.5 * gradients.std(axis=0, ddof=1) / np.sqrt(len(gradients))).all()


@pytest.mark.parametrize("remember", quick([True, False], True))
def test_derivatives_of_many_steps_leave_the_gradient_less_noise(remember: bool) -> None:
    """An element that hardly changes the picture, with ten times as much noise in its differences."""
    renderer = AnalyticRenderer(TRUTH, MATRIX * np.array([1.0, 1.0, 0.01]), 0.1, 0.0, grain=0.3, shape=(4, 5))
    truth_of = [ur.Parameter(key, initial=value) for key, value in TRUTH.items()]
    made = ur.Problem(renderer, truth_of, [ur.View(renderer.exact(TRUTH))], ur.losses.L2())
    estimator, rng = ur.GaussNewton(2, 2, remember=remember), np.random.default_rng(0)

    def noisy(images: np.ndarray, distances: np.ndarray) -> np.ndarray:
        return differences(images, distances) + rng.normal(0.0, 0.1, (len(distances), *images.shape[1:]))

    differences, states = system.differences, []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(system, "differences", noisy)
        patch.setattr(module, "needs_derivatives", lambda *_: True)
        state = module.GaussNewtonState({"a": 0.02, "b": 0.03})
        for seed in range(200):
            estimate, state = estimator.estimate(made, TRUTH, state, Key(seed))
            states.append(float(estimate.gradient["b"][0]))
    assert bool(np.std(states[40:]) < 0.4 * np.std(states[:8])) is remember


def test_widths_stay_within_the_bounds() -> None:
    """An element that hardly changes the picture has no wider differences than an eighth of its range."""
    renderer = AnalyticRenderer(TRUTH, MATRIX * np.array([1.0, 1.0, 1e-4]), 0.1, 0.1, shape=(4, 5))
    unknown = [ur.Parameter("a"), ur.Parameter("b", bounds=(0.0, 1.0))]
    made = ur.Problem(renderer, unknown, [ur.View(renderer.exact(TRUTH))], ur.losses.L2())
    _, state = ur.GaussNewton(2, 2).estimate(made, TRUTH, module.GaussNewtonState({}), Key(0))
    assert state.widths["b"] == pytest.approx(0.125)


@pytest.mark.parametrize("earlier", quick([True, False], True))
def test_weights_leave_skewed_noise_without_bias(earlier: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """At the truth, with rare bright pixels. The planted fault is weights by the image whose residuals they weight."""
    states = system.Point._states

    def outliers(point: Any, points: np.ndarray, view: int, key: Key, spp: int) -> np.ndarray:
        images = states(point, points, view, key, spp)
        generator = np.random.default_rng(key.uint32())
        rare = generator.exponential(1.0, images.shape[1:]) * (generator.random(images.shape[1:]) < 0.2)
        return images + (rare - 0.2) if len(points) == 1 else images

    monkeypatch.setattr(system.Point, "_states", outliers)
    made, estimator = problem_of(np.abs(MATRIX)), ur.GaussNewton(2, 2, noise_limit=0.5)
    state = module.GaussNewtonState({"a": 0.02, "b": 0.03})
    found = []
    for seed in range(300):
        key = Key(seed)
        if not earlier:
            _, state = estimator.estimate(made, TRUTH, replace(state, variances=()), key)
        estimate, state = estimator.estimate(made, TRUTH, state, key)
        found.append(np.concatenate([estimate.gradient[name] for name in TRUTH]))
    assert (off(np.stack(found), np.zeros(3)) < 4.0) is earlier


@pytest.mark.mitsuba  # which a run folder asks for its version
def test_both_find_the_minimum_of_a_noisy_problem_and_go_on_where_they_were(tmp_path: Any) -> None:
    made = problem()
    parts = ur.GaussNewton(64, 16), AveragedNewton()
    whole = ur.optimize(made, *parts, steps=16, seed=1)
    start = sum(made.parameter_error(made.initial()).values())
    assert sum(made.parameter_error(whole.parameters).values()) < 0.05 * start
    ur.optimize(made, *parts, steps=6, seed=1, run_directory=tmp_path / "run")
    again = ur.resume(tmp_path / "run", made, steps=16)
    for key, value in whole.parameters.items():
        np.testing.assert_array_equal(again.parameters[key], value)


class Kinked(AnalyticRenderer):
    """Some pixels are proportional to x, others to its excess over 0.1, as a face that a sun reaches from some angle on."""

    def _flat(self, parameters: Any) -> np.ndarray:
        x = super()._flat(parameters)
        return np.concatenate([x, np.maximum(x - 0.1, 0.0)])


@pytest.mark.parametrize("tested", [True, False])
def test_differences_that_do_not_predict_the_change_of_images_become_narrower(
    tested: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Wide differences at 0.09 are of the pixels beyond the kink, whose change is 0 there. Steps by them hardly move."""
    if not tested:
        monkeypatch.setattr(module, "_MOST_WRONG", np.inf)
    renderer = Kinked({"x": np.zeros(1)}, np.ones((4 * 5 * 3, 1)), 0.0, noise=0.0, grain=0.02, shape=(4, 5))
    pattern = np.random.default_rng(1).uniform(-1.0, 1.0, (20, 1)).repeat(3, axis=0)
    renderer.offset = 5.0 * pattern[:, 0]
    renderer.matrix = pattern * np.where(np.arange(60)[:, None] < 30, [1.0, 0.0], [0.0, 20.0])
    unknown = [ur.Parameter("x", initial=np.array([0.09]))]
    made = ur.Problem(renderer, unknown, [ur.View(renderer.exact({"x": np.zeros(1)}))], truth={"x": np.zeros(1)})
    ends = []
    for seed in range(4):
        estimator = ur.GaussNewton(64, 8, remember=True, largest={"x": 0.1})
        result = ur.optimize(made, estimator, AveragedNewton(), steps=20, seed=seed, progress=False)
        ends.append(abs(float(result.parameters["x"][0])))
    assert (max(ends) < 0.02) is tested
    assert (min(ends) > 0.05) is not tested


def test_the_prediction_of_derivative_images_has_no_bias_by_noise() -> None:
    """Means over 300 draws within 4 standard errors, and the variance within its own. The square of one half has a bias."""
    rng, step = np.random.default_rng(0), np.array([0.3, -0.2])
    derivatives, weights = rng.normal(size=(2, 4, 5, 3)), np.full((4, 5, 3), 0.7)
    predicted, found, biased = np.tensordot(step, derivatives, axes=1), [], []
    for _ in range(300):
        before, now, of = (
            derivative_images.HalvesMean(*(x + rng.normal(scale=noise, size=(2, *x.shape))))
            for x, noise in ((0.0 * predicted, 1.0), (predicted, 1.0), (derivatives, 0.5))
        )
        found.append(derivative_images.secant_products(before, now, of, step, weights))
        biased.append(0.7 * np.square(np.tensordot(step, of.one, axes=1)).sum())
    sums, square = np.array(found), 0.7 * float(np.square(predicted).sum())
    errors = sums.std(axis=0) / np.sqrt(300)
    assert (np.abs(sums[:, :2].mean(axis=0) - square) < 4.0 * errors[:2]).all()
    assert float(np.mean(biased)) - square > 4.0 * errors[1]
    assert sums[:, 2].mean() == pytest.approx((sums[:, 0] - sums[:, 1]).var(), rel=4.0 * np.sqrt(2.0 / 300))


def test_a_gradient_of_far_more_noise_is_left_out_once() -> None:
    """A path that finds the sun by chance moved the mean, and hid for many steps that the mean was outdated."""
    optimizer, x = AveragedNewton(), {"x": np.zeros(3)}
    state = optimizer.init(x)
    for gradient, noise, left_out in ((1.0, 1.0, False), (1.1, 1.0, False), (90.0, 1e4, True), (95.0, 1e4, False)):
        parts = Hessian(HESSIAN), GradientNoise(1e-4 * noise * HESSIAN)
        before = state
        steps, state = optimizer.update(Estimate(0.0, {"x": gradient * np.ones(3)}, parts), state, x)
        assert np.array_equal(state.target, before.target) is left_out
        assert bool(steps["x"].any()) is not left_out


@pytest.mark.parametrize("out", [True, False])
def test_after_it_the_models_still_tell_that_their_mean_is_outdated(out: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    if not out:
        monkeypatch.setattr(averaged_newton, "_OUTLIER", np.inf)
    optimizer, x = AveragedNewton(), {"x": np.zeros(3)}
    state = optimizer.init(x)
    for step in range(12):
        minimum, noise = (0.0 if step < 11 else 0.1) * np.ones(3), 1e4 if step == 5 else 1.0
        parts = Hessian(HESSIAN), GradientNoise(1e-5 * noise * HESSIAN)
        _, state = optimizer.update(Estimate(0.0, {"x": -HESSIAN @ minimum}, parts), state, x)
    assert bool(state.counts.max() < 2.0) is out
