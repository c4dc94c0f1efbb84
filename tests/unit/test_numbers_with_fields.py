"""Numbers with textures and other unknowns: their standard errors are those of all unknowns, or there are none."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest

import unrender as ur
from tests.analytic import AnalyticRenderer
from tiers import slow
from unrender.runs import field_directions, final_images, least_squares
from unrender.runs.field_directions import _Adjoints
from unrender.runs.least_squares import NumbersCheck, check_numbers
from unrender.runs.verification import DIFFERS
from unrender.scene.prior import Prior

SHAPE = (8, 8)
ROWS = SHAPE[0] * SHAPE[1] * 3
NOISE, FAR = 0.02, np.inf
_RANDOM = np.random.default_rng(3)
MATRIX = _RANDOM.normal(0.0, 1.0, (ROWS, 4))

CELLS = _RANDOM.normal(0.0, 1.0, (ROWS, 48)) * (_RANDOM.random((ROWS, 48)) < 0.1)
"""Derivatives by a texture of 4 × 4 texels, each of which few pixels see."""


def with_a_texture(shared: float) -> tuple[ur.Problem, np.ndarray]:
    """Return two numbers with a texture, and the matrix (ROWS, 2 + 48). The first number changes the picture as a sum of texels does, and
    by √(1 − shared²) in another way."""
    texels = CELLS @ np.random.default_rng(1).uniform(0.5, 1.0, 48)
    other, alone = MATRIX[:, 0], MATRIX[:, 1]
    first = shared * texels / np.linalg.norm(texels) + np.sqrt(1.0 - shared**2) * other / np.linalg.norm(other)
    matrix = np.concatenate([10.0 * first[:, None], alone[:, None], CELLS], axis=1)
    truth = {"a": np.array(0.6), "b": np.array(0.5), "texture": np.full((4, 4, 3), 0.5)}
    renderer = AnalyticRenderer(truth, matrix, offset=2.0, noise=0.02, shape=SHAPE)
    added = np.random.default_rng(5).normal(0.0, NOISE, (*SHAPE, 3))
    view = ur.View((renderer.exact(truth) + added).astype(np.float32))
    return ur.Problem(renderer, [ur.Parameter(key, initial=0.5 * x) for key, x in truth.items()], [view]), matrix


def at_truth(made: ur.Problem) -> dict[str, np.ndarray]:
    return {key: x.astype(np.float32) for key, x in made.renderer.values(list(made.shapes())).items()}


def with_a_known_texture(
    made: ur.Problem, values: Mapping[str, np.ndarray], monkeypatch: pytest.MonkeyPatch
) -> NumbersCheck:
    """Return the planted fault: the check that takes the texture as known and says so of no number."""
    with monkeypatch.context() as planted:
        planted.setattr(least_squares, "fields_of", lambda *given: ((), {}))
        return check_numbers(made, values, made.initial_values(), FAR)


def deviations(made: ur.Problem, matrix: np.ndarray) -> np.ndarray:
    """Return the standard errors of the numbers by least squares of all 50 unknowns."""
    target = np.asarray(made.views[0].reference, np.float64).reshape(-1) - 2.0
    inverse = np.linalg.inv(matrix.T @ matrix)
    residual = target - matrix @ (inverse @ matrix.T @ target)
    freedom = len(matrix) / (len(matrix) - matrix.shape[1])
    return np.sqrt(freedom * np.diag(inverse) * np.mean(residual**2))[:2]


@pytest.mark.parametrize("shared", [0.0, 0.9, 0.99])
def test_standard_errors_with_a_texture_are_those_of_all_unknowns(shared: float, monkeypatch: pytest.MonkeyPatch):
    """Within a third, as the directions of the texture are approximate. With the texture fixed, the first is too small by 1/√(1 − s²)."""
    made, matrix = with_a_texture(shared)
    values = at_truth(made)
    found = check_numbers(made, values, made.initial_values(), FAR, ur.runs.sensitivity(made, values))
    expected = deviations(made, matrix)
    np.testing.assert_allclose([found.errors["a"][0], found.errors["b"][0]], expected, rtol=0.33)
    fixed = with_a_known_texture(made, values, monkeypatch)
    if shared >= 0.9:
        assert fixed.errors["a"][0] < 0.6 * expected[0]


def test_a_texture_that_no_picture_shows_has_a_positive_diagonal():
    """A view of 4 × 4 pixels that hardly shows the wall gave NaN, and a warning of NumPy's."""
    for shape in ((4, 4, 3), (3,)):
        diagonal = field_directions._diagonal(np.zeros(shape))
        assert diagonal.shape == shape
        assert (diagonal > 0.0).all()


def test_a_number_that_a_texture_can_replace_is_told_with_it(monkeypatch: pytest.MonkeyPatch):
    made, _ = with_a_texture(1.0)
    values = at_truth(made)
    found = check_numbers(made, values, made.initial_values(), FAR, ur.runs.sensitivity(made, values))
    assert list(found.undetermined) == ["a"]
    assert "together with texture" in found.undetermined["a"]
    assert not with_a_known_texture(made, values, monkeypatch).undetermined  # planted


@pytest.mark.parametrize("own", [True, False])
@pytest.mark.parametrize("reference_noise", [0.25 * NOISE, NOISE])
def test_a_factor_of_a_texture_is_told_with_it(monkeypatch: pytest.MonkeyPatch, reference_noise: float, own: bool):
    """Pictures that blur the texture, as a diffuse surface blurs a sky, leave other directions approximate."""
    random = np.random.default_rng(2)
    texture = random.uniform(0.05, 1.0, (4, 4, 3))
    cells = random.uniform(0.5, 1.0, (ROWS, 1)) * (1.0 + 0.3 * random.normal(0.0, 1.0, (ROWS, 48))) / 12.0
    truth = {"scale": np.array(2.0), "texture": texture}
    renderer = AnalyticRenderer(truth, np.column_stack([cells @ texture.ravel(), cells]), 0.5, noise=0.02, shape=SHAPE)
    view = ur.View((renderer.exact(truth) + random.normal(0.0, reference_noise, (*SHAPE, 3))).astype(np.float32))
    made = ur.Problem(renderer, [ur.Parameter(key, initial=0.5 * x) for key, x in truth.items()], [view])
    values = {key: x.astype(np.float32) for key, x in renderer.values(["scale", "texture"]).items()}
    if not own:  # planted fault
        monkeypatch.setattr(_Adjoints, "scaled", lambda self: {"texture": np.zeros((0, 4, 4, 3))})
    found = check_numbers(made, values, made.initial_values(), FAR, ur.runs.sensitivity(made, values))
    assert ("together with texture" in found.undetermined.get("scale", "")) is own
    assert found.errors["scale"][0] <= 2.0 or np.isinf(found.errors["scale"][0])  # beyond its size it has none


def test_the_step_of_a_number_with_a_texture_is_that_of_all_unknowns():
    """The texture is still at its start, so the number has gone its way; with the texture fixed, it would stay there."""
    made, matrix = with_a_texture(0.9)
    start = made.initial_values()
    target = np.asarray(made.views[0].reference, np.float64).reshape(-1) - 2.0 - CELLS @ start["texture"].ravel()
    numbers = np.linalg.lstsq(matrix[:, :2], target, rcond=None)[0].astype(np.float32)
    values = {**start, "a": numbers[0], "b": numbers[1]}
    full = np.linalg.lstsq(matrix, np.asarray(made.views[0].reference, np.float64).reshape(-1) - 2.0, rcond=None)[0]
    found = check_numbers(made, values, start, FAR, ur.runs.sensitivity(made, values))
    np.testing.assert_allclose(found.steps["a"], full[0] - numbers[0], rtol=0.35)
    assert "a" in found.unfinished or "a" in found.undetermined
    assert abs(check_numbers(made, values, start, FAR).steps["a"][0]) < 0.2 * abs(found.steps["a"][0])


# ---------------------------------------------------------------------- numbers without standard errors


def assert_no_error_is_stated(made: ur.Problem, found: NumbersCheck, keys: tuple[str, ...], *words: str) -> None:
    """Check that the numbers have no standard error, neither in a run folder nor elsewhere, and that one line says why."""
    assert (found.unchecked, found.errors) == (keys, {})
    (line,) = found.missing()
    assert all(word in line for word in words)
    values = at_truth(made)
    assert not found.standard_errors(values)


@pytest.mark.parametrize("seconds", [0.3, slow(1.0)])
def test_numbers_with_a_texture_that_there_was_no_time_to_move(monkeypatch: pytest.MonkeyPatch, seconds: float):
    made, _ = with_a_texture(0.9)
    values, prepare = at_truth(made), _Adjoints.__init__
    sensitivity = ur.runs.sensitivity(made, values)

    def slow(self: _Adjoints, *given: Any) -> None:
        prepare(self, *given)
        time.sleep(0.75 * seconds)  # more than half of the time that is left

    monkeypatch.setattr(_Adjoints, "__init__", slow)
    found = check_numbers(made, values, made.initial_values(), seconds, sensitivity)
    assert_no_error_is_stated(made, found, ("a", "b"), "whether a, b converged: the run is too short for this test")


@pytest.mark.slow
def test_numbers_with_a_texture_that_there_was_time_to_move_once_only(monkeypatch: pytest.MonkeyPatch):
    """One round of directions states .57 of the error."""
    made, _ = with_a_texture(0.99)
    values, scaled = at_truth(made), _Adjoints.of
    sensitivity = ur.runs.sensitivity(made, values)

    def slow(self: _Adjoints, pictures: np.ndarray) -> dict[str, np.ndarray]:
        time.sleep(0.6)
        return scaled(self, pictures)

    monkeypatch.setattr(_Adjoints, "of", slow)
    found = check_numbers(made, values, made.initial_values(), 2.0, sensitivity)
    assert_no_error_is_stated(
        made, found, ("a", "b"), "a, b have no standard errors", "texture (the run is too short for this test)"
    )
    monkeypatch.setattr(field_directions, "_ROUNDS", 1)
    found = check_numbers(made, values, made.initial_values(), FAR, sensitivity)
    assert_no_error_is_stated(made, found, ("a", "b"), "texture (whose share in the pictures is not resolved)")


@pytest.mark.parametrize("what", ["prior", "too large", "mesh", "no derivative"])
def test_numbers_with_an_unknown_that_the_test_cannot_move(monkeypatch: pytest.MonkeyPatch, what: str):
    made, _ = with_a_texture(1.0)
    if what == "prior":
        start = made.initial_values()
        parameters = [ur.Parameter(key, initial=start[key]) for key in ("a", "b")]
        parameters += [ur.Parameter("texture", initial=start["texture"], prior=Prior(smoothness=0.5))]
        made = ur.Problem(made.renderer, parameters, made.views)
    values = at_truth(made)
    sensitivity = ur.runs.sensitivity(made, values)
    if what == "too large":
        monkeypatch.setattr(field_directions, "_MOST_VALUES", 1)
    if what == "mesh":
        known = dict(made.renderer.parameters())
        known["texture"] = dataclasses.replace(known["texture"], welded=True)
        monkeypatch.setattr(AnalyticRenderer, "parameters", lambda self: known)
    if what == "no derivative":
        sensitivity = {key: x for key, x in sensitivity.items() if key != "texture"}
    found = check_numbers(made, values, made.initial_values(), FAR, sensitivity)
    assert_no_error_is_stated(made, found, ("a", "b"), "a, b have no standard errors", "with texture (", what)
    assert not found.undetermined
    if what in ("prior", "too large"):
        stated = ur.runs.uncertainty(made, values)
        assert not {"a", "b"} & set(stated.standard_error)
        lines = {key: line for line in stated.missing for key in made.unknowns if line.startswith(f"{key}: ")}
        assert set(lines) == {"texture"} - set(stated.standard_error)
        assert [line for line in stated.missing if line not in lines.values()] == found.missing()


def test_a_run_folder_states_no_error_of_numbers_with_a_prior(monkeypatch: Any):
    """One line says why, also where the noise of the test hides a number: an albedo beside a grid had two reasons."""
    checked = least_squares._checked
    monkeypatch.setattr(least_squares, "_checked", lambda *of: dataclasses.replace(checked(*of), blind=("a",)))
    made, _ = with_a_texture(0.9)
    start = made.initial_values()
    parameters = [ur.Parameter(key, initial=start[key]) for key in ("a", "b")]
    parameters += [ur.Parameter("texture", initial=start["texture"], prior=Prior(smoothness=0.5))]
    made = ur.Problem(made.renderer, parameters, made.views)
    values = at_truth(made)
    result = ur.Result(values, start, [{"step": 1, "loss": 0.1}], 1.0, 0.0, "steps")
    result = dataclasses.replace(result, standard_error={"a": np.array(1e-3)})
    found = final_images.render_final_images(made, result, 16)
    assert not {"a", "b"} & set(found.standard_error)
    (line,) = [line for line in found.undetermined if "no standard error" in line]
    assert line == "a, b have no standard errors: they are recovered together with texture (which has a prior)"
    assert not check_numbers(made, values, start, FAR).noisy(())


def test_a_number_that_is_undetermined_has_one_line():
    check = NumbersCheck(undetermined={"a": "a: open"}, unchecked=("a", "b"), fixed={"texture": "which has a prior"})
    assert check.missing(check.undetermined) == [
        "b has no standard error: it is recovered together with texture (which has a prior)"
    ]
    assert not check.missing(check.unchecked)


def test_a_number_with_one_with_a_prior():
    made, _ = with_a_texture(0.9)
    start = made.initial_values()
    prior = Prior(near=0.5, std=0.1)
    parameters = [ur.Parameter(key, initial=x, prior=prior if key == "b" else None) for key, x in start.items()]
    made = ur.Problem(made.renderer, parameters, made.views)
    values = at_truth(made)
    found = check_numbers(made, values, start, FAR, ur.runs.sensitivity(made, values))
    assert_no_error_is_stated(made, found, ("a",), "with b (which has a prior)")


def test_an_unknown_that_no_picture_shows_takes_no_error_away():
    renderer = AnalyticRenderer(
        {"a": np.array(0.6), "b": np.array(0.5), "texture": np.full((4, 4, 3), 0.5)},
        np.concatenate([MATRIX[:, :2], np.zeros((ROWS, 48))], axis=1),
        offset=2.0,
        noise=0.02,
        shape=SHAPE,
    )
    truth = renderer.values(["a", "b", "texture"])
    view = ur.View((renderer.exact(truth) + _RANDOM.normal(0.0, NOISE, (*SHAPE, 3))).astype(np.float32))
    made = ur.Problem(renderer, [ur.Parameter(key, initial=0.5 * x) for key, x in truth.items()], [view])
    values = at_truth(made)
    found = check_numbers(made, values, made.initial_values(), FAR, ur.runs.sensitivity(made, values))
    assert set(found.errors) == {"a", "b"}
    assert not found.missing()


# ---------------------------------------------------------------------- pictures that do not fit


@pytest.mark.parametrize(("what", "fits"), [("ramp", False), ("noise", True)])
def test_few_numbers_whose_picture_does_not_fit_have_no_errors(what: str, fits: bool):
    """The decision is that of run folders, see test_final_images."""
    truth = {"wall": np.full(3, 0.5)}
    renderer = AnalyticRenderer(truth, np.random.default_rng(0).random((16 * 16 * 3, 3)), 0.1, 0.1, shape=(16, 16))
    reference = renderer.exact(truth)
    size = float(np.sqrt(np.mean(reference**2)))
    ramp = 0.03 * np.linspace(0, 2, 16)[:, None, None]
    added = ramp if what == "ramp" else 0.05 * np.random.default_rng(1).normal(size=reference.shape)
    view = ur.View((reference + size * added).astype(np.float32))
    made = ur.Problem(renderer, [ur.Parameter("wall", initial=0.4, bounds=(0, 1))], [view])
    found = ur.runs.uncertainty(made, {"wall": np.full(3, 0.5, np.float32)})
    assert bool(found.standard_error) is fits
    assert [line.startswith(DIFFERS) for line in found.missing] == [True] * (not fits)


@pytest.mark.parametrize(("offset", "fits"), [(0.5, False), (0.0, True)])
def test_a_run_without_a_folder_that_is_warned_of_its_picture_has_no_errors(offset: float, fits: bool):
    x, y = np.meshgrid(*[np.linspace(0, 1, 20)] * 2)
    blobs = [np.exp(-8 * ((x - a) ** 2 + (y - b) ** 2)).ravel() for a, b in ((0.2, 0.2), (0.8, 0.3), (0.4, 0.8))]
    matrix = np.kron(np.stack(blobs, axis=1), np.ones((3, 1))) + 0.02
    truth = {"x": np.array([0.4, 0.6, 0.8])}
    renderer = AnalyticRenderer(truth, matrix, noise=0.3, shape=(20, 20))
    reference = renderer.exact(truth) + offset * x[..., None] ** 4
    made = ur.Problem(renderer, [ur.Parameter("x", initial=np.full(3, 0.5))], [ur.View(reference)])
    result = ur.optimize(made, ur.GaussNewton(4, 4), ur.optimizers.AveragedNewton(), steps=40)
    assert (result.misfit is not None) is not fits
    assert bool(result.standard_error) is fits
