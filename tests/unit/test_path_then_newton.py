"""Path gradients of few numbers, and Gauss-Newton steps once these agree no more."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import unrender as ur
from tests.analytic import AnalyticRenderer
from tiers import slow
from unrender.estimators import GaussNewton, PathThenNewton
from unrender.estimators.base import Estimate
from unrender.estimators.capabilities import Hessian, HessianNoise
from unrender.methods import method
from unrender.methods.plan import Plan, PlanFile, plan_text

TRUTH = {"gain": np.array([0.5, 0.3, 0.7], np.float32)}
SHAPE = (8, 8)


def problem(noise: float = 4.0) -> ur.Problem:
    matrix = np.random.default_rng(1).uniform(0.0, 1.0, (SHAPE[0] * SHAPE[1] * 3, 3))
    renderer = AnalyticRenderer(TRUTH, matrix, 0.1, noise, shape=SHAPE)
    unknown = ur.Parameter("gain", initial=0.2, bounds=(0.0, 1.0))
    view = ur.View(renderer.exact(TRUTH))
    return ur.Problem(renderer, [unknown], [view], truth=TRUTH)


def plan(made: ur.Problem) -> Plan:
    """Return the plan of `auto`, with images of few samples, as on large films."""
    chosen = method("auto").plan(made)
    assert isinstance(chosen.estimator, PathThenNewton)
    newton = dataclasses.replace(chosen.estimator.newton, spp=32, derivative_spp=4)
    path = dataclasses.replace(chosen.estimator.path, spp=4)
    return dataclasses.replace(chosen, estimator=PathThenNewton(path, newton))


class Change(ur.protocols.Callback):
    """Steps before the first Gauss-Newton step, steps before each trial and before the next one, and errors by step."""

    def __init__(self) -> None:
        self.at: int | None = None
        self.trials: dict[int, int] = {}
        self.errors: list[float] = []

    def on_step(self, run: Any, record: dict[str, Any]) -> None:
        state = run.state.estimator
        self.errors.append(float(np.linalg.norm(run.full()["gain"] - TRUTH["gain"])))
        if state.changed and self.at is None:
            self.at = record["step"]
        if state.trial and state.trial not in self.trials.values():
            self.trials[state.step - 1] = state.trial


def losses(result: ur.Result) -> list[float]:
    return [record["loss"] for record in result.history]


def test_path_gradients_come_first_and_gauss_newton_steps_end_nearer() -> None:
    """Until the change the run is that of path gradients, to the bit. At its end the error is at most half of that at the change."""
    made, ends = problem(), []
    both = plan(made)
    assert "later Gauss-Newton steps" in both.reasons[-1]
    for seed in range(4):
        change = Change()
        found = ur.optimize(made, both, steps=60, seed=seed, callbacks=[change], progress=False)
        assert change.at is not None
        assert 4 < change.at < 40
        paths = both.estimator.path, both.optimizer.first  # pyright: ignore[reportAttributeAccessIssue]
        first = ur.optimize(made, *paths, steps=change.at, seed=seed, progress=False)
        assert losses(first) == losses(found)[: change.at]
        assert found.parameters is found.last, "its steps are a mean"
        ends.append([change.errors[-1], change.errors[change.at - 1]])
        scores = (found.parameters["gain"] - TRUTH["gain"]) / found.standard_error["gain"]
        assert (np.abs(scores) < 5.0).all()
    end, before = np.sqrt(np.mean(np.square(ends), axis=0))
    assert end < 0.5 * before


@pytest.mark.mitsuba  # which a run folder asks for its version
def test_a_plan_in_a_file_makes_the_same_run_and_a_run_resumes_to_the_bit(tmp_path: Path) -> None:
    """Once before and once after the change."""
    made, change = problem(), Change()
    both = plan(made)
    whole = ur.optimize(made, both, steps=45, callbacks=[change], progress=False)
    assert change.at is not None
    (tmp_path / "own.toml").write_text(plan_text(both))
    for steps in (change.at - 2, change.at + 3):
        folder = tmp_path / str(steps)
        again = PlanFile(tmp_path / "own.toml").plan(made)
        ur.optimize(made, again, steps=steps, run_directory=folder, progress=False)
        ended = ur.resume(folder, problem(), steps=45)
        assert losses(ended) == losses(whole)
        np.testing.assert_array_equal(ended.parameters["gain"], whole.parameters["gain"])


@pytest.mark.parametrize(("noise", "wait"), [(2.5, 2.5), slow(1e3, 16.0), slow(np.nan, 16.0)])
def test_derivative_images_that_are_noise_leave_path_gradients(
    monkeypatch: pytest.MonkeyPatch, noise: float, wait: float
) -> None:
    """They are tried again after the more steps, the more noise there was: trials took a third of a run that they did not help."""
    made, change = problem(), Change()
    both, estimate = plan(made), GaussNewton.estimate

    def noisy(*arguments: Any) -> tuple[Estimate, Any]:
        found, state = estimate(*arguments)
        planted = HessianNoise(noise * np.asarray(found.require("", Hessian).matrix))
        kept = tuple(one for one in found.capabilities if not isinstance(one, HessianNoise))
        return dataclasses.replace(found, capabilities=(*kept, planted)), state

    monkeypatch.setattr(GaussNewton, "estimate", noisy)
    found = ur.optimize(made, both, steps=80, callbacks=[change], progress=False)
    paths = both.estimator.path, both.optimizer.first  # pyright: ignore[reportAttributeAccessIssue]
    first = ur.optimize(made, *paths, steps=80, progress=False)
    assert change.at is None
    assert len(change.trials) >= (2 if wait < 4.0 else 1)
    assert all(later == pytest.approx(wait * earlier, abs=1.0) for earlier, later in change.trials.items())
    assert all(later >= planned for planned, later in zip(change.trials.values(), [*change.trials][1:], strict=False))
    assert losses(found) == losses(first)
    np.testing.assert_array_equal(found.parameters["gain"], first.parameters["gain"])
    assert found.history[-1]["samples"] > first.history[-1]["samples"], "a trial traces paths"


@pytest.mark.parametrize("case", ["bound", "unseen"])
def test_numbers_at_a_bound_or_without_influence_do_not_delay_the_change(case: str) -> None:
    """The gradient at a bound always has one sign, so gradients seemed to agree; and an unseen number has no positive curvature."""
    truth = {"gain": TRUTH["gain"], "other": np.array([0.9], np.float32)}
    matrix = np.random.default_rng(1).uniform(0.0, 1.0, (SHAPE[0] * SHAPE[1] * 3, 4))
    matrix[:, 3] *= case == "bound"
    renderer = AnalyticRenderer(truth, matrix, 0.1, 2.0, shape=SHAPE)
    unknowns = [ur.Parameter("gain", 0.2, bounds=(0.0, 1.0)), ur.Parameter("other", 0.5, bounds=(0.0, 0.8))]
    made = ur.Problem(renderer, unknowns, [ur.View(renderer.exact(truth))], truth=truth)
    both = plan(made)
    change = Change()
    found = ur.optimize(made, both, steps=32, callbacks=[change], progress=False)
    assert change.at is not None
    assert found.parameters["other"] == pytest.approx(0.8 if case == "bound" else 0.5, abs=1e-4)
