"""Starts of few numbers: another place is taken only where its picture is much better, and every place is within the bounds."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from unrender.methods import method
from unrender.methods.plan import Plan
from unrender.methods.rules import starts
from unrender.rendering.numpy.linear import AnalyticRenderer
from unrender.runs.optimize import optimize
from unrender.runs.reopen import resume
from unrender.scene.parameter import Parameter
from unrender.scene.problem import Problem
from unrender.scene.view import View

SHAPE, TRUTH = (8, 8), {"place": np.array([2.0, 7.0]), "lamp": np.array([4.0])}


def problem(
    monkeypatch: pytest.MonkeyPatch, start: Any, bounds: Any = (0.0, 10.0), lamp: float = 4.0, **traits: Any
) -> Problem:
    """Two numbers, by default of the picture's form, and a lamp."""
    matrix = np.random.default_rng(1).uniform(-1.0, 1.0, (SHAPE[0] * SHAPE[1] * 3, 3))
    renderer = AnalyticRenderer(TRUTH, matrix, 0.0, 0.3, shape=SHAPE)
    known = renderer.parameters()
    changed = {
        "place": dataclasses.replace(known["place"], **({"nonlinear": True} | traits)),
        "lamp": dataclasses.replace(known["lamp"], brightness="light"),
    }
    monkeypatch.setattr(AnalyticRenderer, "parameters", lambda self: changed)
    unknown = [Parameter("place", initial=start, bounds=bounds), Parameter("lamp", initial=lamp, bounds=(0, None))]
    return Problem(renderer, unknown, [View(renderer.exact(TRUTH))], truth=TRUTH)


def first(plan: Plan) -> dict[str, np.ndarray]:
    return {key: np.asarray(x) for key, x in plan.configured().start().items()}


@pytest.mark.parametrize("lamp", [4.0, 0.5])
def test_a_far_start_is_left_for_a_place_whose_picture_is_much_better(
    lamp: float, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """The lamp's brightness is fitted at each place, so a wrong one does not hide the better place."""
    made = problem(monkeypatch, [9.5, 0.5], lamp=lamp)
    plan = method("auto").plan(made)
    assert any(reason.startswith("starts at another place within the bounds of place") for reason in plan.reasons)
    begun = first(plan)
    assert np.linalg.norm(begun["place"] - TRUTH["place"]) < 3.5 < np.linalg.norm(np.array([9.5, 0.5]) - TRUTH["place"])
    assert begun["lamp"] == pytest.approx(4.0, rel=0.5)
    again = Plan.from_table(made, plan.table(), "plan")
    np.testing.assert_array_equal(first(again)["place"], begun["place"])
    whole = optimize(made, plan, steps=4, run_directory=tmp_path / "whole")
    optimize(made, plan, steps=2, run_directory=tmp_path / "part")
    later = resume(tmp_path / "part", made, steps=4)
    np.testing.assert_array_equal(later.parameters["place"], whole.parameters["place"])


@pytest.mark.parametrize(
    ("start", "bounds", "traits"),
    [
        ([2.5, 6.5], (0.0, 10.0), {}),  # near
        ([9.5, 0.5], None, {}),  # without bounds
        ([9.5, 0.5], (0.0, None), {}),
        ([9.5, 0.5], (0.0, 10.0), {"nonlinear": False}),  # of brightness
    ],
)
def test_a_start_is_kept_where_it_is_near_or_places_have_no_bounds(
    start: list[float], bounds: Any, traits: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    plan = method("auto").plan(problem(monkeypatch, start, bounds, **traits))
    assert not any("another place" in reason for reason in plan.reasons)
    np.testing.assert_allclose(first(plan)["place"], start)


def test_a_start_whose_difference_is_noise_is_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    made = problem(monkeypatch, [2.0, 7.0])
    changes = iter([-1e-9, *[-1e-6] * 1000])
    monkeypatch.setattr(starts, "_squares", lambda *_: (np.full(64, next(changes)), 1.0))
    assert not any("starts at another place" in reason for reason in method("auto").plan(made).reasons)


def test_noise_is_no_better_place(monkeypatch: pytest.MonkeyPatch) -> None:
    """Pictures that no place changes differ by noise alone."""
    made = problem(monkeypatch, [9.5, 0.5])
    monkeypatch.setattr(starts.FreshPictures, "images", lambda *_: [np.random.default_rng(0).normal(size=(4, 64, 3))])
    assert not any("another place" in reason for reason in method("auto").plan(made).reasons)


@pytest.mark.parametrize("role", ["value", "direction"])
def test_places_are_spread_over_the_range(role: str, monkeypatch: pytest.MonkeyPatch) -> None:
    renderer = AnalyticRenderer({"place": np.ones(3)}, np.ones((192, 3)), shape=SHAPE)
    info = dataclasses.replace(renderer.parameters()["place"], nonlinear=True, role=role)
    monkeypatch.setattr(AnalyticRenderer, "parameters", lambda self: {"place": info})
    made = Problem(renderer, [Parameter("place", bounds=(-1.0, 1.0))], [View(np.zeros((*SHAPE, 3)))])
    traits: Any = type("T", (), {"infos": {"place": info}, "problem": made})
    places = np.array([place["place"] for place in starts._places(traits, ["place"])])
    assert len(places) == (16 if role == "direction" else 24)
    assert (np.abs(places) <= 1.0).all()
    if role == "direction":
        np.testing.assert_allclose(np.linalg.norm(places, axis=1), 1.0, atol=1e-3)
    other = np.random.default_rng(0).normal(size=(200, 3))
    other = other / np.linalg.norm(other, axis=1)[:, None] if role == "direction" else np.clip(0.4 * other, -1, 1)
    nearest = np.linalg.norm(other[:, None] - places[None], axis=2).min(axis=1)
    assert nearest.max() < 0.9
