"""Starts of few numbers: another place is taken only where its picture is much better, and every place is within the bounds."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest

from tests.analytic import AnalyticRenderer
from unrender import losses
from unrender.estimators.fresh_pictures import FreshPictures
from unrender.methods import method
from unrender.methods.plan import Plan
from unrender.methods.rules import exchangeable, places, starts
from unrender.methods.rules.constants import CONSTANTS
from unrender.methods.rules.paths import start_factors
from unrender.runs.optimize import optimize
from unrender.runs.reopen import resume
from unrender.scene.parameter import Parameter
from unrender.scene.problem import Problem
from unrender.scene.references import View

SHAPE, TRUTH = (8, 8), {"place": np.array([2.0, 7.0]), "lamp": np.array([4.0])}


def problem(
    monkeypatch: pytest.MonkeyPatch,
    start: Any,
    bounds: Any = (0.0, 10.0),
    lamp: float = 4.0,
    most: float | None = None,
    prior: Any = None,
    brightness: str = "light",
    **traits: Any,
) -> Problem:
    """Two numbers, by default of the picture's form, and a lamp whose upper bound is `most`."""
    matrix = np.random.default_rng(1).uniform(-1.0, 1.0, (SHAPE[0] * SHAPE[1] * 3, 3))
    renderer = AnalyticRenderer(TRUTH, matrix, 0.0, 0.3, shape=SHAPE)
    known = renderer.parameters()
    changed = {
        "place": dataclasses.replace(known["place"], **({"nonlinear": True} | traits)),
        "lamp": dataclasses.replace(known["lamp"], brightness=brightness),
    }
    monkeypatch.setattr(AnalyticRenderer, "parameters", lambda self: changed)
    unknown = [
        Parameter("place", initial=start, bounds=bounds, prior=prior),
        Parameter("lamp", initial=lamp, bounds=(0, most)),
    ]
    return Problem(renderer, unknown, [View(renderer.exact(TRUTH))], truth=TRUTH)


class Broken(AnalyticRenderer):
    """With one pixel that is not finite."""

    def image(self, parameters: Any, request: Any) -> Any:
        rendering = super().image(parameters, request)
        rendering.images[:, 0, 0] = np.nan
        return rendering


def test_a_pixel_that_is_not_finite_leaves_the_factors_of_lights() -> None:
    matrix = np.random.default_rng(2).uniform(0.5, 1.5, (SHAPE[0] * SHAPE[1] * 3, 1))
    for kind in (AnalyticRenderer, Broken):
        renderer = kind({"lamp": np.array([1.0])}, matrix, 0.0, 0.1, shape=SHAPE)
        made = Problem(renderer, [Parameter("lamp", initial=[0.1])], [View(renderer.exact({"lamp": np.array([1.0])}))])
        assert start_factors(made, ["lamp"], CONSTANTS) == pytest.approx({"lamp": 10.0}, rel=0.05)


def restricted(
    monkeypatch: pytest.MonkeyPatch, start: Any, lamp: float, loss: losses.Loss, reference: Any, mask: Any = None
) -> Problem:
    """The same with images without noise that have no negative values, and another reference."""
    made = problem(monkeypatch, start, lamp=lamp)
    matrix = np.random.default_rng(1).uniform(0.0, 1.0, (SHAPE[0] * SHAPE[1] * 3, 3))
    matrix[:, 0] *= np.linspace(0.0, 1.0, len(matrix))
    matrix[:, 1] *= np.linspace(1.0, 0.0, len(matrix))
    renderer = AnalyticRenderer(TRUTH, matrix, 0.0, 0.0, shape=SHAPE)
    view = View(reference(renderer.exact(TRUTH)), mask=mask)
    return Problem(renderer, made.parameters, [view], truth=TRUTH, loss=loss)


def first(plan: Plan) -> dict[str, np.ndarray]:
    return {key: np.asarray(x) for key, x in plan.configured().start().items()}


@pytest.mark.parametrize("lamp", [4.0, 0.5])
def test_a_far_start_is_left_for_a_place_whose_picture_is_much_better(
    lamp: float, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """The lamp's brightness is fitted at each place, so a wrong one does not hide the better place."""
    made = problem(monkeypatch, [9.5, 0.5], lamp=lamp)
    plan = method("auto").plan(made)
    assert any(reason.startswith("starts at other values of place") for reason in plan.reasons)
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
        ([9.5, 0.5], (None, 10.0), {}),
        ([9.5, 0.5], (0.0, None), {"rigid": True}),
        ([9.5, 0.5], (0.0, 10.0), {"nonlinear": False}),  # of brightness
        (
            [9.5, 0.5],
            (0.0, 10.0),
            {"brightness": "reflectance"},
        ),  # beside a colour, for which another place may make up
    ],
)
def test_a_start_is_kept_where_it_is_near_or_places_have_no_bounds(
    start: list[float], bounds: Any, traits: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    plan = method("auto").plan(problem(monkeypatch, start, bounds, **traits))
    assert not any("other values" in reason for reason in plan.reasons)
    np.testing.assert_allclose(first(plan)["place"], start)


@pytest.mark.parametrize("lamp", [4.0, 0.5])
@pytest.mark.parametrize("descends", [True, False])
def test_positive_numbers_descend_from_places_of_other_magnitudes(
    lamp: float, descends: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A focus distance 2.5 times too near ended at 0, and an extinction ten times too large at a phase function of mirrors. The planted
    fault are places alone, which are far apart."""
    made = problem(monkeypatch, [12.0, 1.0], (0.0, None), lamp=lamp)
    if not descends:
        monkeypatch.setattr(starts._Comparison, "_stepped", lambda self, keys, descent: descent)
    pictures, judged = (FreshPictures(made, 0, paths, 3) for paths in (1 << 13, 1 << 15))
    found = starts.better_place(made, pictures, made.initial_values(), ["place"], ["lamp"], judged=judged)
    assert found is not None
    assert bool(np.linalg.norm(found.values["place"] - TRUTH["place"]) < 0.3) is descends
    if descends and lamp != 4.0:
        assert found.values["lamp"] == pytest.approx(4.0, rel=0.1)
    for x in ([0.5, 0.5], [0.1, 0.9]):
        values = places.values_at(made, ["place"], np.array(x), made.initial_values())
        np.testing.assert_allclose(places.coordinates_of(made, ["place"], values), x, rtol=1e-5)
    np.testing.assert_allclose(
        places.values_at(made, ["place"], np.ones(2), {"place": np.ones(2)})["place"], [120.0, 10.0]
    )
    assert places.coordinates_of(made, ["place"], {"place": np.zeros(2)}).tolist() == [0.0, 0.0]


def test_positive_numbers_start_at_their_initial_values(monkeypatch: pytest.MonkeyPatch) -> None:
    """Noise of the first pictures chose another minimum for a focus distance a fifth too far."""
    plan = method("auto").plan(problem(monkeypatch, [12.0, 1.0], (0.0, None)))
    assert plan.other_starts == ("place",)
    np.testing.assert_allclose(first(plan)["place"], [12.0, 1.0])


@pytest.mark.parametrize(
    ("start", "traits", "moved"),
    [
        ([0.0, 0.0], {}, True),
        ([0.0, 0.5], {}, False),
        ([0.0, 0.0], {"scattering": "medium"}, False),
        ([0.0, 0.0], {"brightness": "reflectance"}, False),
    ],
)
def test_numbers_at_their_only_bound_start_above_it(
    start: list[float], traits: dict[str, Any], moved: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Pictures are even functions of some, such as k of a metal, so their derivatives there are 0."""
    limits = {"nonlinear": False, **traits, "lowest": 0.0}
    brightness = limits.pop("brightness", "light")
    plan = method("auto").plan(problem(monkeypatch, start, (0.0, None), brightness=brightness, **limits))
    assert any(reason.startswith("starts at other values of place") for reason in plan.reasons) is moved
    assert (np.abs(first(plan)["place"] - 2.5) <= 2.5).all()
    assert np.array_equal(first(plan)["place"], start) is not moved


def test_a_start_whose_difference_is_noise_is_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    made = problem(monkeypatch, [2.0, 7.0])
    changes = iter([-1e-9, *[-1e-6] * 1000])
    monkeypatch.setattr(
        starts._Comparison, "losses", lambda _, states: [(np.full((4, 64), next(changes)), 1.0) for _ in states]
    )
    assert not any("starts at other values" in reason for reason in method("auto").plan(made).reasons)


def test_noise_is_no_better_place(monkeypatch: pytest.MonkeyPatch) -> None:
    """Pictures that no place changes differ by noise alone."""
    made = problem(monkeypatch, [9.5, 0.5])
    monkeypatch.setattr(starts.FreshPictures, "images", lambda *_: [np.random.default_rng(0).normal(size=(4, 64, 3))])
    assert not any("other values" in reason for reason in method("auto").plan(made).reasons)


@pytest.mark.parametrize("white", [1.0, 2.0, 3.0])
@pytest.mark.parametrize("lamp", [4.0, 40.0])
def test_places_are_judged_by_the_loss_of_the_problem(
    white: float, lamp: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Saturated references say nothing against brighter pictures, so a start with the true place has the least loss."""
    censored = losses.Censored(losses.L2(), white)
    made = restricted(monkeypatch, [2.0, 7.0], lamp, censored, lambda image: np.minimum(image, white))
    plan = method("auto").plan(made)
    begun, values, renderer = first(plan), made.initial_values(), cast(Any, made.renderer)
    own, given = (float(made.loss_value(0, renderer.array(renderer.exact(x)))) for x in (begun, values))
    assert own <= 0.5 * given or all(np.array_equal(begun[key], values[key]) for key in values)
    if lamp == 4.0:
        assert given < 1e-12  # of rounding
        assert not any("other values" in reason for reason in plan.reasons)


def test_a_far_start_is_left_with_a_loss_of_saturated_references(monkeypatch: pytest.MonkeyPatch) -> None:
    censored = losses.Censored(losses.L2(), 6.0)
    made = restricted(monkeypatch, [9.5, 0.5], 4.0, censored, lambda image: np.minimum(image, 6.0))
    begun = first(method("auto").plan(made))
    assert np.linalg.norm(begun["place"] - TRUTH["place"]) < 3.5


@pytest.mark.parametrize("lamp", [4.0, 0.5])
def test_masked_pixels_count_nothing(lamp: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """The masked half of the reference is of another place, which has less squared difference from the whole reference."""
    mask = np.ones(SHAPE, np.float32)
    mask[4:] = 0.0

    def reference(image: np.ndarray) -> np.ndarray:
        return np.concatenate([image[:4], image[4:] + 100.0])

    made = restricted(monkeypatch, [2.0, 7.0], lamp, losses.L2(), reference, mask)
    assert not any("other values" in reason for reason in method("auto").plan(made).reasons)
    far = restricted(monkeypatch, [9.5, 0.5], lamp, losses.L2(), reference, mask)
    begun = first(method("auto").plan(far))
    assert np.linalg.norm(begun["place"] - TRUTH["place"]) < 3.5
    assert begun["lamp"] == pytest.approx(4.0, rel=0.5)


def test_lights_stay_within_their_bounds(monkeypatch: pytest.MonkeyPatch) -> None:
    made = problem(monkeypatch, [9.5, 0.5], lamp=0.5, most=2.0)
    plan = method("auto").plan(made)
    assert any("other values" in reason for reason in plan.reasons)
    begun = first(plan)["lamp"]
    assert begun == pytest.approx(2.0, rel=1e-3)
    assert begun < 2.0
    assert optimize(made, plan, steps=1, progress=False).initial["lamp"] < 2.0


def test_a_number_with_a_prior_keeps_its_start(monkeypatch: pytest.MonkeyPatch) -> None:
    made = problem(monkeypatch, [9.5, 0.5], prior={"near": 5.0, "std": 100.0})
    np.testing.assert_allclose(first(method("auto").plan(made))["place"], [9.5, 0.5])


def test_limits_of_a_common_factor_keep_each_value_inside() -> None:
    values = [(np.array([1.0, 4.0, 0.0]), (0.5, 8.0)), (np.array([-2.0]), (-3.0, None))]
    assert starts._limits(values) == (0.5, 1.5)
    assert starts._limits([(np.ones(2), (None, None))]) == (1e-2, 1e2)
    assert starts._limits([]) == (1e-2, 1e2)


@pytest.mark.parametrize(
    ("role", "size", "number", "farthest"), [("value", 1, 16, 0.2), ("value", 3, 24, 0.9), ("direction", 3, 24, 0.9)]
)
def test_places_are_spread_over_the_range(
    role: str, size: int, number: int, farthest: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """16 places per dimension, and 24 at most."""
    renderer = AnalyticRenderer({"place": np.ones(size)}, np.ones((192, size)), shape=SHAPE)
    info = dataclasses.replace(renderer.parameters()["place"], nonlinear=True, role=role)
    monkeypatch.setattr(AnalyticRenderer, "parameters", lambda self: {"place": info})
    made = Problem(renderer, [Parameter("place", bounds=(-1.0, 1.0))], [View(np.zeros((*SHAPE, 3)))])
    spread = np.array([places._value(made, "place", x, np.zeros(size)) for x in places.points(made, ["place"])])
    assert len(spread) == number
    assert (np.abs(spread) <= 1.0).all()
    if role == "direction":
        np.testing.assert_allclose(np.linalg.norm(spread, axis=1), 1.0, atol=1e-3)
    other = np.random.default_rng(0).normal(size=(200, size))
    other = other / np.linalg.norm(other, axis=1)[:, None] if role == "direction" else np.clip(0.4 * other, -1, 1)
    nearest = np.linalg.norm(other[:, None] - spread[None], axis=2).min(axis=1)
    assert nearest.max() < farthest
    point = places.points(made, ["place"])[3]
    np.testing.assert_allclose(places.coordinates_of(made, ["place"], {"place": spread[3]}), point, rtol=1e-5)


@pytest.mark.parametrize(("shape", "views"), [((8, 8), 2), ((40, 30), 2)])
def test_places_of_a_shape_share_launches(shape: tuple[int, int], views: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Ten times as many launches, one picture each, took 2.5 s for five squares."""
    values = {"box.translation": np.zeros(2), "lamp": np.ones(1)}
    matrix = np.random.default_rng(3).uniform(0.5, 1.5, (shape[0] * shape[1] * 3, 3))
    renderer = AnalyticRenderer(values, matrix, 0.0, 0.0, shape=shape, sensors=views)
    known = renderer.parameters()
    moved = {**known, "box.translation": dataclasses.replace(known["box.translation"], rigid=True)}
    monkeypatch.setattr(AnalyticRenderer, "parameters", lambda self: moved)
    references = [View(np.zeros((*shape, 3)), sensor=index) for index in range(views)]
    made = Problem(renderer, [Parameter(key) for key in values], references)
    launches: list[str] = []
    for name in ("image", "image_batch"):
        render = getattr(AnalyticRenderer, name)
        monkeypatch.setattr(
            AnalyticRenderer, name, lambda *own, name=name, render=render: (launches.append(name), render(*own))[1]
        )
    pictures = starts.FreshPictures(made, 0, 1 << 15)
    places = np.random.default_rng(4).uniform(-1.0, 1.0, (20, 2))
    states = [{"box.translation": place, "lamp": np.ones(1)} for place in places]
    found = pictures.images_of(states, ["box.translation"])
    assert launches == ["image_batch"] * (2 * 4 * views)  # sixteen states each, four independent groups of each view
    assert pictures.rendered == 32 * max(pictures.paths // 4, 4 * pictures.pixels)  # a quarter of the samples of each
    for state, images in zip(states, found, strict=True):
        for one, other in zip(images, pictures.images(state), strict=True):
            np.testing.assert_allclose(one, other, rtol=1e-6)
    launches.clear()
    pictures.images_of([{**states[0], "lamp": np.full(1, 2.0)}], ["lamp"])  # no pose: each state has its own launches
    assert "image_batch" not in launches


@pytest.mark.parametrize(
    ("other", "light", "bounds", "told"),
    [
        ("fill.rotation.x", 1.0, (None, None), True),
        ("fill.rotation.x", 2.0, (None, None), False),
        ("fill.rotation.y", 1.0, (None, None), False),
        ("lamp.rotation.y", 1.0, (None, None), False),
        ("box.rotation.x", 1.0, (None, None), False),
        ("fill.position", 1.0, (None, None), True),
        ("fill.position", 1.0, (-1.0, 2.0), True),
        ("fill.position", 1.0, (-1.0, 0.5), False),
        ("fill.position", 2.0, (None, None), False),
    ],
)
def test_lights_that_may_be_exchanged_have_a_line(
    other: str, light: float, bounds: tuple[float | None, float | None], told: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Lights of other colours, other unknown coordinates, bounds without a common value, or a single one, are not exchanged."""
    values = {"lamp.intensity": np.ones(1), "fill.intensity": np.full(1, light)}
    poses = {f"{name}.rotation.{axis}": np.zeros(1) for name in ("lamp", "fill", "box") for axis in "xy"}
    poses |= {f"{name}.position": np.zeros(1) for name in ("lamp", "fill")}
    renderer = AnalyticRenderer({**values, **poses}, np.zeros((48, 10)))
    known = {
        key: dataclasses.replace(
            info, rigid="rotation" in key, light="box" not in key, brightness="light" if key in values else ""
        )
        for key, info in renderer.parameters().items()
    }
    monkeypatch.setattr(AnalyticRenderer, "parameters", lambda self: known)
    first = Parameter(other.replace("fill", "lamp"), bounds=(1.0, 3.0), initial=2.0)
    unknown = [first if "position" in other else Parameter("lamp.rotation.x"), Parameter(other, bounds=bounds)]
    scene = Problem(renderer, unknown, [View(np.zeros((4, 4, 3)))])
    assert exchangeable.exchangeable_lights(scene) == (["lamp", "fill"] if told else [])
