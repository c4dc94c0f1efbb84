"""Final pictures: how long they take, what is said of their errors, and where the time of a run goes."""

from __future__ import annotations

import json
import math
import time
import tracemalloc
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import ANY

import drjit as dr
import numpy as np
import pytest
import scipy.ndimage

from tests.analytic import AnalyticRenderer
from tiers import quick, slow
from unrender import losses, optimizers
from unrender.core import phases
from unrender.estimators.fresh_pictures import Residuals
from unrender.estimators.path import PathGradient
from unrender.images.recursive_control_variate import RecursiveControlVariate
from unrender.rendering.picture_format import PictureFormat
from unrender.rendering.renderer import ParameterInfo
from unrender.runs import determination, final_checks, final_images, joint_maps, least_squares
from unrender.runs.callbacks import RUN_PHASES, Callback
from unrender.runs.image_sensitivity import Curvature, curvature
from unrender.runs.metadata import RunAnnotations
from unrender.runs.numbers import TOO_SHORT
from unrender.runs.optimize import optimize
from unrender.runs.reference_distortions import misplaced, unequal_brightness
from unrender.runs.result import Result
from unrender.runs.run import Run
from unrender.runs.verification import NOISE, PRIOR, SMOOTH, STEPS, STEPS_OF_FEW, Misfit, fit_status
from unrender.scene.parameter import Parameter
from unrender.scene.prior import Prior
from unrender.scene.problem import Problem
from unrender.scene.references import View

SHAPE = (16, 16)


def problem(noise: float = 0.3, views: int = 1) -> Problem:
    rng = np.random.default_rng(0)
    truth = {"wall": np.full(3, 0.5)}
    renderer = AnalyticRenderer(truth, rng.random((16 * 16 * 3, 3)), 0.1, noise, shape=SHAPE, sensors=views)
    given = [View(renderer.exact(truth), sensor=view) for view in range(views)]
    return Problem(renderer, [Parameter("wall", initial=0.4, bounds=(0, 1))], given, truth=truth)


def run(made: Problem, **options: object) -> Result:
    return optimize(made, PathGradient(), optimizers.Adam(0.02), 5, **options)  # pyright: ignore[reportArgumentType]


def test_the_error_of_a_picture_is_told_without_its_noise() -> None:
    made = problem(noise=20.0)
    values = {"wall": np.full(3, 0.45, np.float32)}
    result = Result(values, {"wall": np.full(3, 0.4, np.float32)}, [], 1.0, 0.0, "steps")
    found = final_images.render_final_images(made, result, 64)
    renderer = made.renderer
    assert isinstance(renderer, AnalyticRenderer)
    for which, point in (("initial", result.initial), ("result", values)):
        truth = float(np.sqrt(np.mean((renderer.exact(point) - made.views[0].reference) ** 2)))  # pyright: ignore[reportOperatorIssue]
        value, error = found.errors[f"view0/{which}"]
        with_noise = float(np.sqrt(np.mean((found.pictures[f"view0/{which}"] - made.views[0].reference) ** 2)))  # pyright: ignore[reportOperatorIssue]
        assert with_noise > 2 * truth  # what the headline used to say
        assert value <= truth + 4 * error
        assert value + 4 * error >= truth


@pytest.mark.parametrize(("what", "said"), [("ramp", True), ("noise", False), ("nothing", False)])
def test_few_numbers_whose_picture_does_not_fit_are_warned_of(what: str, said: bool) -> None:
    """A smooth difference is another minimum or a wrong model; noise of the references is neither. Errors of a misfit mean nothing."""
    made = problem(noise=0.1)
    renderer = made.renderer
    assert isinstance(renderer, AnalyticRenderer)
    truth = {"wall": np.full(3, 0.5, np.float32)}
    reference = np.asarray(renderer.exact(truth))
    size = float(np.sqrt(np.mean(reference**2)))
    added = {
        "ramp": 0.03 * size * np.linspace(0, 2, 16)[:, None, None],
        "noise": 0.05 * size * np.random.default_rng(1).normal(size=reference.shape),
        "nothing": 0.0,
    }
    made = Problem(renderer, [Parameter("wall", initial=0.4, bounds=(0, 1))], [View(reference + added[what])])
    result = Result(truth, {"wall": np.full(3, 0.4, np.float32)}, [{"step": 1, "loss": 0.1}], 1.0, 0.0, "steps")
    result = replace(result, standard_error={"wall": np.full(3, 0.01)})
    found = final_images.render_final_images(made, result, 64)
    assert (found.misfit is not None) == said
    assert bool(found.standard_error) == (not said)
    told = replace(result, misfit=Misfit(0.1, 1.0, 0.1))
    found = final_images.render_final_images(made, told, 64, tested=False)
    assert found.misfit is told.misfit
    assert not found.standard_error


def test_equal_views_have_independent_noise(monkeypatch: pytest.MonkeyPatch) -> None:
    """All views shared one set of random numbers, so the spread over seeds was 1.6 times the standard error."""
    made = problem(noise=3.0, views=4)
    before, after = ({"wall": np.full(3, value, np.float32)} for value in (0.5, 0.51))
    changes = []
    for seed in range(50):
        monkeypatch.setattr(determination, "_SEEDS", (1000 + 2 * seed, 1001 + 2 * seed))
        changes.append(determination.change_of_images(made, before, after, 8, None))
    spread, error = np.std([x.square for x in changes]), np.mean([x.error for x in changes])
    assert spread < 1.3 * error  # 3 standard errors of a spread of 50


def _without_scale(image: Any, reference: Any) -> Any:
    return dr.mean(dr.square(image / dr.mean(image, axis=None) - reference / dr.mean(reference, axis=None)), axis=None)


def test_pixels_do_not_judge_a_function_whose_minimum_is_elsewhere() -> None:
    """The loss is 0 at the end, and the pictures are half as bright as the references: they "differed by 50 %"."""
    made = problem(noise=0.1)
    renderer = made.renderer
    assert isinstance(renderer, AnalyticRenderer)
    truth = {"wall": np.full(3, 0.5, np.float32)}
    view = View(2.0 * np.asarray(renderer.exact(truth)))
    made = Problem(renderer, [Parameter("wall", initial=0.4, bounds=(0, 1))], [view], _without_scale)
    result = Result(truth, {"wall": np.full(3, 0.4, np.float32)}, [{"step": 1, "loss": 0.0}], 1.0, 0.0, "steps")
    assert final_images.render_final_images(made, result, 64).misfit is None


@pytest.mark.parametrize("outside", [0.0, 50.0])
def test_pixels_outside_the_mask_do_not_count_for_a_misfit(outside: float) -> None:
    made = problem(noise=0.1)
    renderer = made.renderer
    assert isinstance(renderer, AnalyticRenderer)
    truth = {"wall": np.full(3, 0.5, np.float32)}
    reference = np.asarray(renderer.exact(truth)) * (1 + 0.06 * np.linspace(0, 1, 16)[:, None, None])
    mask = np.ones(SHAPE)
    mask[:, 8:] = 0.0
    reference[:, 8:] = outside
    made = Problem(renderer, [Parameter("wall", initial=0.4, bounds=(0, 1))], [View(reference, mask=mask)])
    result = Result(truth, {"wall": np.full(3, 0.4, np.float32)}, [{"step": 1, "loss": 0.1}], 1.0, 0.0, "steps")
    found = final_images.render_final_images(made, result, 64, tested=False)
    assert found.misfit is not None


def test_black_references_make_no_error() -> None:
    made = problem(noise=0.1)
    black = Problem(made.renderer, [Parameter("wall", initial=0.4, bounds=(0, 1))], [View(np.zeros((*SHAPE, 3)))])
    values = {"wall": np.full(3, 0.5, np.float32)}
    result = Result(values, values, [{"step": 1, "loss": 0.1}], 1.0, 0.0, "steps")
    differs = final_images.render_final_images(black, result, 64, tested=False).misfit
    assert differs is not None
    assert "%" not in differs.line
    assert differs.record()["share"] is None


def test_one_sample_has_no_halves() -> None:
    made = problem()
    found = final_images.render_final_images(made, run(made), 1)
    assert found.errors == {}
    assert set(found.pictures) == {"view0/reference", "view0/initial", "view0/result"}


@pytest.mark.parametrize(("seconds", "views", "slow"), [(30.0, 1, 1.0), (30.0, 8, 1.0), (0.1, 8, 1.0), (0.1, 1, 2.5)])
def test_final_pictures_take_a_twentieth_of_the_time(
    seconds: float, views: int, slow: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Or a second of an idle machine, so that what they tell does not depend on other processes."""
    made, now, per_path, asked = problem(views=views), [0.0], 2e-5 * slow, []
    monkeypatch.setattr(final_images, "slowdown", lambda: slow)

    def render(problem, values, view, spp, seed=0, per_pass=None):
        del problem, values, seed, per_pass
        now[0] += spp * 256 * per_path + (20.0 if not asked else 0.0)  # the first time, kernels are compiled
        asked.append((view, spp))
        return np.zeros((*SHAPE, 3), np.float32)

    monkeypatch.setattr(final_images, "render", render)
    monkeypatch.setattr(final_images.timing, "now", lambda: now[0])
    values = {"wall": np.full(3, 0.4, np.float32)}
    found = final_images.render_final_images(made, Result(values, values, [], seconds, 0.0, "steps"))
    allowed = max(seconds / 20, slow)
    taken = 2 * views * found.spp * 256 * per_path
    assert found.spp & (found.spp - 1) == 0
    assert taken <= allowed or found.spp == 2 * final_images._pass_spp(made)
    assert 2 * taken > allowed or found.spp == 512
    assert {view for view, _ in asked} == set(range(views))


def test_a_machine_without_time_left_makes_the_least_pictures_and_tests_numbers_for_half_a_second(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A wrong number is told however late it is."""
    made, allowed = problem(), []
    monkeypatch.setattr(final_images, "slowdown", lambda: 1.0)
    monkeypatch.setattr(final_images, "misfit_of_views", lambda *_: None)
    none = Curvature()
    monkeypatch.setattr(final_images, "curvature", lambda *_, seconds, **__: allowed.append(seconds) or none)
    monkeypatch.setattr(
        final_images, "check_numbers", lambda *given: allowed.append(given[3]) or least_squares.NumbersCheck()
    )
    values = {"wall": np.full(3, 0.4, np.float32)}
    found = final_images.render_final_images(made, Result(values, values, [{}], 30.0, 0.0, "steps"), left=lambda: -1.0)
    assert found.spp == 2 * final_images._pass_spp(made)
    assert set(found.errors) == {"view0/initial", "view0/result"}
    assert not found.sensitivity
    assert sum(allowed) == pytest.approx(0.6)


@pytest.mark.parametrize("tested", [False, True])
def test_numbers_that_there_was_no_time_to_test_are_named(tested: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """A run that ends without its test of numbers says so; one that was tested does not."""
    made = problem()
    monkeypatch.setattr(final_images, "misfit_of_views", lambda *_: None)
    values = {"wall": np.full(3, 0.4, np.float32)}
    result = replace(Result(values, values, [{}], 30.0, 0.0, "steps"), standard_error={"wall": np.full(3, 1e-3)})
    line = "whether wall converged: the run is too short for this test; use more steps or seconds, or fewer pixels"
    if tested:
        assert line not in final_images.render_final_images(made, result).undetermined
        monkeypatch.setattr(final_images, "slowdown", lambda: 1e-9)
    late = final_images.render_final_images(made, result, left=lambda: 0.0, tested=tested)
    assert line in late.undetermined
    assert not late.standard_error  # what a run claims is checked first


@pytest.mark.parametrize(("error", "fits", "open_"), [(0.01, True, False), (0.1, True, True), (0.01, False, True)])
def test_a_factor_that_least_squares_know_is_not_open(error: float, fits: bool, open_: bool, monkeypatch: Any) -> None:
    """Light between surfaces showed a lamp's radiance to 1.4 %, beside a line that it was known up to a factor only."""
    made, values = problem(), {"wall": np.full(3, 0.4, np.float32)}
    line = "wall and wall: determined up to a common factor only"
    errors, zeros = {"wall": np.full(3, error)}, {"wall": np.zeros(3)}
    check = least_squares.NumbersCheck({}, {}, errors, zeros, zeros)
    for name, value in (("check_numbers", check), ("common_factor", [line])):
        monkeypatch.setattr(final_images, name, lambda *_, value=value: value)
    for name in ("_differs", "differs_still") if fits else ():
        monkeypatch.setattr(final_images, name, lambda *_: None)
    found = final_images.render_final_images(made, Result(values, values, [{}], 30.0, 0.0, "steps"))
    assert (line in found.undetermined) is open_


def test_numbers_of_a_picture_that_differs_have_no_standard_error(monkeypatch: pytest.MonkeyPatch) -> None:
    """In a wrong minimum, the references do not leave a number open by what least squares say."""
    made, values, errors = problem(), {"wall": np.full(3, 0.4, np.float32)}, {"wall": np.full(3, 1e-3)}
    check = least_squares.NumbersCheck({"wall": "the references leave it open"}, {"wall": "it moves"})
    monkeypatch.setattr(final_images, "check_numbers", lambda *_: check)
    result = replace(Result(values, values, [{}], 30.0, 0.0, "steps"), standard_error=errors)
    found = final_images.render_final_images(made, result)
    assert not found.standard_error
    assert not found.undetermined
    assert "it moves" in found.warnings
    assert found.misfit is not None
    assert "hence no standard errors" in found.misfit.line
    # A distortion of the references is named in one line.
    words = "as if the reference of view 0 were shifted"
    check = replace(check, undetermined={}, distorted=f"the pictures differ {words}")
    assert check.distorted in final_images.render_final_images(made, result).undetermined
    smooth = replace(check, distorted=f"the pictures differ by 2 % {SMOOTH}")
    monkeypatch.setattr(final_images, "check_numbers", lambda *_: smooth)
    assert not final_images.render_final_images(made, result).undetermined
    monkeypatch.setattr(final_images, "check_numbers", lambda *_: check)
    same = replace(found.misfit, explanation=f", {words}")
    monkeypatch.setattr(final_images, "misfit_of_views", lambda *_: same)
    assert not final_images.render_final_images(made, result).undetermined
    check = least_squares.NumbersCheck({"wall": "the references leave it open"})
    monkeypatch.setattr(final_images, "misfit_of_views", lambda *_: None)
    assert "the references leave it open" in final_images.render_final_images(made, result).undetermined


def test_a_line_about_an_unknown_leaves_one_whose_name_it_contains_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    """The line of "bigball" silenced those of "ball"."""
    of = {"ball": np.full(3, 0.5), "bigball": np.full(3, 0.5)}
    renderer = AnalyticRenderer(of, np.random.default_rng(0).random((16 * 16 * 3, 6)), 0.1, 0.1, shape=SHAPE)
    made = Problem(renderer, [Parameter(key) for key in of], [View(renderer.exact(of))])
    check = least_squares.NumbersCheck({"ball": "ball: open"}, {"ball": "ball: it moves"}, unchecked=("ball",))
    monkeypatch.setattr(final_images, "check_numbers", lambda *_: check)
    monkeypatch.setattr(final_images, "undetermined", lambda *_: ["bigball: the pictures do not show it"])
    result = Result(of, of, [{}], 30.0, 0.0, "steps")
    found = final_images.render_final_images(made, result)
    assert "ball: open" in found.undetermined
    assert "ball: it moves" in found.warnings


def test_run_json_says_where_the_time_went(tmp_path: Path) -> None:
    class Slow(Callback):
        def on_step(self, run: Run, record: dict[str, Any]) -> None:
            time.sleep(0.05)

    watch = phases.Stopwatch()
    annotations = RunAnnotations(phases={"loading": 1.5})
    with phases.listening(watch):
        started = time.perf_counter()
        result = run(problem(), run_directory=tmp_path / "run", annotations=annotations, callbacks=[Slow()])
        whole = time.perf_counter() - started
    record = json.loads((tmp_path / "run" / "run.json").read_text())
    assert list(record["phases"]) == ["loading", *RUN_PHASES]
    assert record["phases"]["steps"] == pytest.approx(result.seconds, abs=1e-3)
    own = sum(seconds for name, seconds in result.phases.items() if name != "loading")
    assert 5 * 0.05 < own <= whole
    assert list(watch.seconds) == ["compiling", "verification", "final pictures"]
    assert set(record["image_errors"]) == {"view0/initial", "view0/result"}
    assert all(len(pair) == 2 for pair in record["image_errors"].values())


def test_a_texture_without_a_map_has_the_reason_in_the_record(tmp_path: Path) -> None:
    """A volume has none, nor has what is not tested for lack of time."""
    truth = {"fog": np.full((1, 4, 4, 3), 0.5)}
    renderer = AnalyticRenderer(truth, np.random.default_rng(0).random((768, 48)), 0.0, 0.1, shape=SHAPE, sensors=1)
    made = Problem(renderer, [Parameter("fog", initial=0.4, bounds=(0, 1))], [View(renderer.exact(truth))])
    result = run(made, run_directory=tmp_path / "run")
    record = json.loads((tmp_path / "run" / "run.json").read_text())
    said = "fog: no map of standard errors: rays pass many voxels, so errors of voxels depend on each other; see ur.runs.sensitivity"
    assert record["without_errors"] == list(result.without_errors) == [said]
    late = final_images.render_final_images(made, result, tested=False)
    assert late.without_errors == (
        "fog: no map of standard errors: the end of the run was not tested, or had no time left",
    )
    assert late.undetermined == (f"whether the pictures show all of fog: {TOO_SHORT}",)
    assert not final_images.render_final_images(made, replace(result, history=[])).without_errors


@pytest.mark.parametrize(("width", "words"), [(0.0, ""), (2.0, "a checkerboard of 2 × 2 texels")])
def test_details_that_pictures_blur_are_told(
    width: float, words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A texture of a lamp that only diffuse surfaces reflect fitted the pictures, ended where it began, and had no line."""
    blurs = np.eye(256).reshape(256, 16, 16)
    blurs = scipy.ndimage.gaussian_filter(blurs, (0.0, width, width), mode="nearest") if width else blurs
    truth = {"map": np.random.default_rng(0).uniform(0.3, 0.7, (16, 16, 1))}
    renderer = AnalyticRenderer(truth, np.repeat(blurs.reshape(256, 256), 3, axis=0), 0.0, 0.1, shape=SHAPE, sensors=1)
    made = Problem(renderer, [Parameter("map", initial=0.5, bounds=(0, 1))], [View(renderer.exact(truth))])
    result = run(made, run_directory=tmp_path / "run")
    assert [line for line in result.undetermined if "checkerboard" in line] == [ANY] * bool(words)
    lines = joint_maps.blurred_cells(made, made.initial_values(), curvature(made), 64, math.inf, None)
    assert [words in line for line in lines] == [True] * bool(words)
    # Textures share the time: of four views that rendered for 2.5 seconds, a test had a tenth.
    change, samples = joint_maps.change_of_images, []
    monkeypatch.setattr(joint_maps, "change_of_images", lambda *of: samples.append(of[3]) or change(*of))
    joint_maps.blurred_cells(made, made.initial_values(), curvature(made), 64, 1.0, 2, 9.0, 1.0 / (4 * 256 * 16))
    assert set(samples) == ({8} if words else set())
    assert not joint_maps.blurred_cells(made, made.initial_values(), curvature(made), 64, 1.0, 2, -1.0)


def textured(shift: float, noise: float, count: int = 2) -> Problem:
    """Views of one texture of 32 elements, of which each reference shows it brighter than the one before by `shift`."""
    rng = np.random.default_rng(0)
    x, y = np.meshgrid(*[np.linspace(0, 1, 40)] * 2)
    blobs = [np.exp(-8 * ((x - a) ** 2 + (y - b) ** 2)).ravel() for a, b in rng.random((32, 2))]
    matrix = np.repeat(np.stack(blobs, axis=1), 3, axis=0)
    truth = {"map": rng.uniform(0.3, 0.7, 32)}
    renderer = AnalyticRenderer({"map": np.full(32, 0.5)}, matrix, noise=noise, shape=(40, 40), sensors=count)
    exact = renderer.exact(truth)
    given = [View(exact * (1.0 + shift * view), sensor=view) for view in range(count)]
    return Problem(renderer, [Parameter("map", initial=0.5, bounds=(0, 1))], given, truth=truth)


@pytest.mark.slow
@pytest.mark.parametrize(("shift", "told"), [(0.25, True), slow(0.0, False)])
def test_a_wrong_model_is_told_by_the_final_pictures_where_others_have_too_few_paths(
    shift: float, told: bool, tmp_path: Path
) -> None:
    made, steps = textured(shift, noise=1.5), 128
    estimator = PathGradient(image=RecursiveControlVariate(), spp=4)
    adam, pictures = optimizers.Adam(0.02), RunAnnotations(final_spp=256)
    result = optimize(made, estimator, adam, steps, run_directory=tmp_path, annotations=pictures)
    assert any("no longer improves" in line or UNCHANGED in line for line in result.warnings) is told, result.warnings
    assert result.status == ("does not fit" if told else "finished")
    stored = json.loads((tmp_path / "run.json").read_text())["misfit"]
    assert (result.misfit is not None) is bool(stored) is told
    if result.misfit:
        assert result.misfit.line in result.warnings
        assert stored == {"error": ANY, "share": pytest.approx(result.misfit.share, rel=1e-5), "causes": []}
        assert 0.05 < stored["share"] < 0.3
    alone = optimize(made, estimator, adam, steps)
    assert any("no longer improves" in line for line in alone.warnings) is told  # by the paths left for verification


@dataclass(frozen=True)
class OfFullViews(losses.L2):
    """As a perceptual loss, it needs full views."""

    @property
    def linear(self) -> bool:
        return False

    @property
    def pixelwise(self) -> bool:
        return False


@pytest.mark.parametrize("count", quick([2, 5], 2))
@pytest.mark.parametrize(("rate", "rises"), [(0.1, True), (0.003, False)])
def test_a_run_that_the_final_pictures_find_worse_returns_its_start(
    rate: float, rises: bool, count: int, tmp_path: Path
) -> None:
    """The pictures of the verification have too few paths to tell. Of five views for a loss of full views they show one."""
    made = textured(0.0, noise=0.6, count=count)
    made = made.replaced(loss=OfFullViews()) if count > 2 else made
    truth = np.linalg.lstsq(made.renderer.matrix, np.ravel(made.views[0].reference))[0].astype(np.float32)  # type: ignore
    made = made.replaced(parameters=[Parameter("map", initial=truth, bounds=(0, 1))])
    parts, pictures = (PathGradient(spp=4), optimizers.Adam(rate)), RunAnnotations(final_spp=512)
    alone = optimize(made, *parts, 32)
    assert alone.status == "finished"
    result = optimize(made, *parts, 32, run_directory=tmp_path, annotations=pictures)
    assert (result.status == "worse than start") is rises
    assert any("the final picture is worse than the initial one" in line for line in result.warnings) is rises
    assert np.array_equal(result.parameters["map"], result.initial["map"]) is rises
    assert result.image_errors["view0/result"][0] < 0.02


@pytest.mark.parametrize("shift", [0.25, 0.1])
@pytest.mark.parametrize(
    ("step", "change", "error", "stays"),
    [
        (64, 0.0, 1e-4, True),
        (64, -1.0, 1e-4, False),
        (64, 0.0, 1.0, False),
        (64, 1.0, 1.0, False),
        (32, 0.0, 1e-4, True),
    ],
)
def test_a_loss_that_falls_or_has_an_uncertain_change_is_judged_by_large_differences_alone(
    step: int, change: float, error: float, stays: bool, shift: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(final_images, "unexplained_pixels", lambda *_: None)
    made = textured(shift, 0.1)
    values = {"map": np.linalg.lstsq(made.renderer.matrix, np.ravel(made.views[0].reference))[0].astype(np.float32)}  # type: ignore
    result = Result(values, values, [{}] * 150, 1.0, 0.0, "steps")
    result = replace(result, verification={"best": "end", "change": {"step": step, "loss": [change, error]}})
    result = replace(result, standard_error={"map": np.full(32, 0.1)})
    found = final_images.render_final_images(made, result, 16, tested=False)
    differs = found.misfit
    assert bool(found.standard_error) is (differs is None or NOISE in differs.causes)
    assert (differs is not None) is (stays or shift == 0.25 or change >= 0.0)
    known = not (stays or shift == 0.25) and differs is not None
    assert (differs is not None and "in a pattern that noise lacks" in differs.line) is known
    assert (differs is not None and "may still improve" in differs.line) is (not stays and shift == 0.25)
    for other in (
        replace(result, misfit=Misfit(0.1, 1.0, 0.1)),
        replace(result, verification={"best": "start"}),
    ):
        assert final_images.render_final_images(made, other, 16, tested=False).misfit is None
    for change_of in ({}, {"change": {"step": step, "loss": [None, None]}}):  # no earlier image
        other = replace(result, verification={"best": "end", **change_of})
        differs = final_images.render_final_images(made, other, 16, tested=False).misfit
        assert (differs is not None and "may still improve" in differs.line) is (shift == 0.25)


@pytest.mark.parametrize("moved", [True, False])
def test_a_highlight_in_another_place_is_told_of_any_unknowns_and_outliers_of_the_reference_are_not(
    moved: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A moving mirror ended as finished, with a picture that was 73 % off, in a few pixels."""
    monkeypatch.setattr(final_images, "unexplained_pixels", lambda *_: None)
    made = textured(0.0, 0.1, count=1)
    reference = np.array(made.views[0].reference)
    if moved:  # too dark where the picture has it, too bright where the reference has it
        reference[10:16, 12:18] += np.random.default_rng(0).choice([-5.0, 5.0], (6, 6, 1))
    reference[[3, 25, 33], [30, 8, 22]] += 4.0
    values = {"map": np.linalg.lstsq(made.renderer.matrix, np.ravel(made.views[0].reference))[0].astype(np.float32)}  # type: ignore
    result = Result(values, values, [{}] * 150, 1.0, 0.0, "steps", verification={"best": "end"})
    differs = final_images.render_final_images(made.replaced(views=[View(reference)]), result, 16, tested=False).misfit
    assert (differs is not None and "the references may be noisy, or it may need more steps" in differs.line) is moved
    assert differs is None or {*differs.causes} == {"steps", "noise"}


UNCHANGED, WIDE = "of its pixels that the unknowns hardly change", 40
SPOT = np.exp(-((np.arange(WIDE)[:, None, None] - 20) ** 2 + (np.arange(WIDE)[:, None] - 30) ** 2) / 60.0)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda a, b: (a, b), ""),
        (lambda a, b: (a[:, ::-1], b[:, ::-1]), "as if the reference of views 0, 1 were mirrored left to right"),
        (lambda a, b: (a, np.rot90(b)), "as if the reference of view 1 were turned by 90° counterclockwise"),
        (
            lambda a, b: (b, a),
            "as if the reference of view 0 were that of view 1 and as if the reference of view 1 were that of view 0",
        ),
        (lambda a, b: (np.roll(a, 3, 1), np.zeros_like(b)), ""),
    ],
)
def test_references_that_are_turned_or_exchanged_are_named(change: Any, words: str) -> None:
    """The darker pictures of a run whose unknowns have made the best of them were said to differ, and no more."""
    random = np.random.default_rng(4)
    images = [scipy.ndimage.gaussian_filter(random.random((24, 24, 3)), (1.5, 1.5, 0.0)) for _ in range(2)]
    views = [SimpleNamespace(reference=np.ascontiguousarray(x), mask=None) for x in change(*images)]
    ends = [[0.3 * x + 0.1 + random.normal(0.0, 0.01, x.shape) for _ in range(2)] for x in images]
    ends[1][0][5, 5] = np.nan
    for known, expected in ((ParameterInfo((), brightness="reflectance"), words), (ParameterInfo((), rigid=True), "")):
        made = SimpleNamespace(
            renderer=SimpleNamespace(parameters=lambda known=known: {"a": known}), unknowns={"a": None}, views=views,
            test_weights=lambda view, of: np.ones((24, 24)),
        )  # fmt: skip
        fitted = [[0.95 * view.reference + 0.05 * of[1] for _ in of] for view, of in zip(views, ends, strict=True)]
        assert misplaced(made, (0, 1), ends, ends) == expected  # type: ignore[arg-type]
        assert not misplaced(made, (0, 1), ends, fitted)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("factors", "shift", "words"),
    [
        ((1.0, 1.5, 1.2), 0, "as if the reference of view 1 were 1.5 times as bright as that of view 0"),
        ((0.9, 1.0, 0.5), 0, "as if the reference of view 1 were 2 times as bright as that of view 2"),
        ((1.0, 1.1, 1.0), 0, "as if the reference of view 1 were 1.1 times as bright as that of view 0"),
        ((1.0, 1.02, 1.0), 0, ""),
        ((1.3, 1.3, 1.3), 0, ""),
        ((1.0, 1.3, 1.0), 6, ""),
        ((1.0, 0.0, 1.0), 0, ""),
    ],
)
def test_references_of_unequal_brightness_are_named(factors: tuple[float, ...], shift: int, words: str) -> None:
    """Exposures that differ were said to be wrong light or depth."""
    random = np.random.default_rng(4)
    images = [0.2 + scipy.ndimage.gaussian_filter(random.random((24, 24, 3)), (1.5, 1.5, 0.0)) for _ in factors]
    for image in images:
        image[:, :8] *= 4.0
    references = [factor * np.roll(x, shift, 1) for factor, x in zip(factors, images, strict=True)]
    ends = [[1.1 * x + random.normal(0.0, 0.02, x.shape) for _ in range(2)] for x in images]
    ends[1][0][5, 5] = np.nan
    made: Any = SimpleNamespace(
        renderer=SimpleNamespace(formats=lambda: formats),
        views=[SimpleNamespace(reference=x, sensor=sensor) for sensor, x in enumerate(references)],
        test_weights=lambda *of: np.ones((24, 24)),
    )
    formats = [PictureFormat() for _ in factors]
    assert unequal_brightness(made, range(len(factors)), ends) == words
    assert not unequal_brightness(made, range(len(factors)), [[of[0]] for of in ends])
    formats[1:] = [PictureFormat(aov="depth") for _ in formats[1:]]
    assert not unequal_brightness(made, range(len(factors)), ends)


def misplaced_among(references: list[np.ndarray], images: list[np.ndarray], weights: np.ndarray) -> str:
    made: Any = SimpleNamespace(
        renderer=SimpleNamespace(parameters=lambda: {"a": ParameterInfo((), brightness="reflectance")}),
        unknowns={"a": None}, views=[SimpleNamespace(reference=x) for x in references], test_weights=lambda *of: weights,
    )  # fmt: skip
    pictures = [[x, x] for x in images]
    return misplaced(made, range(len(images)), pictures, pictures)


@pytest.mark.parametrize("mirrored", [False, True])
def test_references_are_not_said_to_be_mirrored_by_unfinished_runs(
    mirrored: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two lamps, left and right, whose starts are nearly each other's values: after five right steps it said so. One lamp and a mirrored
    reference, after 40 steps."""
    left = np.exp(-np.linspace(0.0, 3.0, 24))[None, :, None] * np.ones((24, 1, 3))
    start, end, lamps = ([0.8], [1.0], [left]) if mirrored else ([1.0, 0.2], [0.2, 1.0], [left, left[:, ::-1]])
    matrix, truth = np.stack([x.ravel() for x in lamps], axis=1), {"lamps": np.array(end)}
    renderer = AnalyticRenderer(truth, matrix, 0.1, 0.05, shape=(24, 24))
    infos = {key: replace(info, brightness="light") for key, info in renderer.parameters().items()}
    monkeypatch.setattr(renderer, "parameters", lambda: infos)
    reference = renderer.exact(truth)[:, :: -1 if mirrored else 1]
    made = Problem(renderer, [Parameter("lamps", initial=np.array(start))], [View(np.ascontiguousarray(reference))])
    given = {"steps": 40 if mirrored else 5, "run_directory": tmp_path / "run", "progress": False}
    found = optimize(made, PathGradient(spp=2), optimizers.Adam(0.02), **given)
    lines = [line for line in (*found.warnings, *found.undetermined) if "were mirrored left to right" in line]
    assert bool(lines) is mirrored


@pytest.mark.parametrize(("side", "shown"), [(3, 3), (24, 3), (192, 9), (8, 8)])
def test_noise_of_few_pixels_looks_like_no_other_reference(side: int, shown: int) -> None:
    """A converged run of a plain wall in 3 x 3 pixels was said to look as if its reference were upside down."""
    random, weights = np.random.default_rng(5), np.zeros((side, side))
    weights[:shown, :shown] = 1.0
    for _ in range(40):
        one, other = 0.5 + 0.01 * random.normal(size=(2, side, side, 1)) * np.ones(3)
        assert not misplaced_among([one], [other], weights)


def test_references_of_many_views_are_not_copied_at_once() -> None:
    """They took three times the memory of all references for a moment."""
    pictures = list(np.random.default_rng(6).random((40, 128, 128, 3), np.float32))
    tracemalloc.start()
    assert not misplaced_among(pictures, pictures, np.ones((128, 128)))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 0.5 * sum(x.nbytes for x in pictures)


def half_textured(reference: np.ndarray | None = None, start: float = 0.5) -> Problem:
    """A texture of 5 x 10 elements in the left half of the picture, which also lights the right half a little; a pattern there."""
    y, x = np.mgrid[:WIDE, :WIDE]
    element, left = (y // 4) * 5 + np.minimum(x // 4, 4), x < WIDE // 2
    matrix = (element[..., None] == np.arange(50)) * left[..., None] + 0.2 / 50 * ~left[..., None]
    matrix = np.repeat(matrix.reshape(-1, 1, 50), 3, axis=1).reshape(-1, 50)
    pattern = np.where(left, 0.0, 0.3 + 0.3 * (((x // 5) + (y // 7)) % 2))[..., None] * np.array([1.0, 0.8, 0.6])
    renderer = AnalyticRenderer({"map": np.full(50, 0.5)}, matrix, pattern, noise=0.3, grain=0.1, shape=(WIDE, WIDE))
    exact = renderer.exact({"map": np.random.default_rng(0).uniform(0.1, 0.9, 50)}) if reference is None else reference
    return Problem(renderer, [Parameter("map", initial=start, bounds=(0, 1))], [View(exact)])


def told_of(made: Problem, values: np.ndarray) -> str:
    """The line of a run that ended at these values."""
    result = Result({"map": values}, made.initial_values(), [{}] * 20, 1.0, 0.0, "steps", verification={"best": "end"})
    differs = final_images.render_final_images(made, result, 64, tested=False).misfit
    return differs.line if differs and UNCHANGED in differs.line else ""


@pytest.mark.parametrize(
    ("distort", "words"),
    [
        (lambda image: np.roll(image, 1, axis=1), "were shifted by"),
        (lambda image: (image + np.roll(image, 1, axis=1) + np.roll(image, -1, axis=1)) / 3.0, "were blurred"),
        (
            lambda image: image - 0.25 * (np.roll(image, 1, axis=1) + np.roll(image, -1, axis=1) - 2.0 * image),
            "were sharper",
        ),
        (lambda image: 0.8 * image, "times as bright"),
        (lambda image: np.minimum(image, 0.45), "were saturated at 0.45"),
        (lambda image: image * (1.0 - 0.3 * SPOT), ""),
        (lambda image: image + 0.05 * np.random.default_rng(0).standard_normal(image.shape), None),
        (lambda image: image, None),
    ],
    ids=["shifted", "blurred", "sharper", "darker", "saturated", "unlit spot", "noisy", "right"],
)
@pytest.mark.parametrize("progress", [0.2, 0.7, 1.0])
def test_pixels_that_the_unknowns_hardly_change_tell_of_wrong_references_at_any_progress(
    distort: Any, words: str | None, progress: float
) -> None:
    """The texture is where a run may be after few steps: the rest of the way is no fault of the references."""
    truth = np.random.default_rng(0).uniform(0.1, 0.9, 50).astype(np.float32)
    exact = np.asarray(half_textured().views[0].reference)
    line = told_of(half_textured(distort(exact)), 0.5 + progress * (truth - 0.5))
    assert bool(line) is (words is not None), line
    assert (words or "") in line
    assert ("as if" in line) is bool(words)
    if words == "were shifted by":
        along, down = (
            float(x.split(" pixels")[0])
            for x in line.split("shifted by ")[1].split(" along y")[0].split(" along x and ")
        )
        assert abs(along - 1.0) < 0.3
        assert abs(down) < 0.1


@pytest.mark.parametrize("clipped", [False, True])
def test_a_few_bright_pixels_are_no_saturated_reference(clipped: bool) -> None:
    """Rare bright samples of three pixels are missing in a reference of few samples; a saturated one has many equal largest values."""
    rng = np.random.default_rng(0)
    exact = rng.uniform(0.2, 0.58, (1, WIDE * WIDE, 3))
    exact[0, [100, 700, 1300]] = 1.0
    exact[0, :60] = 1.0 if clipped else exact[0, :60]
    images = exact + 0.01 * rng.standard_normal((4, *exact.shape[1:]))
    reference = np.minimum(exact[0], 0.6) - (0.0 if clipped else 0.02 * rng.random(exact.shape[1:]))
    residuals = Residuals(images - reference, reference, np.ones(WIDE * WIDE), [(WIDE, WIDE)])
    cause, _, _ = final_checks._as_if(residuals, images[1::2].mean(axis=0))
    assert cause.endswith("were saturated at 0.6 (set the loss Censored)") if clipped else "saturated" not in cause


@pytest.mark.parametrize("shift", [0.0, 0.2])
def test_noise_of_one_bright_pixel_of_a_reference_is_no_shift(shift: float) -> None:
    """A lamp's edge pixel decided the fit alone, so the residual there hid its noise, and right references of a chalice were blamed."""
    rng = np.random.default_rng(0)
    image = rng.uniform(0.2, 0.6, (WIDE, WIDE, 3))
    image[20, 20] = 25.0
    images = image.reshape(1, -1, 3) + 1e-3 * rng.standard_normal((4, WIDE * WIDE, 3))
    reference = image + shift * np.gradient(image, axis=1)
    reference[20, 21] += 0.4  # noise of the pixel beside it, of which a lamp covers a part
    weights = np.ones((WIDE, WIDE))
    weights[19:22, 19:21] = weights[[19, 21], 21] = 0.0
    residuals = Residuals(images - reference.reshape(-1, 3), reference.reshape(-1, 3), weights.ravel(), [(WIDE, WIDE)])
    _, shared, sure = final_checks._as_if(residuals, images[1::2].mean(axis=0))
    assert (shared > 0.0 and sure) is bool(shift)


@pytest.mark.parametrize("shift", [0, 1])
@pytest.mark.parametrize("progress", [0.2, 0.7, 1.0])
def test_a_dark_background_tells_of_a_misplaced_object(shift: int, progress: float) -> None:
    """The texture is on all of a disc, whose silhouette it does not explain."""
    y, x = np.mgrid[:WIDE, :WIDE]
    disc = (x - 19.5) ** 2 + (y - 19.5) ** 2 < 14.5**2
    matrix = ((y // 4 * 10 + x // 4)[..., None] == np.arange(100)) * disc[..., None]
    matrix = np.repeat(matrix.reshape(-1, 1, 100), 3, axis=1).reshape(-1, 100)
    truth = np.random.default_rng(0).uniform(0.1, 0.9, 100).astype(np.float32)
    renderer = AnalyticRenderer({"map": truth}, matrix, 0.0, noise=0.1, shape=(WIDE, WIDE))
    reference = np.roll(renderer.exact({"map": truth}), shift, axis=1)
    made = Problem(renderer, [Parameter("map", initial=0.5, bounds=(0, 1))], [View(reference)])
    assert bool(told_of(made, 0.5 + progress * (truth - 0.5))) is bool(shift)


@pytest.mark.parametrize("column", [3, WIDE - 4])
def test_a_pixel_that_is_not_finite_leaves_the_others_judged(column: int, monkeypatch: pytest.MonkeyPatch) -> None:
    own = final_images.render

    def render(*given: Any, **options: Any) -> np.ndarray:
        image = np.array(own(*given, **options))
        image[7, column, 1] = np.nan
        return image

    monkeypatch.setattr(final_images, "render", render)
    truth = np.random.default_rng(0).uniform(0.1, 0.9, 50).astype(np.float32)
    exact = np.asarray(half_textured().views[0].reference)
    assert "times as bright" in told_of(half_textured(0.8 * exact), truth)
    assert not told_of(half_textured(exact), truth)


def without_gradient(*given: Any) -> bool:
    """Return whether a run of a map that is not differentiable is told that its picture is hardly closer to the references."""
    return any("hardly closer to the references" in line for line in lines_without_gradient(*given))


def lines_without_gradient(
    made: Problem, start: np.ndarray, end: np.ndarray, monkeypatch: pytest.MonkeyPatch, **options: Any
) -> Sequence[str]:
    """Return what a run of a map that is not differentiable is told of undetermined unknowns."""
    monkeypatch.setattr(final_images, "curvature", lambda *_, **__: Curvature())
    monkeypatch.setattr(final_images, "map_keys", lambda problem: list(problem.unknowns))
    initial = {"map": start.astype(np.float32)}
    result = Result({"map": end}, initial, [{}] * 20, 1.0, 0.0, "steps", verification={"best": "end"})
    return final_images.render_final_images(made, result, 64, **options).undetermined


def patterned() -> Problem:
    """A texture of 10 x 10 elements, which make some pixels brighter and others darker, as glass before a pattern."""
    y, x = np.mgrid[:WIDE, :WIDE]
    matrix = ((y // 4 * 10 + x // 4)[..., None] == np.arange(100)) * np.random.default_rng(1).choice(
        [-1.0, 1.0], (WIDE, WIDE, 1)
    )
    matrix = np.repeat(matrix.reshape(-1, 1, 100), 3, axis=1).reshape(-1, 100)
    renderer = AnalyticRenderer({"map": np.full(100, 0.5)}, matrix, 1.0, noise=0.3, shape=(WIDE, WIDE))
    exact = renderer.exact({"map": np.random.default_rng(0).uniform(0.1, 0.9, 100)})
    return Problem(renderer, [Parameter("map", initial=0.5, bounds=(0, 1))], [View(exact)])


@pytest.mark.parametrize(
    ("progress", "noise", "told"),
    [(0.4, 0.0, "% closer to the references"), (1.0, 0.01, ""), (1.0, 1.0, "noise hides its cause")],
)
def test_vertices_without_a_path_gradient_need_most_of_the_difference(
    progress: float, noise: float, told: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Those behind glass ended where they began with half of the difference left, in silence."""
    monkeypatch.setattr(Problem, "faces", {"map": np.zeros((1, 3), np.int64)})
    truth, exact = np.random.default_rng(0).uniform(0.1, 0.9, 50), np.asarray(half_textured().views[0].reference)
    made = half_textured(exact + np.float32(noise) * np.random.default_rng(1).standard_normal(exact.shape).astype("f4"))
    end = (0.5 + progress * (truth - 0.5)).astype(np.float32)
    lines = lines_without_gradient(made, np.full(50, 0.5), end, monkeypatch)
    assert [told in line for line in {*lines}] == ([True] if told else [])


@pytest.mark.parametrize(("of", "size"), [(half_textured, 50), (patterned, 100)])
@pytest.mark.parametrize(("progress", "told"), [(0.0, True), (0.05, True), (0.9, False)])
def test_a_map_without_a_path_gradient_that_has_explained_little_is_told(
    progress: float, told: bool, of: Callable[[], Problem], size: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    truth = np.random.default_rng(0).uniform(0.1, 0.9, size)
    end = (0.5 + progress * (truth - 0.5)).astype(np.float32)
    assert without_gradient(of(), np.full(size, 0.5), end, monkeypatch) is told


@pytest.mark.parametrize("shift", [0.0, 0.002])
def test_a_map_without_a_path_gradient_that_begins_at_its_solution_has_nothing_to_explain(
    shift: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As in the second stage of a run, or in a run from an earlier result."""
    truth = np.random.default_rng(0).uniform(0.1, 0.9, 50)
    assert not without_gradient(half_textured(), truth + shift, (truth + shift / 2).astype(np.float32), monkeypatch)


@pytest.mark.parametrize("filtered", [False, True])
@pytest.mark.parametrize(("of", "size"), [(half_textured, 50), (patterned, 100)])
@pytest.mark.parametrize(
    ("start", "end", "told"), [(1.0, 1.0, False), (1.0, 0.98, False), (0.0, 0.98, False), (0.0, 0.0, True)]
)
def test_noise_of_the_references_is_not_for_a_map_to_explain(
    filtered: bool,
    start: float,
    end: float,
    told: bool,
    of: Callable[[], Problem],
    size: int,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A map that began at its solution, or has reached it beside much noise, counted as hardly determined. It may also not have moved
    towards a solution that noise hides: the roughness of a sheet of glass ended further from the truth than it began, in silence."""
    truth, exact = np.random.default_rng(0).uniform(0.1, 0.9, size), np.asarray(of().views[0].reference)
    noise = (0.2 if told else 0.6) * np.random.default_rng(7).standard_normal(exact.shape)
    if filtered:  # as by a Gaussian filter of the film
        noise = 3.0 * scipy.ndimage.gaussian_filter(noise, (0.5, 0.5, 0.0))
    made = of().replaced(views=[View(exact + noise)])
    values = [(0.5 + progress * (truth - 0.5)).astype(np.float32) for progress in (start, end)]
    lines = lines_without_gradient(made, values[0], values[1], monkeypatch)
    assert any("hardly closer to the references" in line for line in lines) is told
    assert any("noise hides its cause" in line for line in lines) is not told


@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize(("progress", "told"), [(0.0, True), (0.9, False), (1.0, False)])
def test_highlights_do_not_hide_that_a_map_without_a_path_gradient_has_explained_nothing_else(
    progress: float, told: bool, masked: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A blend's weight before a mirror that shows a lamp: the lamp's pixels held a third of the fall, all others were as at the start.

    With a mask of fewer pixels than a twentieth of the picture, none were left without the brightest ones."""
    count = 4 if masked else 32
    own, shown = final_images.render, (np.arange(count) % 8 * 4 + 4, 24 + np.arange(count) // 8 * 4)
    mask = np.full((WIDE, WIDE), 0.0 if masked else 1.0, np.float32)
    mask[shown] = mask[8:12, :18] = 1.0

    def render(made: Problem, values: Mapping[str, np.ndarray], view: int, spp: int, seed: int, **options: Any) -> Any:
        image = np.array(own(made, values, view, spp, seed, **options))
        image[shown] += 20.0 * values["map"][0] + np.random.default_rng(seed).standard_normal((count, 1))
        return image

    monkeypatch.setattr(final_images, "render", render)
    truth, exact = np.random.default_rng(0).uniform(0.1, 0.9, 50), np.array(half_textured().views[0].reference)
    exact[shown] += 20.0 * truth[0]
    end = 0.5 + progress * (truth - 0.5)
    end[0] = 0.5 + max(progress, 0.4) * (truth[0] - 0.5)
    made = half_textured().replaced(views=[View(exact, mask=mask)])
    lines = lines_without_gradient(made, np.full(50, 0.5), end.astype(np.float32), monkeypatch)
    assert any("with its initial values, but for its brightest pixels: " in line for line in lines) is told


def test_a_map_without_a_path_gradient_that_there_is_no_time_to_test_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    """A blend's weight that ended at its start counted as finished without a word after 40 steps."""
    line = "whether the pictures determine map: the run is too short for this test"
    flat = np.full(50, 0.5, np.float32)
    for left, told in ((0.0, True), (math.inf, False)):
        of = lines_without_gradient(half_textured(), flat, flat, monkeypatch, left=lambda left=left: left)
        assert any(line in each for each in of) is told


@pytest.mark.mitsuba
def test_a_map_without_a_path_gradient_whose_loss_takes_no_reference_is_not_compared_with_one(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    import drjit as dr

    made = half_textured().replaced(loss=lambda image: dr.mean(image, axis=None))
    for left in (0.0, math.inf):  # more time would not test it either
        flat = np.full(50, 0.5, np.float32)
        assert not lines_without_gradient(made, flat, flat, monkeypatch, left=lambda left=left: left)


def test_pixels_that_the_unknowns_hardly_change_may_be_of_a_single_row() -> None:
    """Slopes along a side of one pixel ended the run by an exception."""
    renderer = half_textured().renderer
    assert isinstance(renderer, AnalyticRenderer)
    truth = np.random.default_rng(0).uniform(0.1, 0.9, 50).astype(np.float32)
    parts = renderer.matrix, renderer.offset.reshape(1, -1, 3)
    renderer = AnalyticRenderer({"map": truth}, *parts, noise=0.3, grain=0.1, shape=(1, WIDE**2))
    view = View(0.8 * renderer.exact({"map": truth}))
    assert told_of(Problem(renderer, [Parameter("map", initial=0.5, bounds=(0, 1))], [view]), truth)


@pytest.mark.parametrize("count", [4, 10])
@pytest.mark.parametrize("darker", [0.0, 0.2])
def test_pixels_that_many_unknowns_hardly_change_tell_of_wrong_references(count: int, darker: float) -> None:
    """Such as the colours of ten objects."""
    made, parts = half_textured(), np.array_split(np.random.default_rng(0).uniform(0.1, 0.9, 50), count)
    renderer, values = made.renderer, {f"colour{index}": x.astype(np.float32) for index, x in enumerate(parts)}
    assert isinstance(renderer, AnalyticRenderer)
    pattern = renderer.offset.reshape(WIDE, WIDE, 3)
    renderer = AnalyticRenderer(values, renderer.matrix, pattern, noise=0.3, grain=0.1, shape=(WIDE, WIDE))
    view = View((1.0 - darker) * renderer.exact(values))
    made = Problem(renderer, [Parameter(key, initial=0.5, bounds=(0, 1)) for key in values], [view])
    result = Result(values, made.initial_values(), [{}] * 20, 1.0, 0.0, "steps", verification={"best": "end"})
    differs = final_images.render_final_images(made, result, 64, tested=False).misfit
    assert (differs is not None and UNCHANGED in differs.line) is (darker > 0.0)


@pytest.mark.parametrize("rigid", [False, True])
@pytest.mark.parametrize(("wrong", "told"), [("darker", True), ("object", False), ("", False)])
def test_beside_a_pose_a_difference_of_a_few_blocks_may_be_the_object(
    wrong: str, told: bool, rigid: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    exact = np.asarray(half_textured().views[0].reference)
    reference = 0.8 * exact if wrong == "darker" else exact.copy()
    if wrong == "object":
        reference[10:18, 26:32] += 0.3
    made = half_textured(reference)
    known = {key: replace(info, rigid=rigid) for key, info in made.renderer.parameters().items()}
    monkeypatch.setattr(AnalyticRenderer, "parameters", lambda _: known)
    truth = np.random.default_rng(0).uniform(0.1, 0.9, 50).astype(np.float32)
    assert bool(told_of(made, truth)) is (told or (wrong == "object" and not rigid))


def test_pixels_of_several_elements_each_are_not_taken_for_unchanged_ones() -> None:
    """Of four grey elements a pixel, random changes cancel in a third of the pixels."""
    y, x = np.mgrid[:24, :24]
    matrix = sum(
        (2 * y + i)[..., None] * 48 + (2 * x + j)[..., None] == np.arange(48**2) for i in (0, 1) for j in (0, 1)
    )
    matrix = np.repeat(matrix.reshape(-1, 1, 48**2) / 4.0, 3, axis=1).reshape(-1, 48**2)  # pyright: ignore[reportAttributeAccessIssue]
    rng = np.random.default_rng(0)
    truth = (0.5 + 0.3 * np.sin(np.arange(48) / 5.0) * np.sin(np.arange(48) / 4.0)[:, None]).ravel()
    renderer = AnalyticRenderer({"map": truth}, matrix, 0.1, noise=0.1, grain=0.1, shape=(24, 24))
    made = Problem(renderer, [Parameter("map", initial=0.5, bounds=(0, 1))], [View(renderer.exact({"map": truth}))])
    assert not told_of(made, (0.5 + rng.uniform(0.0, 0.4, 48**2) * (truth - 0.5)).astype(np.float32))


@pytest.mark.parametrize("rigid", [False, True])
def test_a_large_object_whose_pose_is_not_found_is_no_proof_of_wrong_references(
    rigid: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It may belong in more blocks than are left out. A difference that the run has found before says more."""
    reference = np.array(half_textured().views[0].reference)
    reference[:32, 20:] += 0.3
    made = half_textured(reference)
    known = {key: replace(info, rigid=rigid) for key, info in made.renderer.parameters().items()}
    monkeypatch.setattr(AnalyticRenderer, "parameters", lambda _: known)
    truth = np.random.default_rng(0).uniform(0.1, 0.9, 50).astype(np.float32)
    result = Result({"map": truth}, made.initial_values(), [{}] * 20, 1.0, 0.0, "steps", verification={"best": "end"})
    differs = final_images.render_final_images(made, result, 64, tested=False).misfit
    assert differs is not None
    assert UNCHANGED in differs.line
    assert ("the pose needs more steps" in differs.line) is rigid
    assert fit_status(made, "finished", differs, few=False) == ("finished" if rigid else "does not fit")
    before = replace(differs, explanation=", and may still improve")
    result = replace(result, misfit=before, warnings=[before.line])
    assert final_checks.with_misfit(result, differs).warnings == [before.line if rigid else differs.line]


@pytest.mark.parametrize(("shift", "std", "is_cause"), [(0.5, 0.2, False), (0.0, 1e-3, True)])
def test_a_prior_is_the_cause_of_a_difference_only_where_it_pulls(shift: float, std: float, is_cause: bool) -> None:
    """Two references that contradict each other, and a prior that holds the values far from right ones."""
    made = textured(shift, 0.1)
    matrix = np.asarray(made.renderer.matrix)  # type: ignore[attr-defined]
    means = np.mean([np.ravel(np.asarray(view.reference)) for view in made.views], axis=0)
    pull = matrix.T @ (means - matrix @ np.full(32, 0.45))
    held = 0.45 + 0.01 * pull / np.abs(pull).max()
    values = {"map": np.asarray(held if is_cause else np.linalg.lstsq(matrix, means)[0], np.float32)}
    prior = Prior(near=0.45, std=std)
    made = Problem(made.renderer, [Parameter("map", initial=0.5, bounds=(0, 1), prior=prior)], made.views)
    result = Result(values, made.initial_values(), [{}] * 150, 1.0, 0.0, "steps")
    change = {"step": 64, "loss": [0.0, 1e-4]}
    result = replace(result, verification={"best": "end", "change": change})
    differs = final_images.render_final_images(made, result, 16, tested=False).misfit
    assert differs is not None
    assert (PRIOR in differs.causes) is ("prior" in differs.line) is is_cause
    assert fit_status(made, "finished", replace(differs, size=1e-9), few=False) == (
        "finished" if is_cause else "does not fit"
    )


@pytest.mark.parametrize(
    ("causes", "stays"), [((PRIOR,), False), ((PRIOR, STEPS_OF_FEW), False), ((PRIOR, STEPS), True)]
)
def test_a_prior_stays_a_cause_while_the_loss_may_still_fall(causes: tuple[str, ...], stays: bool) -> None:
    """What holds a run back is not known before it ends, so a step against the pull explains too little of the difference."""
    made = textured(0.5, 0.1)
    values = {"map": np.full(32, 0.45, np.float32)}
    made = made.replaced(parameters=[Parameter("map", initial=0.5, bounds=(0, 1), prior=Prior(near=0.45, std=0.2))])
    rng, ends = np.random.default_rng(0), []
    for view in made.views:
        reference = np.asarray(view.reference)
        ends.append([reference + 0.3 + 0.01 * rng.standard_normal(reference.shape) for _ in range(2)])
    difference = Misfit(0.3, 1.0, 0.0, causes=causes)
    left = final_checks.beyond_priors(made, difference, values, ends, lambda _, view: ends[view][0])
    assert (PRIOR in left.causes) is stays


@pytest.mark.parametrize("count", [1, 4])
@pytest.mark.parametrize(("budget", "spp", "checked"), [(1e9, None, True), (1.0, None, True), (0.15, 64, False)])
def test_the_check_of_unchanged_pixels_fits_into_the_time_that_is_left(
    budget: float, spp: int | None, checked: bool, count: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By a clock that counts a millisecond for each sample per pixel. Samples that the caller gives may leave too little time for it."""
    values = {f"map{index}": np.full(3, 0.5, np.float32) for index in range(count)}
    matrix = np.random.default_rng(0).random((768, 3 * count))
    matrix[384:] = 0.0
    renderer = AnalyticRenderer(values, matrix, 0.1, noise=0.3, shape=SHAPE)
    made = Problem(renderer, [Parameter(key, bounds=(0, 1)) for key in values], [View(renderer.exact(values))])
    own, spent, checks = final_images.render, [0.0], [0.0]

    def render(problem: Problem, values: dict[str, np.ndarray], view: int, samples: int, *rest: int, **options: int):
        spent[0] += 1e-3 * samples
        return own(problem, values, view, samples, *rest, **options)

    def check(*given: Any) -> Misfit | None:
        before = spent[0]
        differs = final_checks.unexplained_pixels(*given)
        checks[0] = spent[0] - before
        return differs

    monkeypatch.setattr(final_images, "render", render)
    monkeypatch.setattr(final_images, "unexplained_pixels", check)
    monkeypatch.setattr(final_images.timing, "now", lambda: spent[0])
    result = Result(values, values, [{}] * 20, 100.0, 0.0, "steps", verification={"best": "end"})
    final_images.render_final_images(made, result, spp, left=lambda: budget - spent[0], tested=False)
    assert checked is (checks[0] > 0.0)
    assert spent[0] <= max(0.5 * budget + 0.04, 0.13)


@pytest.mark.parametrize(("steps", "spp", "told"), [(8, 64, False), (20, 64, False), (21, 64, True), (21, 2, False)])
def test_neither_coarse_grids_nor_few_samples_are_another_cause(
    steps: int, spp: int, told: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A smoke of 4³ cells after 8 steps of at least 21 lacks details of the references, although its cells hardly change those pixels.

    Of one sample per pixel in each half, most pixels are too dark in both.
    """
    monkeypatch.setattr(final_images, "misfit_of_views", lambda *_: None)
    monkeypatch.setattr(final_images, "unexplained_pixels", lambda *_: Misfit(0.1, 1.0, 0.1))
    problem: Any = SimpleNamespace(coarse_to_fine={"grid": SimpleNamespace(steps=(0, 5, 20))})
    result = Result({}, {}, [{}] * steps, 1.0, 0.0, "steps", verification={"best": "end"})
    halves = {"initial": [], "result": []}
    assert bool(final_images._differs(problem, result, [0], halves, spp, True)) is told


@pytest.mark.parametrize("every", [512, 50, 4])
def test_highlights_do_not_make_all_other_pixels_unchanged(every: int) -> None:
    """Such as a lamp's reflections in metal, which change a hundred times as much as the walls that the lamp lights."""
    image, change = np.full((4096, 3), 0.3), np.full((4096, 3), 0.03)
    change[:2048] = 0.0001  # hardly lit
    change[2053::every] = 3.0
    for highlights in (0.3, 30.0):  # some that were elsewhere before, and some that were as large
        image[2053::every] = highlights
        little = final_checks._is_little(image, change, np.ones(4096))
        assert little[:2048].all()
        assert not little[2048:].any()


@pytest.mark.parametrize("late", [False, True])
def test_no_probe_is_made_that_ends_after_the_budget(late: bool) -> None:
    """At least one was made, which took 6 s of a loaded machine after a budget of 15 s was over."""
    made = problem()
    result = Result({"wall": np.full(3, 0.5, np.float32)}, made.initial_values(), [{"samples": 8}], 1.0, 0.0, "seconds")
    found = final_images.render_final_images(made, result, 8, left=lambda: -1.0, grace=1.0 if late else 3.0)
    assert bool(found.sensitivity) is not late
    assert any(TOO_SHORT in line for line in found.undetermined) is late


@pytest.mark.parametrize(("error", "complete", "told"), [(0.01, True, 0), (0.2, True, 1), (0.01, False, 1)])
def test_numbers_whose_errors_the_run_knows_share_no_factor_untested(
    error: float, complete: bool, told: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """On a busy machine a run said that it was too short to test what its own Gauss-Newton matrix shows."""
    monkeypatch.setattr(determination, "_products", lambda problem: [(["wall"], ["wall"])])
    made, values = problem(), {"wall": np.full(3, 0.5, np.float32)}
    known = {"wall": np.full(3, error, np.float32)}
    result = Result(values, made.initial_values(), [{"samples": 8}], 1.0, 0.0, "seconds", standard_error=known)
    found = final_images.render_final_images(made, result, 8, tested=False, complete=complete)
    assert sum("share a factor" in line for line in found.undetermined) == told


@pytest.mark.parametrize("of_samples", [True, False])
def test_a_difference_that_only_may_be_noise_of_the_references_takes_standard_errors_away(
    of_samples: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A line said that light or depth may be wrong, and maps of standard errors stood beside it."""
    still = Misfit(0.1, 1.0, 0.0, True, causes=(STEPS, NOISE), of_samples=of_samples)
    monkeypatch.setattr(final_images, "unexplained_pixels", lambda *_: None)
    monkeypatch.setattr(final_images, "differs_still", lambda *_: still)
    made = textured(0.0, 0.1)
    values = {"map": np.linalg.lstsq(made.renderer.matrix, np.ravel(made.views[0].reference))[0].astype(np.float32)}  # type: ignore
    result = Result(values, values, [{}] * 150, 1.0, 0.0, "steps")
    result = replace(result, verification={"best": "end"}, standard_error={"map": np.full(32, 0.1)})
    found = final_images.render_final_images(made, result, 16, tested=False)
    assert found.misfit is still
    assert bool(found.standard_error) is of_samples


@pytest.mark.parametrize("held", [False, True])
def test_pictures_in_other_units_are_judged_as_those_of_colours(held: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Depths of hundreds beside colours: changes of the pictures had their own units, and residuals those of colours."""
    made, truth = half_textured(), np.random.default_rng(0).uniform(0.1, 0.9, 50)
    renderer, start = made.renderer, 0.45 if held else 0.5
    assert isinstance(renderer, AnalyticRenderer)
    exact, first = renderer.exact({"map": truth}), made.initial_values()
    values = {"map": (start + 0.7 * (truth - start)).astype(np.float32)}
    noise = 0.01 * np.random.default_rng(1).standard_normal((2, 2, *exact.shape))  # of halves and views
    unknown = Parameter("map", initial=0.5, bounds=(0, 1), prior=Prior(near=0.45, std=0.2) if held else None)
    known = Misfit(0.5 * float(np.sqrt(np.square(renderer.exact(values) - exact).mean())), 1.0, 0.0, causes=(PRIOR,))
    found: list[Any] = []
    for scale in (1.0, 500.0):
        units = np.array([1.0, scale])
        monkeypatch.setattr(Problem, "units", [1.0, 1.0 / scale])
        views = [View(((1.0 if held else 0.8) * unit * exact).astype(np.float32)) for unit in units]
        of = Problem(renderer, [unknown], views)

        def picture(values: Any, view: int, half: int = 0, units: np.ndarray = units) -> np.ndarray:
            return units[view] * (renderer.exact(values) + noise[half, view])

        starts, ends = ([[picture(x, view, half) for half in (0, 1)] for view in (0, 1)] for x in (first, values))
        if held:
            found.append(final_checks.beyond_priors(of, known, values, ends, picture).causes)
        else:
            differs = final_checks.unexplained_pixels(of, values, starts, ends, picture)
            found.append(differs and (round(differs.error, 4), differs.explanation))
    assert found[0]
    assert found[0] == found[1]
