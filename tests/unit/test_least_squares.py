"""Least squares at the end of a run, against closed forms: standard errors, steps, and what the references leave open."""

from __future__ import annotations

import dataclasses
import re
import zlib
from typing import Any

import numpy as np
import pytest

import unrender as ur
from tests.analytic import AnalyticRenderer
from unrender.core import timing
from unrender.core.random import Key
from unrender.estimators.base import pixel_weights
from unrender.estimators.gauss_newton import GaussNewtonState
from unrender.estimators.hybrid import HybridState
from unrender.rendering.renderer import SampleRequest
from unrender.runs import field_directions, least_squares
from unrender.runs.least_squares import NumbersCheck, _checked, _Fit, check_numbers
from unrender.runs.numbers import Differences, Numbers
from unrender.runs.reference_distortions import distortions

SHAPE = (8, 8)
ROWS = SHAPE[0] * SHAPE[1] * 3
NOISE = 0.02
NUMBERS = np.random.default_rng(3)
MATRIX = NUMBERS.normal(0.0, 1.0, (ROWS, 4))
TRUTH = {"a": np.array([0.6, 0.3, 0.4]), "b": np.array(0.5)}
FAR = np.inf


def problem(matrix: np.ndarray, reference_noise: float = NOISE, noise: float = 0.05, seed: int = 5) -> ur.Problem:
    """Return three numbers and one, whose picture is linear in them, with a noisy reference."""
    renderer = AnalyticRenderer(TRUTH, matrix, offset=2.0, noise=noise, shape=SHAPE)
    added = np.random.default_rng(seed).normal(0.0, reference_noise, (*SHAPE, 3))
    view = ur.View((renderer.exact(TRUTH) + added).astype(np.float32))
    parameters = [ur.Parameter(key, initial=0.5 * value) for key, value in TRUTH.items()]
    return ur.Problem(renderer, parameters, [view])


def best(made: ur.Problem, matrix: np.ndarray) -> np.ndarray:
    """Return the least-squares solution (4,)."""
    target = np.asarray(made.views[0].reference, np.float64).reshape(-1) - 2.0
    return np.linalg.lstsq(matrix, target, rcond=None)[0]


def at(flat: np.ndarray) -> dict[str, np.ndarray]:
    return {"a": flat[:3].astype(np.float32), "b": np.asarray(flat[3], np.float32)}


@pytest.mark.parametrize("shown", [0.0, -1.0])
def test_directions_of_numbers_that_no_picture_shows_are_finite(shown: float):
    """A ball that turns on sixteen pixels gave NaN, and no line; products of independent noise may be negative."""
    one = np.full((2, 64, 3), 0.1)
    limits = np.array([1.0, 0.5])
    columns, _ = field_directions.independent(Differences(np.eye(2), one, shown * one), limits, 0.1)
    assert np.isfinite(columns).all()
    assert (np.abs(columns) <= 1.001 * limits[:, None]).all()


def test_standard_errors_and_steps_are_those_of_the_closed_form():
    made = problem(MATRIX)
    solution, away = best(made, MATRIX), np.array([0.05, -0.02, 0.0, 0.03])
    found = check_numbers(made, at(solution + away), made.initial_values(), FAR)
    residual = np.asarray(made.views[0].reference).reshape(-1) - 2.0 - MATRIX @ solution
    inverse = np.linalg.inv(MATRIX.T @ MATRIX)
    scores = (MATRIX * residual[:, None]).reshape(-1, 3, 4).sum(axis=1)  # channels of a pixel may share their noise
    expected = np.sqrt(np.diag(inverse @ scores.T @ scores @ inverse))
    np.testing.assert_allclose(np.concatenate([found.errors["a"], found.errors["b"]]), expected, rtol=0.1)
    step = np.concatenate([found.steps["a"], found.steps["b"]])
    np.testing.assert_allclose(step, -away, atol=0.1 * expected.max())


def scores_of_early_ends(steps: bool) -> np.ndarray:
    """Return z of the numbers of twelve references, at some distance from the least-squares solutions."""
    found = []
    for seed in range(12):
        made = problem(MATRIX, seed=seed)
        values = at(best(made, MATRIX) + np.random.default_rng(100 + seed).normal(0.0, 0.004, 4))
        errors = ur.runs.uncertainty(made, values).standard_error
        if not steps:
            errors = check_numbers(made, values, made.initial_values(), FAR).errors
        found += [np.ravel((values[key] - truth) / errors[key]) for key, truth in TRUTH.items()]
    return np.concatenate(found)


def test_stated_errors_contain_the_distance_from_the_solution():
    assert scores_of_early_ends(steps=True).std() == pytest.approx(1.0, abs=0.25)
    assert scores_of_early_ends(steps=False).std() > 2.0  # planted: the references' noise alone


@pytest.mark.parametrize("values", [{"a": np.zeros(3)}, {"a": np.zeros(2), "b": np.zeros(())}])
def test_values_of_other_keys_or_shapes_are_one_line(values: dict[str, np.ndarray]):
    with pytest.raises(ur.InputError) as caught:
        ur.runs.uncertainty(problem(MATRIX), values)
    assert "\n" not in str(caught.value)


def test_the_noise_of_the_check_is_no_distance_and_no_number_is_known_better_than_it():
    errors, steps, noise = ({"a": np.array(x)} for x in ([3.0, 3.0, np.inf], [5.0, 0.5, 1.0], [4.0, 4.0, 1.0]))
    check = NumbersCheck(errors=errors, steps=steps, noise=noise)
    values = {"a": np.zeros((3, 1))}
    np.testing.assert_allclose(check.standard_errors(values)["a"][:, 0], [5.0, 4.0, np.inf])
    own = check.standard_errors(values, {"a": np.full((3, 1), 3.5)})["a"][:, 0]  # the run knows its noise
    np.testing.assert_allclose(own, [np.sqrt(18.0), 3.5, np.inf])
    curved = dataclasses.replace(
        check, errors={"a": np.array([3.1, 2.9])}, steps={"a": np.zeros(2)}, noise={"a": np.zeros(2)}
    )
    own = curved.standard_errors({"a": np.zeros(2)}, {"a": np.ones(2)}, complete=True)["a"]
    np.testing.assert_allclose(own, [3.1, 1.0], rtol=1e-6)  # a run with a third of the check's error understates it
    damped = curved.standard_errors({"a": np.zeros(2)}, {"a": np.array([1.0, np.inf])}, complete=True)["a"]
    np.testing.assert_allclose(damped, [3.1, 2.9], rtol=1e-6)  # a camera's place, known to .01, was "not determined"


def test_errors_of_a_run_that_has_converged_are_no_larger_with_a_check() -> None:
    """The run and the check estimate one error, each with a scatter, and the step is noise."""
    random, count = np.random.default_rng(1), 1 << 14
    own, check = (1.0 + 0.25 * random.normal(size=count) for _ in range(2))
    found = NumbersCheck(
        errors={"a": check}, steps={"a": 0.5 * random.normal(size=count)}, noise={"a": np.full(count, 0.5)}
    )
    values = {"a": np.zeros(count)}

    def size(complete: bool) -> float:
        return float(np.sqrt(np.mean(np.square(found.standard_errors(values, {"a": own}, complete)["a"]))))

    mean = float(np.sqrt(np.mean(np.square(own))))
    assert size(complete=True) == pytest.approx(mean, rel=0.02)
    assert size(complete=False) > 1.15 * mean
    far = dataclasses.replace(found, steps={"a": np.full(count, 3.0)})  # an error that the run does not know
    assert (far.standard_errors(values, {"a": own}, complete=True)["a"] > 2.5).all()


def test_noise_of_the_slopes_is_noise_of_the_step() -> None:
    """Times a residual that is noise of the reference, it moves the solution of the check."""
    made, random = problem(MATRIX), np.random.default_rng(2)
    numbers = Numbers.of(made, TRUTH, made.initial_values())
    assert numbers is not None
    slopes, scores = MATRIX.T.reshape(4, -1, 3), []
    for _ in range(64):
        noisy = [slopes + 0.2 * random.normal(size=slopes.shape) for _ in range(2)]
        residuals = np.stack([random.normal(0.0, 0.05, slopes.shape[1:])] * 2)
        fits = [_Fit.of(numbers, Differences(np.eye(4), *of), residuals) for of in (noisy, [slopes, slopes])]
        scores.append((fits[0].step - fits[1].step) / fits[0].own)
    assert float(np.std(scores)) == pytest.approx(1.0, abs=0.2)


@pytest.mark.parametrize("planted", [False, True])
def test_a_solution_with_weights_is_no_distance_from_the_fit(planted: bool):
    """Half of the pixels have ten times the noise, and little weight in the run's steps. The planted fault is a fit with equal weights,
    from whose solution the run's is far."""
    size = np.where(np.arange(64).reshape(*SHAPE, 1) % 2, 0.2, 0.02)
    weights, scores = 1.0 / (1.0 + np.square(size / 0.02)), []
    for seed in range(8):
        made = problem(MATRIX, reference_noise=0.0)
        reference = np.asarray(made.views[0].reference) + size * np.random.default_rng(seed).normal(size=(*SHAPE, 3))
        made = made.replaced(views=[ur.View(reference.astype(np.float32))])
        roots = np.sqrt(np.repeat(weights.reshape(-1), 3))
        target = np.asarray(made.views[0].reference, np.float64).reshape(-1) - 2.0
        solution = np.linalg.lstsq(MATRIX * roots[:, None], target * roots, rcond=None)[0]
        check = check_numbers(made, at(solution), made.initial_values(), FAR, weights=() if planted else (weights,))
        errors = check.standard_errors(at(solution), {key: np.zeros(np.shape(x)) for key, x in TRUTH.items()})
        scores += [np.ravel((at(solution)[key] - x) / errors[key]) for key, x in TRUTH.items()]
    spread = float(np.concatenate(scores).std())
    assert spread == pytest.approx(1.0, abs=0.35) if not planted else spread < 0.5


def test_the_uncertainty_of_a_result_is_that_of_the_fit_with_its_weights():
    """Half of the pixels have ten times the noise. A fit with equal weights has several times the error."""
    size = np.where(np.arange(64).reshape(*SHAPE, 1) % 2, 0.2, 0.02)
    made = problem(MATRIX, reference_noise=0.0, noise=0.01)
    reference = np.asarray(made.views[0].reference) + size * np.random.default_rng(0).normal(size=(*SHAPE, 3))
    made = made.replaced(views=[ur.View(reference.astype(np.float32))])
    values, weights = at(np.array([0.6, 0.3, 0.4, 0.5])), 1.0 / (1.0 + np.square(size / 0.02))
    result = ur.Result(values, made.initial_values(), [], 1.0, 0.0, "steps", pixel_weights=(weights,))
    own, equal = (ur.runs.uncertainty(made, of).standard_error for of in (result, values))
    assert all((own[key] < 0.5 * equal[key]).all() for key in TRUTH)


def test_only_runs_with_weights_by_noise_have_them_in_the_test():
    state = GaussNewtonState({}, variances=(np.array([[[1.0], [2.0], [9.0]]]),))
    (weights,) = pixel_weights(ur.GaussNewton(noise_limit=3.0), state)
    np.testing.assert_allclose(weights.ravel(), 1.0 / (1.0 + np.array([1.0, 2.0, 9.0]) / 6.0))
    assert pixel_weights(ur.GaussNewton(), state) == ()
    assert pixel_weights(ur.PathGradient(), None) == ()


def test_a_block_beside_path_gradients_has_its_weights_in_the_test():
    state = HybridState(None, GaussNewtonState({}, variances=(np.array([[[1.0], [2.0], [9.0]]]),)))
    (weights,) = pixel_weights(ur.HybridGradient(perturbed=ur.GaussNewton(noise_limit=3.0)), state)
    np.testing.assert_allclose(weights.ravel(), 1.0 / (1.0 + np.array([1.0, 2.0, 9.0]) / 6.0))
    assert pixel_weights(ur.HybridGradient(perturbed=ur.GaussNewton()), state) == ()
    assert pixel_weights(ur.HybridGradient(), HybridState(None, None)) == ()  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize("changed", [False, True])
def test_steps_after_path_gradients_have_weights_once_they_have_begun(changed: bool):
    made = ur.estimators.PathThenNewton(newton=ur.GaussNewton(noise_limit=3.0))
    state = made.init(problem(MATRIX), at(np.full(4, 0.5)))
    state = dataclasses.replace(state, changed=changed, newton=GaussNewtonState({}, variances=(np.ones((2, 3, 1)),)))
    assert [weights.shape for weights in pixel_weights(made, state)] == [(2, 3, 1)] * changed


def test_the_slope_of_the_references_has_the_weights_of_the_pictures():
    """Equal weights scale it as they scale the pictures; edges of the weights are no edges of the picture, and a masked half counts not."""
    picture = np.linspace(1.0, 2.0, SHAPE[1])[None, :, None] * np.ones((*SHAPE, 3))
    picture[4:] *= 1.0 + 3.0 * np.random.default_rng(0).random((4, SHAPE[1], 1))
    made = problem(MATRIX).replaced(views=[ur.View(picture.astype(np.float32))])
    plain = Numbers.of(made, at(np.ones(4)), made.initial_values())
    assert plain is not None
    weighted = dataclasses.replace(plain, weights=(np.full((*SHAPE, 1), 0.01),))
    assert weighted.slope() == pytest.approx(0.1 * plain.slope())
    half = np.where(np.arange(8)[:, None, None] < 4, 1.0, 0.0) * np.ones((*SHAPE, 1))
    upper = 0.5 * np.square(np.diff(picture[:4], axis=1)).sum() / picture.size
    assert dataclasses.replace(plain, weights=(half,)).slope() == pytest.approx(np.sqrt(upper), rel=1e-4)


def test_errors_beside_a_number_that_may_be_anywhere_are_lower_limits():
    """A lamp's position was said to be known to ± 0.14, 0.84 off, beside an intensity that nothing determined."""
    made = problem(MATRIX)
    numbers = Numbers.of(made, at(best(made, MATRIX)), made.initial_values())
    assert numbers is not None
    for last, words in ((0.06, "± 0.001, 0.2, 0.001 (with"), (5.0, "± 0.001, 0.2, 0.001 or more (with")):
        error = np.array([0.001, 0.2, 0.001, last])
        found = _checked(
            numbers, _Fit(np.diag(error**2), error, error, np.zeros(4), np.zeros((4, 0))), np.full(4, 0.01)
        )
        assert words in found.undetermined["a"]


def test_a_run_that_arrived_is_told_nothing():
    made = problem(MATRIX)
    found = check_numbers(made, at(best(made, MATRIX)), made.initial_values(), FAR)
    assert not found.undetermined
    assert not found.unfinished


def test_a_run_that_ended_early_is_told_its_step():
    made = problem(MATRIX)
    found = check_numbers(made, at(best(made, MATRIX) + np.array([0.1, 0, 0, 0])), made.initial_values(), FAR)
    assert list(found.unfinished) == ["a"]
    assert "a least-squares step from its end moves it by −0.09" in found.unfinished["a"]
    assert not found.undetermined


@pytest.mark.parametrize(("bound", "far"), [(0.4, False), (0.4, True), (0.6, False)])
def test_a_solution_beyond_a_bound_is_told(bound: float, far: bool):
    """The other numbers make up for a bound that excludes the true value. A step from far away may be too long."""
    made = problem(MATRIX)
    parameters = [u.parameter for u in made.unknowns.values()]
    parameters[1] = ur.Parameter("b", 0.25, bounds=(0.0, bound))
    made = ur.Problem(made.renderer, parameters, made.views)
    end = best(made, MATRIX)
    end[3] = 0.1 if far else min(end[3], bound)
    target = np.asarray(made.views[0].reference, np.float64).reshape(-1) - 2.0 - end[3] * MATRIX[:, 3]
    end[:3] = np.linalg.lstsq(MATRIX[:, :3], target, rcond=None)[0]
    found = check_numbers(made, at(end), made.initial_values(), FAR)
    told = ["b: the least-squares solution is beyond its bound by 0."] if bound < 0.5 else []
    if far:
        assert found.unfinished["b"].startswith(
            "b: the run ended before it settled: a least-squares step from its end moves it by 0.3,"
        )
        assert not any(" bound" in line for line in found.unfinished.values())
    else:
        assert [line[: len(told[0])] for line in found.unfinished.values()] == told
    assert np.isinf(found.errors["b"]) == (bound < 0.5)


def test_steps_are_not_told_of_losses_with_another_minimum():
    made = problem(MATRIX)
    made = ur.Problem(made.renderer, [u.parameter for u in made.unknowns.values()], made.views, loss=ur.losses.L1())
    away = at(best(made, MATRIX) + np.array([0.1, 0, 0, 0]))
    assert not check_numbers(made, away, made.initial_values(), FAR).unfinished


@pytest.mark.parametrize("share", [0.0, 1e-3])
def test_numbers_that_the_references_know_together_only_are_named(share: float):
    """A direction without change, and one whose change is far below the references' noise."""
    matrix = MATRIX.copy()
    matrix[:, 3] = matrix[:, 0] + share * matrix[:, 3]
    made = problem(matrix)
    values = at(np.array([0.3, 0.3, 0.4, 0.8]))
    found = check_numbers(made, values, made.initial_values(), FAR)
    assert set(found.undetermined) == {"a", "b"}
    assert "together with b" in found.undetermined["a"]
    assert "together with a" in found.undetermined["b"]
    assert found.errors["b"] > 1.0


def test_a_number_without_influence_is_open_and_the_others_are_not():
    matrix = MATRIX.copy()
    matrix[:, 3] = 0.0
    made = problem(matrix)
    found = check_numbers(made, at(np.append(best(made, MATRIX)[:3], 0.5)), made.initial_values(), FAR)
    assert list(found.undetermined) == ["b"]


@pytest.mark.parametrize("share", [0.0125, 0.0])
def test_a_number_that_moves_a_little_with_an_open_one_has_a_standard_error_of_that(share: float):
    """Along a hidden direction b changes by .25, half its size, and the first of a by .0125, 2 % of its own.

    Since b is open, it may be anywhere in its range of .5, and a moves along.
    """
    made = problem(MATRIX)
    numbers = Numbers.of(made, TRUTH, made.initial_values())
    assert numbers is not None
    error, unseen = np.full(4, 0.001), np.array([[share], [0.0], [0.0], [0.25]])
    found = _checked(numbers, _Fit(np.diag(error**2), error, error, np.zeros(4), unseen), np.full(4, 0.01))
    assert list(found.undetermined) == ["b"]
    np.testing.assert_allclose(found.errors["a"], [max(2.0 * share, 0.001), 0.001, 0.001], rtol=2e-4)
    assert np.isinf(found.errors["b"]).all()


@pytest.mark.parametrize("share", [0.05, 0.0])
def test_a_number_that_trades_off_against_an_open_one_is_open_with_it(share: float):
    """The first of a changes by .05, 8 % of its size, while b changes by .25. Over the range of b it changes by 17 %."""
    made = problem(MATRIX)
    numbers = Numbers.of(made, TRUTH, made.initial_values())
    assert numbers is not None
    error, unseen = np.full(4, 0.001), np.array([[share], [0.0], [0.0], [0.25]])
    found = _checked(numbers, _Fit(np.diag(error**2), error, error, np.zeros(4), unseen), np.full(4, 0.01))
    assert ("a" in found.undetermined) is (share > 0.0)
    assert share == 0.0 or "together with b" in found.undetermined["a"]


@pytest.mark.parametrize("entry", [0.0, np.nan])
def test_numbers_that_no_picture_shows_are_named_and_pictures_that_are_not_finite_have_no_check(entry: float):
    made = problem(np.full_like(MATRIX, 0.0))
    made.renderer.matrix = np.full_like(MATRIX, entry)  # type: ignore
    found = check_numbers(made, made.initial_values(), made.initial_values(), FAR)
    assert not found.unfinished
    assert set(found.undetermined) == (set() if np.isnan(entry) else {"a", "b"})
    assert all(np.isinf(error).all() for error in found.standard_errors(made.initial_values()).values())


def test_fewer_values_than_numbers_leave_all_open():
    renderer = AnalyticRenderer(TRUTH, MATRIX[:3], 2.0, 0.0, shape=(1, 1))
    view = ur.View(renderer.exact(TRUTH).astype(np.float32))
    made = ur.Problem(renderer, [ur.Parameter(key, initial=0.5 * value) for key, value in TRUTH.items()], [view])
    found = check_numbers(made, TRUTH, made.initial_values(), FAR)
    assert set(found.undetermined) == {"a", "b"}
    assert "a least-squares test at the end does not determine it" in found.undetermined["a"]


@pytest.mark.parametrize("alike", [False, True])
def test_as_many_values_as_numbers_are_determined_without_errors(alike: bool):
    """A meter of one pixel said that it does not determine the three values of a light, since no residual tells its noise. Where it cannot,
    as where its channels are alike, errors were 0 times infinity."""
    truth = {"a": np.array([0.3, -0.2, 0.5])}
    matrix = np.tile(MATRIX[:1, :3], (3, 1)) if alike else MATRIX[:3, :3]
    renderer = AnalyticRenderer(truth, matrix, 2.0, 0.0 if alike else 0.001, shape=(1, 1))
    view = ur.View(renderer.exact(truth).astype(np.float32))
    made = ur.Problem(renderer, [ur.Parameter("a", initial=0.5 * truth["a"])], [view])
    found = check_numbers(made, truth, made.initial_values(), FAR)
    assert alike or not found.undetermined
    assert not found.errors
    assert "as few values as these numbers, of which others may give the same pictures" in found.missing()[0]


def test_numbers_of_any_scale():
    """Pictures that are 1e4 times as bright or dark, and parameters in other units."""
    for brightness, units in ((1e4, 1.0), (1e-4, 1.0), (1.0, 1e-4), (1.0, 1e4)):
        matrix = MATRIX * brightness / units
        renderer = AnalyticRenderer(
            {k: units * x for k, x in TRUTH.items()}, matrix, 2.0 * brightness, 0.05, shape=SHAPE
        )
        target = renderer.exact({k: units * x for k, x in TRUTH.items()})
        target += np.random.default_rng(5).normal(0.0, NOISE * brightness, target.shape)
        parameters = [ur.Parameter(key, initial=0.5 * units * value) for key, value in TRUTH.items()]
        made = ur.Problem(renderer, parameters, [ur.View(target.astype(np.float32))])
        away = {k: (units * (x + 0.1)).astype(np.float32) for k, x in TRUTH.items()}
        found = check_numbers(made, away, made.initial_values(), FAR)
        np.testing.assert_allclose(found.steps["a"] / units, -0.1, atol=0.02)
        assert not found.undetermined


@pytest.mark.parametrize("weighted", [True, False])
def test_rare_bright_samples_at_the_ends_of_differences_leave_no_number_open(
    monkeypatch: pytest.MonkeyPatch, weighted: bool
):
    made, pictures = problem(MATRIX), Numbers.pictures

    def with_bright_samples(self: Numbers, points: np.ndarray, key: Key) -> np.ndarray:
        images = pictures(self, points, key)
        if key.uint32() % 4 == 0:
            images[:, 5] += 1e4 * np.maximum(points[:, 3:4] - self.point[3], 0.0)
        return images

    monkeypatch.setattr(Numbers, "pictures", with_bright_samples)
    if not weighted:  # planted fault
        monkeypatch.setattr(Differences, "weights", lambda self: np.ones(len(self.one)))
    found = check_numbers(made, at(best(made, MATRIX)), made.initial_values(), FAR)
    error = NOISE / np.linalg.norm(MATRIX[:, 3])
    right = not found.undetermined and bool(0.5 * error < found.errors["b"] < 2.0 * error)
    assert right is weighted


def test_the_error_of_a_step_is_at_least_that_of_the_check():
    """References without noise may leave a covariance of 0, which says nothing about the step."""
    made = problem(MATRIX)
    numbers = Numbers.of(made, TRUTH, made.initial_values())
    assert numbers is not None
    own, step = np.full(4, 0.004), np.array([0.1, 0.0, 0.0, 0.0])
    found = _checked(numbers, _Fit(np.zeros((4, 4)), np.zeros(4), own, step, np.zeros((4, 0))), np.full(4, 0.01))
    assert found.unfinished["a"].endswith(
        "standard error 0.004, 0.004, 0.004; give more steps or seconds, or resume the run"
    )
    for of_b, expected in ((0.5, 0.005), (0.0, 0.004)):  # a number shares a direction that noise hides with another
        blind = np.array([0.003, 0.0, 0.0, of_b])
        fit = _Fit(np.zeros((4, 4)), np.full(4, 0.004), np.full(4, 0.004), np.zeros(4), np.zeros((4, 0)), blind)
        found = _checked(numbers, fit, np.full(4, 0.01))
        np.testing.assert_allclose(found.errors["a"], [expected, 0.004, 0.004])
        known = {"a": np.full(3, 0.002)}  # of the run, of other directions
        shown = found.standard_errors(TRUTH, known, complete=True)["a"]
        np.testing.assert_allclose(shown, [expected, 0.004, 0.004] if of_b else known["a"], rtol=1e-6)


def test_a_rare_bright_sample_that_hides_a_slope_leaves_its_number_without_a_standard_error():
    """It made the slope's upper limit large, and the stated error, a lower limit, small: 0.00016 for a roughness 0.01 away."""
    made = problem(MATRIX)
    numbers = Numbers.of(made, TRUTH, made.initial_values())
    assert numbers is not None
    of = 0.1 * MATRIX.T.reshape(4, -1, 3)
    noise = np.random.default_rng(1).normal(0.0, 0.5, (2, *of.shape[1:]))  # far above that of the references
    for bright, expected in ((0.0, ()), (1e3, ("b",))):
        one = of.copy()
        one[3, 5] += bright
        found = _checked(numbers, _Fit.of(numbers, Differences(0.1 * np.eye(4), one, of), noise), np.full(4, 0.01))
        errors = found.standard_errors(TRUTH)
        assert found.blind == expected
        assert bool(np.isinf(errors["b"])) is bool(expected)
        assert np.isfinite(errors["a"]).all()
        assert bool(found.noisy(())) is bool(expected)
        assert not found.noisy(("b",))


def test_numbers_move_along_with_an_open_one_that_they_trade_off_against():
    """A base colour was .0107 away beside an open clearcoat, with an error of .0022: the open direction was that of noisier pictures."""
    made = problem(MATRIX)
    numbers = Numbers.of(made, TRUTH, made.initial_values())
    assert numbers is not None
    slopes, rng = 0.1 * MATRIX.T.reshape(4, -1, 3), np.random.default_rng(1)
    slopes[3] = 0.4 * slopes[0]
    one, other = slopes + np.array([0.0, 0.0, 0.0, 0.2])[:, None, None] * rng.normal(size=(2, *slopes.shape))
    residuals = np.tile(rng.normal(0.0, 0.5, slopes.shape[1:]), (2, 1, 1))
    residuals[1, 0] += 0.1
    fit = _Fit.of(numbers, Differences(0.1 * np.eye(4), one, other), residuals)
    np.testing.assert_allclose(fit.unseen[:, 0], [-0.04, 0.0, 0.0, 0.1], atol=0.015)


def test_noise_of_the_test_leaves_no_number_open_of_which_the_run_knows_the_error(monkeypatch: Any):
    """Radiances of lamps that the run knew to a percent were "determined to ± 8.02 or more", since a short test did not see a slope."""
    made = problem(MATRIX)
    numbers = Numbers.of(made, TRUTH, made.initial_values())
    assert numbers is not None
    slopes, rng = 0.1 * MATRIX.T.reshape(4, -1, 3), np.random.default_rng(1)
    one, other = slopes + np.array([0.0, 0.0, 0.0, 1.0])[:, None, None] * rng.normal(size=(2, *slopes.shape))
    residuals = np.tile(rng.normal(0.0, 0.5, slopes.shape[1:]), (2, 1, 1))
    residuals[1, 0] += 0.1
    for settled in (np.zeros(4, bool), np.arange(4) == 3):
        of = dataclasses.replace(numbers, settled=settled)
        fit = _Fit.of(of, Differences(np.diag([0.1, 0.1, 0.1, 0.25]), one, other), residuals)
        found = _checked(of, fit, np.full(4, 0.01))
        assert ("b" in found.undetermined) == (not settled.any())
    seen: list[np.ndarray] = []
    monkeypatch.setattr(least_squares, "_check", lambda of, *_: seen.append(of.settled) or NumbersCheck())
    check_numbers(made, TRUTH, made.initial_values(), FAR, known={"a": np.array([0.01, 0.2, np.inf])})
    assert seen[0].tolist() == [True, False, False, False]


def test_a_small_step_beyond_its_error_asks_for_more_steps_before_a_wrong_scene_is_blamed():
    """A projector 0.006 rad away, seven standard errors but a small part of its range, left 1.2 % of the picture to a curved change."""
    made = problem(MATRIX)
    numbers = Numbers.of(made, TRUTH, made.initial_values())
    assert numbers is not None
    of = 0.1 * MATRIX.T.reshape(4, -1, 3)
    noise = np.random.default_rng(1).normal(0.0, 1e-4, (2, *of.shape[1:]))
    fit = _Fit.of(numbers, Differences(0.1 * np.eye(4), of, of), noise)
    for errors in (0.0, 6.0):
        step = errors * np.maximum(np.hypot(fit.error, fit.own), 1e-9)
        found = _checked(numbers, dataclasses.replace(fit, step=step, unexplained=0.012), np.full(4, 0.01))
        assert not found.unfinished  # too small to be told
        assert "1.2 %" in found.distorted
        assert ("give more steps" in found.distorted) is bool(errors)


SIDE = 24


def _scenery(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """A picture (H, W, 3) of a smooth background, in pixels from its centre."""
    return np.stack([1.0 + 0.2 * np.sin(0.5 * x + k) * np.cos(0.4 * y) for k in range(3)], axis=-1)


def _seen(moved: float, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """The picture with a spot that has moved by a number of pixels along x."""
    return _scenery(x, y) + np.exp(-0.1 * ((x - 5.0 - moved) ** 2 + (y - 3.0) ** 2))[..., None]


def _lens(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return where a lens moves pixels, up to 1.8 at the corners."""
    scale = 1.0 + 0.11 * (x**2 + y**2) / (2 * 11.5**2)
    return scale * x, scale * y


@pytest.mark.parametrize(
    ("distort", "words"),
    [
        (lambda x, y: (x, y), ""),
        (lambda x, y: (x - 1.0, y), "as if the reference of view 0 were shifted by 0.9"),
        (
            lambda x, y: (0.95 * x, 0.95 * y),
            "as if the reference of view 0 had another field of view, which would move a by",
        ),
        (lambda x, y: (x + 0.05 * y, y - 0.05 * x), "were turned by 2.8° clockwise"),
        (_lens, "as if the reference of view 0 were distorted by a lens, which would move a by"),
    ],
)
def test_numbers_have_no_standard_errors_where_a_distortion_of_the_reference_would_move_them(distort: Any, words: str):
    """A pose beside a reference that was shifted by a pixel ended 110 of its standard errors away in silence."""
    y, x = np.mgrid[:SIDE, :SIDE] - (SIDE - 1) / 2
    matrix = (_seen(0.1, x, y) - _seen(-0.1, x, y)).reshape(-1, 1) / 0.2
    unknown = {"a": np.zeros(1), "hidden": np.zeros(1)}
    both, offset = np.hstack([matrix, 0.0 * matrix]), _seen(0.0, x, y)
    renderer = AnalyticRenderer(unknown, both, offset=offset, noise=0.0, grain=0.2, shape=(SIDE, SIDE))
    noise = np.random.default_rng(2).normal(0.0, 0.02, (SIDE, SIDE, 3))
    view = ur.View((_seen(0.0, *distort(x, y)) + noise).astype(np.float32))
    made = ur.Problem(renderer, [ur.Parameter("a", initial=[0.5]), ur.Parameter("hidden", initial=[0.5])], [view])
    wanted = (np.asarray(view.reference, np.float64) - _seen(0.0, x, y)).ravel()
    ends = {
        "a": np.linalg.lstsq(matrix, wanted, rcond=None)[0].astype(np.float32),
        "hidden": np.full(1, 0.5, np.float32),
    }
    found = check_numbers(made, ends, made.initial_values(), FAR)
    assert words in found.distorted
    assert bool(found.distorted) == bool(words)
    assert ("a" in found.errors) == (not words)
    assert [*found.undetermined] == ["hidden"]  # a distortion had dropped its line
    # Pictures of numbers that have not settled may differ as if distorted.
    far = check_numbers(made, {**ends, "a": ends["a"] + np.float32(0.3)}, made.initial_values(), FAR).distorted
    assert bool(far) == bool(words)
    first = "give more steps or another start, then check the references"
    assert (first in far, first in found.distorted) == (bool(far), False)


@pytest.mark.parametrize("distort", [False, True])
@pytest.mark.parametrize("noise", [0.02, 0.05])
def test_a_field_of_view_has_no_standard_error_beside_a_lens(distort: bool, noise: float):
    """Noise of the reference hid what a lens of 5 % did to the picture, while the field of view was 15 standard errors off."""
    y, x = np.mgrid[:SIDE, :SIDE] - (SIDE - 1) / 2
    matrix = (_seen(0.0, 1.01 * x, 1.01 * y) - _seen(0.0, 0.99 * x, 0.99 * y)).reshape(-1, 1) / 0.02
    offset, random = _seen(0.0, x, y), np.random.default_rng(3)
    renderer = AnalyticRenderer({"a": np.zeros(1)}, matrix, offset=offset, noise=0.0, grain=0.2, shape=(SIDE, SIDE))
    reference = _seen(0.0, *(_lens(x, y) if distort else (x, y))) + random.normal(0.0, noise, offset.shape)
    made = ur.Problem(renderer, [ur.Parameter("a", initial=[0.5])], [ur.View(reference.astype(np.float32))])
    end = np.linalg.lstsq(matrix, (reference - offset).ravel(), rcond=None)[0]
    found = check_numbers(made, {"a": end.astype(np.float32)}, made.initial_values(), FAR)
    assert ("would move a by" in found.distorted) is distort
    assert ("a" in found.errors) is not distort


@pytest.mark.parametrize(
    ("brightness", "turned", "words"),
    [
        (1.0, False, ""),
        (0.97, False, ""),
        (0.7, False, "were 0.7 times as bright"),
        (1.0, True, "do not explain"),
    ],
)
def test_a_distortion_that_explains_little_of_the_difference_has_no_name(brightness: float, turned: bool, words: str):
    """A mirrored reference looked blurred, and so did one that was darker by half a stop."""
    y, x = np.mgrid[:SIDE, :SIDE] - (SIDE - 1) / 2
    scenery, spot = _scenery(x, y), _seen(0.0, x, y) - _scenery(x, y)
    renderer = AnalyticRenderer(
        {"a": np.zeros(1)}, spot.reshape(-1, 1), offset=scenery, noise=0.0, grain=0.2, shape=(SIDE, SIDE)
    )
    noise = np.random.default_rng(2).normal(0.0, 0.02, scenery.shape)
    reference = brightness * (spot + (_scenery(x + y, y - x) if turned else scenery)) + noise
    made = ur.Problem(renderer, [ur.Parameter("a", initial=[0.5])], [ur.View(reference.astype(np.float32))])
    end = np.linalg.lstsq(spot.reshape(-1, 1), (reference - scenery).ravel(), rcond=None)[0]
    found = check_numbers(made, {"a": end.astype(np.float32)}, made.initial_values(), FAR).distorted
    assert words in found
    assert bool(found) == bool(words)
    brightness_is = next(iter(distortions(scenery, reference)))
    assert [brightness_is(np.array([by])) for by in (-254.0, 1.02)] == [f"were {x} times as bright" for x in (255, 0)]


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize(
    ("distort", "words"),
    [
        (lambda picture, x: picture, ""),
        (
            lambda picture, x: picture * (1.0 + 0.001 * x),
            r"by 0\.\d+ % in a pattern that neither noise nor these numbers explain",
        ),
        (lambda picture, x: picture + 0.016 * (x > 0.0), "neither noise nor these numbers explain"),
    ],
)
def test_smooth_differences_far_below_the_noise_of_a_pixel_take_standard_errors_away(
    distort: Any, words: str, seed: int
) -> None:
    """A lamp that was known 3 % too dim, and gamma 2.2 for sRGB, left errors 10 to 80 times too small below 1 % of the picture."""
    y, x = np.mgrid[:SIDE, :SIDE] - (SIDE - 1) / 2
    scenery, spot = _scenery(x, y), _seen(0.0, x, y) - _scenery(x, y)
    renderer = AnalyticRenderer(
        {"a": np.zeros(1)}, spot.reshape(-1, 1), offset=scenery, noise=0.0, grain=0.4, shape=(SIDE, SIDE)
    )
    random = np.random.default_rng(seed)
    reference = distort(scenery + spot, x[..., None]) + random.normal(0.0, 0.02, scenery.shape)
    made = ur.Problem(renderer, [ur.Parameter("a", initial=[0.5])], [ur.View(reference.astype(np.float32))])
    fitted = np.linalg.lstsq(spot.reshape(-1, 1), (reference - scenery).ravel(), rcond=None)[0]
    ends = [scenery + fitted * spot + random.normal(0.0, 0.02, scenery.shape) for _ in range(2)]
    ends[0][0, 0] = np.nan  # this pixel alone does not count
    found = check_numbers(made, {"a": fitted.astype(np.float32)}, made.initial_values(), FAR, ends={0: ends})
    assert bool(found.distorted) == bool(words) == ("a" not in found.errors)
    assert re.search(words, found.distorted)
    stated = ur.runs.uncertainty(made, {"a": fitted.astype(np.float32)}, seed=seed)
    assert bool(words) == ("a" not in stated.standard_error)
    assert re.search(words, " ".join(stated.missing))


def test_pixels_out_of_the_mask_do_not_count_for_the_size_of_a_smooth_difference() -> None:
    """Of a quarter of the pixels, 2 % were said to be 4 %."""
    random, size = np.random.default_rng(0), (48, 48)
    y, x = np.mgrid[:48, :48]
    matrix = random.random((48 * 48 * 3, 1))
    shares = []
    for mask in (np.ones(size), np.where((y % 2 == 0) & (x % 2 == 0), 1.0, 0.0)):
        renderer = AnalyticRenderer({"a": np.zeros(1)}, matrix, offset=0.5, noise=0.0, grain=0.2, shape=size)
        exact = renderer.exact({"a": np.full(1, 0.5)})
        wrong = 0.016 * (-1.0) ** (x // 16 + y // 16)[..., None]
        reference = exact + wrong + random.normal(0.0, 0.02, exact.shape)
        made = ur.Problem(renderer, [ur.Parameter("a", initial=[0.3])], [ur.View(reference.astype("f4"), mask=mask)])
        ends = {0: [exact + random.normal(0.0, 0.02, exact.shape) for _ in range(2)]}
        line = check_numbers(made, {"a": np.full(1, 0.5, "f4")}, made.initial_values(), FAR, ends=ends).distorted
        shares.append(float(line.split(" by ")[1].split(" %")[0]))
    assert shares[1] == pytest.approx(shares[0], rel=0.2)


@pytest.mark.parametrize("masked", [True, False])
def test_pixels_that_are_not_finite_leave_the_others_tested(masked: bool) -> None:
    """Nothing was tested, in silence: the weight 0 times a value that is no number is none."""
    random, size = np.random.default_rng(0), (16, 16)
    matrix, offset, mask = random.random((16 * 16 * 3, 1)), np.full((*size, 3), 0.1), np.ones(size)
    reference = (0.5 * matrix).reshape(offset.shape) + offset + random.normal(0.0, 0.02, offset.shape)
    mask[2, 5], offset[2, 5, 1] = float(not masked), np.nan
    renderer = AnalyticRenderer({"a": np.zeros(1)}, matrix, offset=offset, noise=0.1, grain=0.1, shape=size)
    made = ur.Problem(renderer, [ur.Parameter("a", initial=[0.3])], [ur.View(reference.astype(np.float32), mask=mask)])
    found = check_numbers(made, {"a": np.full(1, 0.5, np.float32)}, made.initial_values(), FAR)
    assert 0.0 < found.errors["a"][0] < 0.01


def test_no_time_no_check():
    made = problem(MATRIX)
    found = check_numbers(made, at(best(made, MATRIX)), made.initial_values(), 0.0)
    assert not found.errors


@pytest.mark.parametrize("units", [1e-6, 1e6])
def test_gauss_newton_steps_arrive_in_any_units(units: float):
    """Widths of differences and the margin of a bound follow the size of the values."""
    renderer = AnalyticRenderer({k: units * x for k, x in TRUTH.items()}, MATRIX / units, 2.0, 0.05, shape=SHAPE)
    seen = renderer.exact({k: units * x for k, x in TRUTH.items()}).astype(np.float32)
    start = [ur.Parameter(key, initial=0.5 * units * value, bounds=(0, None)) for key, value in TRUTH.items()]
    made = ur.Problem(renderer, start, [ur.View(seen)])
    result = ur.optimize(made, ur.GaussNewton(4, 4), ur.optimizers.AveragedNewton(), steps=12)
    np.testing.assert_allclose(result.parameters["a"], units * TRUTH["a"], rtol=0.02)
    np.testing.assert_allclose(result.parameters["b"], units * TRUTH["b"], rtol=0.02)


def test_small_values_have_a_small_margin_at_an_open_bound():
    for scale, expected in ((1e-5, 1e-9), (0.0, 1e-4), (50.0, 1e-4)):
        renderer = AnalyticRenderer(TRUTH, MATRIX, 2.0, shape=SHAPE)
        view = ur.View(renderer.exact(TRUTH).astype(np.float32))
        parameter = ur.Parameter("a", initial=[scale, 0.0, 0.0], bounds=(0, None))
        unknown = ur.Problem(renderer, [parameter], [view]).unknowns["a"]
        np.testing.assert_allclose(unknown.project(np.zeros(3)), expected, rtol=1e-5)


def test_the_length_of_a_direction_is_neither_open_nor_unfinished(monkeypatch: pytest.MonkeyPatch):
    """Pictures of a unit vector; the run ended with a vector twice as long."""

    made = problem(MATRIX)
    known = dict(made.renderer.parameters())
    known["a"] = dataclasses.replace(known["a"], role="direction")
    inner = Numbers.pictures

    def pictures(self: Numbers, points: np.ndarray, key: Key) -> np.ndarray:
        scaled = points.copy()
        scaled[:, :3] /= np.linalg.norm(scaled[:, :3], axis=1, keepdims=True)
        return inner(self, scaled, key)

    renderer = AnalyticRenderer(TRUTH, MATRIX, offset=2.0, noise=0.05, shape=SHAPE)
    monkeypatch.setattr(AnalyticRenderer, "parameters", lambda self: known)
    monkeypatch.setattr(Numbers, "pictures", pictures)
    truth = TRUTH["a"] / np.linalg.norm(TRUTH["a"])
    seen = renderer.exact({"a": truth, "b": TRUTH["b"]})
    seen = (seen + np.random.default_rng(5).normal(0.0, NOISE, seen.shape)).astype(np.float32)
    made = ur.Problem(renderer, [ur.Parameter(k, initial=x) for k, x in TRUTH.items()], [ur.View(seen)])
    values = {"a": (2.0 * truth).astype(np.float32), "b": TRUTH["b"].astype(np.float32)}
    found = check_numbers(made, values, made.initial_values(), FAR)
    assert not found.undetermined
    assert not found.unfinished
    assert found.errors["a"].max() < 0.05
    monkeypatch.setattr(Numbers, "tangents", lambda self: np.eye(self.point.size))
    assert "a" in check_numbers(made, values, made.initial_values(), FAR).undetermined


@pytest.mark.parametrize("noise", [0.05, 0.5])
def test_errors_of_squares_follow_the_noise_and_not_the_scatter_over_pixels(noise: float):
    """One pixel that shows all of the change leaves its square certain, and the errors are those of repetitions."""
    matrix = np.zeros_like(MATRIX)
    matrix[:3] = 5.0 * MATRIX[:3]
    made = problem(matrix, noise=noise)
    numbers = Numbers.of(made, made.initial_values(), made.initial_values())
    assert numbers is not None
    runs = [numbers.differences(np.diag(numbers.limits), Key(0).fold(n)).squares() for n in range(64)]
    squares, errors = (np.array([run[part] for run in runs]) for part in (0, 1))
    scatter = squares.std(axis=0)
    assert (squares.mean(axis=0) > 3.0 * scatter).all()
    typical = np.sqrt(np.mean(np.square(errors), axis=0))
    assert (typical > 0.7 * scatter).all()
    assert (typical < 1.4 * scatter).all()


def test_errors_of_squares_of_noise_alone():
    generator = np.random.default_rng(0)
    one, other = generator.normal(size=(2, 400, 60, 3))
    squares, errors = Differences(np.zeros((1, 400)), one, other).squares()
    assert np.sqrt(np.mean(np.square(errors))) == pytest.approx(squares.std(), rel=0.15)


def test_an_end_whose_pictures_are_no_better_than_the_starts_has_no_standard_error():
    made, away = problem(MATRIX), np.array([0.1, 0.0, 0.0, 0.0])
    solution = best(made, MATRIX)
    found = check_numbers(made, at(solution + away), at(solution), FAR)
    assert "a: the pictures are no better than with its initial value" in found.undetermined["a"]
    assert np.isinf(found.errors["a"]).any()
    assert "b" not in found.undetermined
    better = check_numbers(made, at(solution + away), at(solution + 2.0 * away), FAR)
    assert not better.undetermined
    assert list(better.unfinished) == ["a"]


def check_of_a_turned_cylinder(monkeypatch: pytest.MonkeyPatch, again: bool) -> NumbersCheck:
    """Return the check of a rotation "a", (3,), that pictures show except about an axis, with noise that depends on the rotation."""
    made, axis = problem(MATRIX, noise=0.0), np.array([0.0, 0.94, 0.34])
    known = dict(made.renderer.parameters())
    known["a"] = dataclasses.replace(known["a"], rigid=True, length=1.0)
    inner = Numbers.pictures

    def pictures(self: Numbers, points: np.ndarray, key: Key) -> np.ndarray:
        seen = points.copy()
        seen[:, :3] -= np.outer(points[:, :3] @ axis, axis) / float(axis @ axis)
        added = [
            np.random.default_rng([key.uint32(), zlib.crc32(x.tobytes())]).normal(0.0, 1.0, (64, 3)) for x in points
        ]
        return inner(self, seen, key) + np.stack(added)

    with monkeypatch.context() as patched:
        patched.setattr(AnalyticRenderer, "parameters", lambda self: known)
        patched.setattr(Numbers, "pictures", pictures)
        if not again:  # the planted fault
            patched.setattr(least_squares, "_ROUNDS", 0)
            patched.setattr(Differences, "mixed", lambda self, factors: self)
        return check_numbers(made, TRUTH, made.initial_values(), FAR)


def test_the_error_along_an_axis_of_symmetry_is_not_that_of_its_noisy_sum_with_other_directions(
    monkeypatch: pytest.MonkeyPatch,
):
    first, again = (check_of_a_turned_cylinder(monkeypatch, measured) for measured in (False, True))
    assert first.errors["a"].max() < 0.1
    assert again.errors["a"][0] < 0.1
    assert again.errors["a"][1] > 0.15
    assert np.isinf(again.noise["a"]).tolist() == [False, True, True]


def test_a_number_that_starts_and_ends_at_0_is_changed_within_its_bounds():
    """Its limit was 0, so its differences were no numbers, and the check was left out in silence."""
    renderer = AnalyticRenderer({"a": np.zeros(1), "b": np.ones(1)}, MATRIX[:, :2], offset=2.0, noise=0.0, shape=SHAPE)
    values = {"a": np.zeros(1, np.float32), "b": np.ones(1, np.float32)}
    reference = renderer.exact(values) + NUMBERS.normal(0.0, NOISE, (*SHAPE, 3))
    parameters = [ur.Parameter(key, initial=x, bounds=(0, None)) for key, x in values.items()]
    made = ur.Problem(renderer, parameters, [ur.View(reference)])
    assert set(check_numbers(made, values, values, FAR).errors) == {"a", "b"}


class OfTwoSizes(AnalyticRenderer):
    """The second sensor shows the first sixteen pixels of the first."""

    def resolutions(self) -> list[tuple[int, int]]:
        return [self.shape, (4, 4)]

    def image_batch(self, parameters: Any, request: SampleRequest) -> np.ndarray:
        size = self.resolutions()[request.sensor]
        samples = np.random.default_rng(request.seed).uniform(-1.0, 1.0, (*size, 3, request.spp)).mean(axis=-1)
        states = zip(*(np.reshape(x, (len(x), -1)) for x in parameters.values()), strict=True)
        exact = [(self.matrix @ np.concatenate(state))[: samples.size].reshape(samples.shape) for state in states]
        return np.stack([image * (1.0 + self.noise * samples) for image in exact])


def test_errors_are_those_of_the_weights_that_the_loss_gives_views_of_different_sizes():
    """A view of sixteen pixels counts as much as one of 576. Equal pixels would have a third of the errors."""
    size, truth, z = (24, 24), np.array([0.6, 0.4]), []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        matrix = rng.uniform(0.2, 1.0, (24 * 24 * 3, 2))
        start = {"a": np.full(1, 0.5), "b": np.full(1, 0.5)}
        renderer = OfTwoSizes(start, matrix, noise=0.02, shape=size, sensors=2)
        parts = [(matrix, size), (matrix[:48], (4, 4))]
        noisy = [a @ truth + rng.normal(0.0, 0.05, len(a)) for a, _ in parts]
        views = [ur.View(y.reshape(*of, 3), n) for n, (y, (_, of)) in enumerate(zip(noisy, parts, strict=True))]
        made = ur.Problem(renderer, [ur.Parameter(key) for key in start], views)
        normal = sum(a.T @ a / len(a) for a, _ in parts)
        found = np.linalg.solve(normal, sum(a.T @ y / len(a) for y, (a, _) in zip(noisy, parts, strict=True)))
        values = {key: found[[n]].astype(np.float32) for n, key in enumerate(start)}
        check = check_numbers(made, values, start, FAR)
        assert not check.unfinished
        z += [(values[key][0] - truth[n]) / check.errors[key][0] for n, key in enumerate(start)]
    assert np.std(z) == pytest.approx(1.0, abs=0.35)


@pytest.mark.parametrize(("high", "finite"), [(0.55, False), (0.6001, True), (1.0, True)])
def test_a_number_whose_solution_is_beyond_its_bound_has_no_standard_error(high: float, finite: bool):
    """At the bound, a small error would exclude the true value, 0.6."""
    made = problem(MATRIX)
    made = made.replaced(parameters=[ur.Parameter("a", bounds=(0.0, high)), ur.Parameter("b")])
    values = {"a": np.array([min(0.6, high), 0.3, 0.4], np.float32), "b": np.asarray(0.5, np.float32)}
    values["a"] = np.asarray(made.unknowns["a"].project(values["a"]), np.float32)
    check = check_numbers(made, values, made.initial_values(), FAR)
    assert np.isfinite(check.errors["a"]).tolist() == [finite, True, True]
    assert np.isfinite(check.errors["b"]).all()


def test_errors_are_those_of_slopes_at_the_end_where_pictures_change_faster_further_off(
    monkeypatch: pytest.MonkeyPatch,
):
    """A tenth of the slope within 0.1 of the solution, and all of it beyond, as where a sun lights another face. The planted fault are long
    differences: they state a tenth to a half of the error, and of the distance."""
    made, inner = problem(MATRIX), Numbers.pictures
    near = MATRIX * [1.0, 1.0, 1.0, 0.1]

    def pictures(self: Numbers, points: np.ndarray, key: Key) -> np.ndarray:
        seen, off = points.copy(), points[:, 3] - TRUTH["b"]
        seen[:, 3] = TRUTH["b"] + np.sign(off) * np.maximum(0.1 * np.abs(off), np.abs(off) - 0.09)
        return inner(self, seen, key)

    monkeypatch.setattr(Numbers, "pictures", pictures)
    target = np.asarray(made.views[0].reference, np.float64).reshape(-1) - 2.0 - 0.9 * TRUTH["b"] * MATRIX[:, 3]
    solution = np.linalg.lstsq(near, target, rcond=None)[0]
    residual, inverse = target - near @ solution, np.linalg.inv(near.T @ near)
    scores = (near * residual[:, None]).reshape(-1, 3, 4).sum(axis=1)
    expected = np.sqrt((inverse @ scores.T @ scores @ inverse)[3, 3])
    end = at(solution + [0.0, 0.0, 0.0, 0.04])
    found = check_numbers(made, end, made.initial_values(), FAR)
    assert found.errors["b"] == pytest.approx(expected, rel=0.2)
    assert found.steps["b"] == pytest.approx(-0.04, rel=0.2)
    monkeypatch.setattr(field_directions, "_CURVED", np.inf)
    wide = check_numbers(made, end, made.initial_values(), FAR)
    assert wide.errors["b"] < 0.5 * expected
    assert abs(wide.steps["b"][0]) < 0.02


def test_short_differences_that_tell_nothing_new_take_no_pictures_from_the_test(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The roughness of a mirror had no standard error, since noise hid it in half of the pictures."""
    made, repeats = problem(MATRIX), []
    own, tried = least_squares._repeated, least_squares.narrowed

    def repeated(numbers: Any, directions: np.ndarray, key: Any, until: float) -> Any:
        repeats.append(until - timing.now())
        return own(numbers, directions, key, until)

    monkeypatch.setattr(least_squares, "_repeated", repeated)
    for narrow in (lambda _numbers, differences, *_: (differences, np.inf), tried):
        monkeypatch.setattr(least_squares, "narrowed", narrow)
        with timing.counting():
            check_numbers(made, at(best(made, MATRIX)), made.initial_values(), 0.5)
    assert repeats[0] == pytest.approx(repeats[1])
