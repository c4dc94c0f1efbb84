"""Numbers of a result as means over the last steps."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

import unrender as ur
from tests.analytic import AnalyticRenderer
from unrender.optimizers import Adam, AveragedNewton, Partitioned
from unrender.optimizers.base import Measuring, averaged_by
from unrender.runs import number_means, verify
from unrender.runs.map_uncertainty import uncertainty
from unrender.runs.notebook import html
from unrender.runs.number_means import NumberTrace
from unrender.runs.optimize import _with_reasons

TRUTH = {"gain": np.array([0.5, 0.3], np.float32)}
SEEDS = range(12)


def problem(noise: float = 0.3) -> ur.Problem:
    matrix = np.random.default_rng(1).uniform(0.0, 1.0, (48, 2))
    renderer = AnalyticRenderer(TRUTH, matrix, 0.1, noise)
    return ur.Problem(renderer, [ur.Parameter("gain", initial=0.2)], [ur.View(renderer.exact(TRUTH))], truth=TRUTH)


def run(seed: int = 0, steps: int = 200, **options: Any) -> ur.Result:
    return ur.optimize(problem(), ur.PathGradient(spp=2), Adam(0.02, beta_1=0.5), steps=steps, seed=seed, **options)


@pytest.fixture
def stated(monkeypatch: pytest.MonkeyPatch) -> None:
    """Keep the errors of means, which only runs with a run folder test and report."""
    monkeypatch.setattr("unrender.runs.optimize._with_reasons", lambda run, result: result)


@pytest.mark.usefixtures("stated")
def test_means_are_nearer_to_the_truth_than_the_last_values() -> None:
    results = [run(seed) for seed in SEEDS]
    assert all("numbers are means of their last steps" in line for result in results for line in result.adapted)
    squares = [
        [np.mean(np.square(values["gain"] - TRUTH["gain"])) for values in (result.parameters, result.last)]
        for result in results
    ]
    mean, last = np.mean(squares, axis=0)
    assert mean < 0.5 * last
    known = [r for r in results if r.standard_error]
    assert len(known) > 0.6 * len(results)
    scores = [(r.parameters["gain"] - TRUTH["gain"]) / r.standard_error["gain"] for r in known]
    assert 0.4 < np.sqrt(np.mean(np.square(scores))) < 1.8


def test_a_run_that_has_not_arrived_keeps_its_last_values() -> None:
    result = ur.optimize(problem(), ur.PathGradient(spp=2), Adam(0.0005), steps=60)
    assert result.parameters is result.last
    assert not result.standard_error
    assert not result.adapted


@pytest.mark.mitsuba
def test_a_run_without_a_folder_says_how_numbers_get_standard_errors(tmp_path: Path) -> None:
    result = ur.optimize(problem(), ur.PathGradient(spp=2), Adam(0.02), steps=3)
    (line,) = result.without_errors
    assert line.startswith(
        "gain: no standard errors: unrender.runs.uncertainty(problem, result) computes them, or says why"
    )
    assert line in html(result)
    known = uncertainty(problem(), result)
    assert known.standard_error.keys() | {line.partition(":")[0] for line in known.missing} >= {"gain"}
    several = [run(seed) for seed in range(4)]  # means whose errors lack directions that no gradient moves
    assert any("means of their last steps" in line for each in several for line in each.adapted)
    assert not any(each.standard_error for each in several)
    of: Any = SimpleNamespace(problem=problem(), optimizer=Adam(), state=SimpleNamespace(optimizer=None))
    (line,) = _with_reasons(of, replace(result, misfit=cast(Any, "differs"))).without_errors
    assert line == "gain: no standard errors: the final picture differs from the references by more than noise"
    kept = ur.optimize(problem(), ur.PathGradient(spp=2), Adam(0.02), steps=3, run_directory=tmp_path / "run")
    assert not any("uncertainty(" in line for line in kept.without_errors)


def test_a_number_that_drifts_leaves_the_others_without_errors() -> None:
    """The first column wanders about 0.5. The second one drifts, or stays where it is."""
    generator = np.random.default_rng(0)
    rows = np.stack([0.5 + 0.1 * generator.standard_normal(200), np.linspace(0.0, 1.0, 200)], axis=1)
    last = {"a": np.zeros(1, np.float32), "b": np.ones(1, np.float32)}
    means, errors, steps = number_means._means(rows, 1, last)
    assert (list(means), errors, list(steps)) == (["a"], {}, ["a"])
    assert means["a"][0] == pytest.approx(0.5, abs=0.03)
    rows[:, 1] = 1.0
    means, errors, _ = number_means._means(rows, 1, last)
    assert (list(means), list(errors)) == (["a"], ["a"])
    assert errors["a"][0] == pytest.approx(0.1 / np.sqrt(190), rel=0.4)


@pytest.mark.slow
@pytest.mark.usefixtures("stated")
def test_numbers_beside_other_unknowns_have_means_without_errors() -> None:
    """A texture that still drifts takes numbers along slowly, so the scatter of their steps is no error."""
    made = problem()
    shapes = {"gain": TRUTH["gain"], "map": np.full((2, 2, 1), 0.5)}
    renderer = AnalyticRenderer(shapes, np.random.default_rng(1).uniform(0.0, 1.0, (48, 6)), 0.1, 0.3)
    unknown = [ur.Parameter("gain", initial=0.2), ur.Parameter("map", initial=0.5, learning_rate=1e-9)]
    beside = ur.Problem(renderer, unknown, [ur.View(renderer.exact(shapes))], truth=shapes)
    results = [
        [ur.optimize(of, ur.PathGradient(spp=2), Adam(0.02, beta_1=0.5), steps=200, seed=seed) for seed in range(4)]
        for of in (made, beside)
    ]
    assert all(any(result.adapted for result in each) for each in results)
    assert [any(result.standard_error for result in each) for each in results] == [True, False]
    block = Partitioned(("gain",), Adam(0.02), Adam(0.01))
    assert not isinstance(block, Measuring)  # a block's own errors take the other unknowns as known


@pytest.mark.slow
@pytest.mark.mitsuba
@pytest.mark.usefixtures("stated")
def test_short_means_beside_control_variates_have_no_standard_errors() -> None:
    """Their noise is that of a few memories: a roughness of 0.2080 ± 0.0020 was 0.2."""

    def with_errors(image: Any, steps: int, seeds: int) -> int:
        estimator, descent = ur.PathGradient(image, spp=2), Adam(0.1, beta_1=0.5)
        results = [ur.optimize(problem(), estimator, descent, steps=steps, seed=seed) for seed in range(seeds)]
        assert any("numbers are means" in line for result in results for line in result.adapted)
        return sum(bool(result.standard_error) for result in results)

    assert with_errors(ur.images.Plain(), 90, 2)
    assert not with_errors(ur.images.RecursiveControlVariate(), 90, 6)
    assert with_errors(ur.images.RecursiveControlVariate(), 300, 2)


@pytest.mark.mitsuba
def test_means_of_a_resumed_run_are_those_of_one_run(tmp_path: Path) -> None:
    whole = run(steps=120)
    run(steps=70, run_directory=tmp_path / "run")
    resumed = ur.resume(tmp_path / "run", steps=120, problem=problem())
    assert np.array_equal(resumed.parameters["gain"], whole.parameters["gain"])
    assert resumed.adapted[-1] == whole.adapted[-1]
    assert not np.array_equal(resumed.parameters["gain"], resumed.last["gain"])


def test_last_values_are_kept_where_their_picture_is_better(monkeypatch: pytest.MonkeyPatch) -> None:
    """The planted fault is a mean of something else."""
    monkeypatch.setattr(
        number_means, "_means", lambda rows, size, last: ({"gain": np.full(2, 0.9, np.float32)}, {}, {"gain": "100"})
    )
    result = run()
    assert np.array_equal(result.parameters["gain"], result.last["gain"])
    monkeypatch.setattr(verify, "_is_worse", lambda *_: False)
    assert np.array_equal(run().parameters["gain"], np.full(2, 0.9, np.float32))


def test_numbers_that_the_optimizer_averages_are_left_to_it() -> None:
    blocks = Partitioned(("a", "b"), AveragedNewton(), Adam())
    assert averaged_by(AveragedNewton(), ("a", "c")) == {"a", "c"}
    assert averaged_by(blocks, ("a", "c")) == {"a"}
    assert averaged_by(Adam(), ("a",)) == frozenset()
    shapes = number_means.numbers_of(problem(), Adam())
    assert shapes == {"gain": (2,)}
    assert number_means.numbers_of(problem(), AveragedNewton()) == {}


def test_a_trace_of_many_steps_has_few_rows_of_equal_means(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("unrender.runs.number_means._MOST_ROWS", 8)
    trace = NumberTrace()
    for step in range(50):
        trace.append(np.array([step, -step], np.float64))
    assert trace.size == 8
    assert [row[0] for row in trace.rows] == [3.5 + 8 * k for k in range(6)]
    again = NumberTrace.restored(trace.snapshot())
    for each in (trace, again):
        for step in range(50, 57):
            each.append(np.array([step, -step], np.float64))
    assert np.array_equal(np.array(trace.rows), np.array(again.rows))


@pytest.mark.parametrize(
    "fault", [{"size": 0.5}, {"rows": np.zeros((2, 3))}, {"count": 9}, {"total": np.zeros(2, np.float32)}]
)
def test_a_malformed_trace_is_refused(fault: dict[str, Any]) -> None:
    saved = {"rows": np.zeros((2, 2)), "size": 2, "total": np.zeros(2), "count": 1}
    NumberTrace.check(saved, "here")
    with pytest.raises(ur.InputError, match="here: expected the values of numbers"):
        NumberTrace.check({**saved, **fault}, "here")
