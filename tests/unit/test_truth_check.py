"""Warnings about parameters that end further from their truth: only where the pictures show it, and beyond noise."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import unrender as ur
from tests.analytic import AnalyticRenderer
from unrender.estimators.fresh_pictures import FreshPictures
from unrender.methods.rules.exchangeable import ambiguous_blends
from unrender.rendering.renderer import ParameterInfo
from unrender.runs.truth_check import exchanged, further_from_truth

SIDE, CELLS = 12, 8
START = 0.2


def made(noise_of_references: float = 0.0, other_light: float = 0.0) -> ur.Problem:
    """A texture of 8 x 8 cells, of which the pixels show the upper half; each pixel shows a cell, three channels alike.

    `other_light` is added to half of the reference, and taken from the other half.
    """
    generator = np.random.default_rng(0)
    cell = generator.integers(0, CELLS * CELLS // 2, SIDE * SIDE)
    matrix = np.repeat(np.eye(CELLS * CELLS)[cell], 3, axis=0)
    truth = generator.uniform(0.3, 0.7, (CELLS, CELLS, 1))
    renderer = AnalyticRenderer({"x": np.full((CELLS, CELLS, 1), 0.5)}, matrix, noise=0.02, shape=(SIDE, SIDE))
    reference = (matrix @ truth.ravel()).reshape(SIDE, SIDE, 3)
    reference = reference + noise_of_references * generator.normal(size=reference.shape)
    reference[: SIDE // 2] += other_light
    reference[SIDE // 2 :] -= other_light
    return ur.Problem(renderer, [ur.Parameter("x", initial=truth + START)], [ur.View(reference)], truth={"x": truth})


def lines(problem: ur.Problem, last: np.ndarray, first: np.ndarray | None = None, few: bool = False) -> list[str]:
    begin = problem.initial_values()["x"] if first is None else first
    pictures = FreshPictures(problem, 0, 0)
    return further_from_truth(problem, pictures, {"x": begin}, {"x": last.astype(np.float32)}, few, 1.0)


def changed(problem: ur.Problem, upper: float, lower: float) -> np.ndarray:
    values = np.array(problem.truth["x"], float)
    values[: CELLS // 2] += upper
    values[CELLS // 2 :] += lower
    return values


def test_cells_that_no_picture_shows_may_drift() -> None:
    problem = made()
    assert lines(problem, changed(problem, 0.1, 2.0)) == []


def test_a_texture_that_no_picture_shows_is_not_compared() -> None:
    """The mean over its visible cells, of which there are none, was a warning of NumPy's."""
    problem = made()
    problem.renderer.matrix = 0.0 * problem.renderer.matrix  # pyright: ignore[reportAttributeAccessIssue]
    assert lines(problem, changed(problem, 0.3, 2.0)) == []


@pytest.mark.parametrize("lower", [0.0, 2.0])
def test_cells_that_walk_away_are_told(lower: float) -> None:
    problem = made()
    (line,) = lines(problem, changed(problem, 0.3, lower))
    assert line.startswith("x ends further from the truth than it began where the pictures show it: error 0.3, 0.2 at")


def test_the_noise_of_the_references_is_no_walk() -> None:
    """A descent from beside the truth ends at what the noisy references say."""
    problem, noise = made(0.3), np.random.default_rng(1).normal(0, 0.1, (CELLS, CELLS, 1))
    near = changed(problem, 0.01, 0.01)
    assert lines(problem, problem.truth["x"] + noise, near) == []
    assert len(lines(made(), problem.truth["x"] + noise, near)) == 1
    assert len(lines(problem, changed(problem, 0.6, 0.0), near)) == 1


@pytest.mark.parametrize(("error", "count"), [(0.1, 0), (0.02, 1)])
def test_a_walk_within_the_standard_errors_is_noise(error: float, count: int) -> None:
    """A position of `box10` that began at the truth was said to walk away, 0.7 standard errors."""
    problem, noise = made(), np.random.default_rng(1).normal(0, 0.1, (CELLS, CELLS, 1))
    first, last = ({"x": x.astype(np.float32)} for x in (changed(problem, 0.01, 0.01), problem.truth["x"] + noise))
    errors = {"x": np.full((CELLS, CELLS, 1), error)}
    found = further_from_truth(problem, FreshPictures(problem, 0, 0), first, last, False, 1.0, errors)
    assert len(found) == count


class OfDirections(AnalyticRenderer):
    """Its parameters are directions."""

    def parameters(self) -> dict[str, ParameterInfo]:
        return {key: replace(info, role="direction") for key, info in super().parameters().items()}


@pytest.mark.parametrize(("error", "count"), [(0.1, 0), (0.02, 1)])
def test_the_standard_error_of_a_direction_is_an_angle(error: float, count: int) -> None:
    """Errors of the components by 0.1 turn a unit vector by about 8 degrees. The direction ends 10 degrees from the truth."""
    truth = np.full(3, 3.0**-0.5)
    renderer = OfDirections({"x": truth}, np.ones((SIDE * SIDE * 3, 3)), noise=0.02, shape=(SIDE, SIDE))
    problem = ur.Problem(renderer, [ur.Parameter("x")], [ur.View(renderer.exact({"x": truth}))], truth={"x": truth})
    across = np.array([1.0, -1.0, 0.0]) / 2.0**0.5
    first, last = ({"x": truth + np.tan(np.radians(angle)) * across} for angle in (1.0, 10.0))
    errors = {"x": np.full(3, error)}
    found = further_from_truth(problem, FreshPictures(problem, 0, 0), first, last, False, 1.0, errors)
    assert len(found) == count
    assert not count or "error 10°, 1° at the start" in found[0]


@pytest.mark.parametrize("seed", range(4))
def test_noise_that_channels_share_is_no_walk(seed: int) -> None:
    """Channels counted as independent, so grey noise had a limit that was too small by √3."""
    plain, truth = made(), made().truth["x"]
    renderer = plain.renderer
    assert isinstance(renderer, AnalyticRenderer)
    noise = 0.3 * np.random.default_rng(seed).normal(size=(SIDE, SIDE, 1))
    reference = np.asarray(plain.views[0].reference) + noise
    problem = ur.Problem(renderer, [ur.Parameter("x", initial=truth + START)], [ur.View(reference)], truth={"x": truth})
    values = np.linalg.lstsq(renderer.matrix, reference.ravel(), rcond=None)[0].reshape(truth.shape)
    values[CELLS // 2 :] = truth[CELLS // 2 :]
    values += 0.4 * (values - truth)  # 1.4 standard errors
    assert lines(problem, values, changed(problem, 0.01, 0.01)) == []


def test_a_wrong_model_is_no_noise() -> None:
    """The residual at the truth is then the model's error, which neighbouring pixels share."""
    walked = np.random.default_rng(1).normal(0, 0.1, (CELLS, CELLS, 1))
    problem = made(0.03, other_light=0.3)
    assert len(lines(problem, problem.truth["x"] + walked, changed(problem, 0.01, 0.01))) == 1


def test_few_steps_must_lead_further() -> None:
    problem = made()
    assert lines(problem, changed(problem, 0.25, 0.0), few=True) == []
    assert len(lines(problem, changed(problem, 0.4, 0.0), few=True)) == 1


@pytest.mark.parametrize(("steps", "told"), [(8, False), (64, True)])
def test_a_run_of_few_steps_with_a_better_picture_is_unfinished(steps: int, told: bool) -> None:
    """The picture shows x + y / 10 alone, so that y walks away while the picture gets better. After 64 steps it is still 38 % off: the
    status says so."""
    matrix = np.tile([[1.0, 0.1]], (SIDE * SIDE * 3, 1))
    renderer = AnalyticRenderer({"x": np.zeros(()), "y": np.zeros(())}, matrix, noise=0.1, shape=(SIDE, SIDE))
    truth = {"x": np.array(3.0), "y": np.array(-0.2)}
    reference = (matrix @ [3.0, -0.2]).reshape(SIDE, SIDE, 3)
    problem = ur.Problem(renderer, [ur.Parameter("x"), ur.Parameter("y")], [ur.View(reference)], truth=truth)
    result = ur.optimize(problem, ur.PathGradient(spp=4), ur.optimizers.Adam(0.03), steps=steps)
    assert result.status == ("does not fit" if told else "finished")
    assert [line.split()[0] for line in result.warnings if "further" in line] == (["y"] if told else [])


class OfLights(AnalyticRenderer):
    """Two lights with a position and an intensity each."""

    def parameters(self) -> dict[str, ParameterInfo]:
        infos = super().parameters()
        return {key: replace(info, brightness="light" if "intensity" in key else "") for key, info in infos.items()}


@pytest.mark.parametrize("light", [1.0, 2.0])
def test_equal_lights_in_each_others_place_have_the_errors_of_the_nearer_places(light: float) -> None:
    """They "end further from the truth than they began", though the picture is the same."""
    values = {f"{name}.position": np.full(3, at) for name, at in (("lamp", 1.0), ("fill", -1.0))}
    lights = {"lamp.intensity": np.ones(1), "fill.intensity": np.full(1, light)}
    renderer = OfLights({**values, **lights}, np.ones((SIDE * SIDE * 3, 8)), noise=0.02, shape=(SIDE, SIDE))
    view = ur.View(renderer.exact({**values, **lights}))
    problem = ur.Problem(renderer, [ur.Parameter(key) for key in values], [view], truth=values)
    last = {"lamp.position": np.full(3, -0.99, np.float32), "fill.position": np.full(3, 0.99, np.float32)}
    first = {key: (0.5 * x).astype(np.float32) for key, x in values.items()}
    found = further_from_truth(problem, FreshPictures(problem, 0, 0), first, last, False, 1.0)
    if light == 1.0:
        (line,) = found
        assert line.startswith(
            "lamp, fill ended in each other's place, where the pictures are the same: exchanged, the errors are "
        )
    else:
        assert not any("place" in line for line in found)


@pytest.mark.parametrize(
    ("eta", "most", "unknown", "told"),
    [(1.5, 1.0, 2, True), (1.6, 1.0, 2, False), (1.5, 0.4, 2, False), (1.5, 1.0, 1, False)],
)
def test_children_of_a_blend_in_each_others_place_are_named(eta: float, most: float, unknown: int, told: bool) -> None:
    """A run ended at (0.71, 0.4, 0.1) ± 0.02 instead of (0.3, 0.1, 0.4), and did not say that the pictures are equal."""
    keys = ["ball.bsdf.weight.value", *(f"ball.bsdf.bsdf_{child}.alpha.value" for child in (0, 1))]
    truth = dict(zip(keys, map(np.array, (0.3, 0.1, 0.4)), strict=True))
    fixed = {f"ball.bsdf.bsdf_{child}.eta.value": np.array(x) for child, x in ((0, 1.5), (1, eta))}
    renderer = AnalyticRenderer({**truth, **fixed}, np.ones((SIDE * SIDE * 3, 5)), noise=0.02, shape=(SIDE, SIDE))
    view = ur.View(renderer.exact({**truth, **fixed}))
    known = [ur.Parameter(key, initial=0.3, bounds=(0.0, most)) for key in keys[: unknown + 1]]
    problem = ur.Problem(renderer, known, [view], truth={key: truth[key] for key in keys[: unknown + 1]})
    assert [line.partition(":")[0] for line in ambiguous_blends(problem)] == (
        ["ball.bsdf.bsdf_0, ball.bsdf.bsdf_1"] if told else []
    )
    last = {key: np.array(x) for key, x in zip(keys, (0.71, 0.39, 0.11), strict=True) if key in problem.unknowns}
    values, said = exchanged(problem, last)
    expected = (0.29, 0.11, 0.39) if told else last.values()
    assert [float(x) for x in values.values()] == pytest.approx([float(x) for x in expected])
    assert len(said) == told
