"""What a user is told who writes what other packages call things, or what will hardly do what was meant."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.analytic import AnalyticRenderer
from unrender import optimizers, pixels
from unrender.core.errors import InputError
from unrender.core.text import did_you_mean
from unrender.estimators.path import PathGradient
from unrender.images import RecursiveControlVariate
from unrender.losses import Huber
from unrender.methods import method
from unrender.methods.smoothed import SmoothedMethod
from unrender.rendering.renderer import ParameterInfo
from unrender.runs.optimize import estimate, optimize, resolve
from unrender.runs.watches import remarks
from unrender.scene.key_hints import instead_of, near_key
from unrender.scene.parameter import Parameter
from unrender.scene.problem import Problem
from unrender.scene.references import View

SHAPE = (4, 4)
GUIDE = Path(__file__).resolve().parents[2] / "docs" / "guide"


def problem(**parameter: Any) -> Problem:
    matrix = np.random.default_rng(0).random((48, 3))
    renderer = AnalyticRenderer({"wall": np.full(3, 0.5)}, matrix, 0.1, 0.1, shape=SHAPE)
    return Problem(renderer, [Parameter("wall", **parameter)], [View(renderer.exact({"wall": np.full(3, 0.4)}))])


@pytest.mark.parametrize(("given", "meant"), [("lr", "learning_rate"), ("LR", "learning_rate"), ("eps", "epsilon")])
def test_names_of_other_packages_are_understood(given: str, meant: str) -> None:
    assert did_you_mean(given, ["spp", meant, "beta_1"]) == f"; did you mean {meant}?"


def test_a_synonym_is_no_suggestion_where_the_name_is_unknown() -> None:
    assert did_you_mean("lr", ["spp", "space"]) == ""


def test_a_method_s_option_by_its_name_elsewhere() -> None:
    with pytest.raises(InputError, match="method rcv has no option lr; did you mean learning_rate"):
        method("rcv").configure({"lr": "0.1"})


@pytest.mark.parametrize(
    ("make", "message"),
    [
        ((optimizers.Adam, {"lr": 0.1}), "Adam has no option lr; did you mean learning_rate?"),
        ((PathGradient, {"samples_per_pixel": 4}), "PathGradient has no option samples_per_pixel; did you mean spp?"),
        ((Huber, {"width": 1.0}), "Huber has no option width; it has delta"),
    ],
)
def test_constructors_name_the_option_that_was_meant(make: Any, message: str) -> None:
    with pytest.raises(InputError) as caught:
        make[0](**make[1])
    assert str(caught.value).startswith(message)


def test_constructors_still_take_their_own_options() -> None:
    assert optimizers.Adam(0.1, beta_1=0.5) == optimizers.Adam(learning_rate=0.1, beta_1=0.5)


def test_a_method_s_name_stands_for_its_parts() -> None:
    chosen = resolve(problem(), "rcv", None)
    assert (chosen.estimator, chosen.optimizer) == method("rcv").start()
    chosen = resolve(problem(), "rcv", optimizers.SGD(0.1))
    assert isinstance(chosen.estimator.image, RecursiveControlVariate)  # pyright: ignore[reportAttributeAccessIssue]
    assert chosen.optimizer == optimizers.SGD(0.1)


def test_a_run_by_a_method_s_name() -> None:
    result = optimize(problem(), "plain", steps=3)
    assert (result.method, result.steps, result.choices, result.adapted) == ("plain", 3, [], [])


def test_a_run_says_what_was_chosen_and_found() -> None:
    result = optimize(problem(), steps=3)
    assert any(choice.startswith("schedule-free Adam, first rate 0.05 (wall)") for choice in result.choices)
    assert result.adapted[-1].startswith("learning rate, over the first: ")
    assert estimate(problem(), "plain").gradient["wall"].shape == (3,)


class Foreign:
    """Stands for `mitsuba.ad.Adam`, which need not be imported here."""


Foreign.__name__, Foreign.__module__ = "Adam", "drjit.opt"


@pytest.mark.parametrize(
    ("estimator", "optimizer", "message"),
    [
        (PathGradient(), Foreign(), r"Dr.Jit's Adam updates .* expected unrender.optimizers.Adam\(learning_rate=...\)"),
        (PathGradient(), Foreign, r"Dr.Jit's Adam updates"),
        (PathGradient(), optimizers.Adam, r"expected an object, got the class Adam; write Adam\(\)"),
        (PathGradient(), "adam", "expected one of unrender.optimizers.*got 'adam'; did you mean Adam"),
        (PathGradient(), None, "give an optimizer, such as"),
        (optimizers.Adam(), None, "expected an estimator.*or the name of a method .*rcv"),
        ("rvc", None, "unknown method rvc; did you mean rcv"),
    ],
)
def test_what_is_no_estimator_or_optimizer_is_one_line(estimator: Any, optimizer: Any, message: str) -> None:
    with pytest.raises(InputError, match=message) as caught:
        optimize(problem(), estimator, optimizer, steps=1)
    assert "\n" not in str(caught.value)


# ------------------------------------------------------------------ keys

ABLE, NAMELESS = ParameterInfo((3,)), ParameterInfo((3,), False, False, "no id", perturbable=False)
POSES = {f"box.{part}": ParameterInfo((3,), rigid=True) for part in ("translation", "rotation", "scale")}


def test_an_object_without_an_id_is_not_taken_for_another_one() -> None:
    known = {"lamp.bsdf.reflectance.value": ABLE, "object_93904881483472.bsdf.reflectance.value": NAMELESS}
    hint = near_key("wall.bsdf.reflectance.value", known)
    assert hint == '; nothing has the id wall: give the object that holds bsdf.reflectance.value id="wall"'
    assert near_key("lmap.bsdf.reflectance.value", known) == "; did you mean lamp.bsdf.reflectance.value?"


@pytest.mark.parametrize(
    ("given", "meant"),
    [
        ("ball.bsdf.roughness.value", "ball.bsdf.alpha.value"),  # of another plugin
        ("steel.alpha", "ball.bsdf.alpha.value"),  # the material's id, which names no parameter
        ("ball.albedo", "ball.bsdf.reflectance.value"),
        ("lamp.intensity", "lamp.emitter.radiance.value"),
        ("ball.bsdf.etta.value", "ball.bsdf.eta.value"),
    ],
)
def test_the_same_quantity_under_another_name_is_suggested(given: str, meant: str) -> None:
    names = ("cam.x_fov", "ball.bsdf.eta.value", "ball.bsdf.k.value", "ball.bsdf.alpha.value")
    names += ("ball.bsdf.reflectance.value", "wall.bsdf.reflectance.value", "lamp.emitter.radiance.value")
    assert near_key(given, dict.fromkeys(names, ABLE)) == f"; did you mean {meant}?"


def test_an_option_of_other_methods_is_said_to_be_theirs() -> None:
    with pytest.raises(
        InputError, match=r"method auto has no option differential_bsdf; .*; --method .*plain.* have it"
    ):
        method("auto").configure({"differential_bsdf": "true"})


def test_a_transformation_leads_to_the_pose() -> None:
    known = {"box.bsdf.reflectance.value": ABLE, "box.to_world": NAMELESS, **POSES}
    assert instead_of("box.to_world", known) == ("; its pose can be: box.translation, box.rotation, box.scale")
    assert "box.rotation" in near_key("bax.to_world", known)
    numbered = {f"Cube.00{n}.{part}": ParameterInfo((3,), rigid=True) for n in (1, 2) for part in ("rotation", "scale")}
    assert near_key("Cube.002.to_world", numbered).startswith("; a pose is Cube.002.rotation, Cube.002.scale")
    assert instead_of("lamp.to_world", known).endswith("only lights have a pose")
    sky = {"sky.to_world": NAMELESS, "sky.scale": ParameterInfo(())}  # its brightness
    assert instead_of("sky.to_world", sky).endswith("only lights have a pose")
    foggy = {"cam2.to_world": NAMELESS, "cam2.x_fov": ABLE, "cam.x_fov": ABLE}
    assert near_key("cam2.translation", foggy) == "; in a scene with participating media only lights have a pose"
    assert instead_of("box.bsdf.reflectance.value", known) == ""


def test_the_same_quantity_of_the_same_object_comes_first() -> None:
    known = {"floor.bsdf.reflectance.value": ABLE, "toy.bsdf.base_color.value": ABLE}
    assert near_key("toy.bsdf.reflectance.value", known) == "; did you mean toy.bsdf.base_color.value?"
    assert near_key("clay.reflectance.value", known) == "; did you mean floor.bsdf.reflectance.value?"


# ------------------------------------------------------------------ settings


def test_a_learning_rate_that_crosses_the_range_is_commented() -> None:
    bounded = problem(bounds=(0, 1))
    (line,) = remarks(bounded, optimizers.Adam(2.0))
    assert "learning_rate of 2 crosses its range, 0 to 1, in one step" in line
    first, *others = optimize(bounded, PathGradient(), optimizers.Adam(2.0), steps=1).warnings
    assert first == line
    at_its_end = {"parameter wall", "the final picture is worse than the initial one"}  # at a bound, after one step
    assert {other.partition(":")[0] for other in others} <= at_its_end, others
    assert remarks(bounded, optimizers.Adam(0.05)) == []
    assert remarks(problem(bounds=(0, 100)), optimizers.Adam(2.0)) == []
    assert remarks(problem(bounds=(None, None)), optimizers.Adam(2.0)) == []
    assert len(remarks(problem(bounds=(0, 1), learning_rate=0.7), optimizers.Adam(0.01))) == 1
    assert remarks(bounded, optimizers.SGD(2.0)) == []  # whose rate is not in units of the parameter


@pytest.mark.parametrize("sampler", [pixels.Uniform, pixels.Adaptive, pixels.LossProportional])
def test_a_mini_batch_beyond_all_reason_is_refused_at_once(sampler: Any) -> None:
    with pytest.raises(InputError, match=f"{sampler.__name__}: 99999999 pixels a step, but all views together have 16"):
        optimize(problem(), PathGradient(pixels=sampler(99999999)), optimizers.Adam(), steps=1)


def test_a_mini_batch_of_the_default_size_is_not_refused() -> None:
    assert optimize(problem(), PathGradient(pixels=pixels.Uniform(4096)), optimizers.Adam(), steps=1).steps == 1


def test_the_guide_tells_the_schedule_of_sigma_that_the_method_has() -> None:
    text = (GUIDE / "pose.md").read_text()
    default = SmoothedMethod.model_fields["sigma_schedule"].default
    assert f"`sigma_schedule` is `{default}`" in text
