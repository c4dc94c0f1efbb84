"""Each option of each method changes the plan or the run, or is refused in one line that says what it needs."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from functools import cache
from typing import Any

import numpy as np
import pytest

import unrender as ur
from tests.analytic import AnalyticRenderer
from tiers import quick
from unrender.core.errors import InputError
from unrender.methods.base import Method, Options, choices, method, methods
from unrender.methods.plan import Plan
from unrender.rendering.mitsuba.session import MitsubaSession
from unrender.rendering.renderer import ParameterInfo

OTHER: dict[str, Any] = {
    "schedule": "exponential(1)",
    "sigma_schedule": "cosine(3)",
    "sigma": "0.07",
    "perturbed": "map",
    "uniform": 0.5,
    "refresh": 1,
    "whole_views": 1,
    "levels": 1,
    "iterations": 1,
    "adjoint_spp": 3,
    "pixels": 12,
    "max_weight": 0.3,
    "correlation": 0.01,
    "spp": 6,
    "samples": 12,
    "step": 0.1,
}
"""Another valid value of an option, where half of its default is none."""
SMALL = {"pixels": 8, "samples": 8, "step": 20.0}
"""Settings with which nine steps suffice."""
STEPS = 9


class Spaces(AnalyticRenderer):
    """Its states share fewer random numbers in primary sample space."""

    def image_pair(self, current: Any, previous: Any, request: Any, space: Any) -> Any:
        pair = super().image_pair(current, previous, request, space)
        other = self.image(previous, dataclasses.replace(request, seed=request.seed + 1)).images
        return dataclasses.replace(pair, previous=other) if space == "primary" else pair


class Posed(Spaces):
    """Its pose has no path gradient."""

    def parameters(self) -> dict[str, ParameterInfo]:
        known = dict(super().parameters())
        return known | {"pose": dataclasses.replace(known["pose"], differentiable=False, shares_paths=False)}


def problem(of: type[AnalyticRenderer] = Spaces, loss: Any = None) -> ur.Problem:
    """A map of 4 x 4 x 3 elements and three numbers, in two views."""
    values = {"map": np.full((4, 4, 3), 0.4), "pose": np.array([0.5, 0.3, 0.2])}
    matrix = np.random.default_rng(1).uniform(-0.1, 0.3, (48, 51)) + np.hstack([np.eye(48), np.zeros((48, 3))])
    renderer = of(values, matrix, 0.5, noise=0.4, sensors=2)
    truth = {"map": np.random.default_rng(2).uniform(0.2, 0.8, (4, 4, 3)), "pose": np.array([0.4, 0.4, 0.1])}
    views = [ur.View(renderer.exact(truth), sensor=index) for index in range(2)]
    return ur.Problem(
        renderer, [ur.Parameter("map", bounds=(0, 1)), ur.Parameter("pose")], views, loss=loss or ur.losses.L2()
    )


def others(options: type[Options], name: str, default: Any) -> list[Any]:
    """Other valid values of an option."""
    return choices(options(), name) or [OTHER[name] if name in OTHER else type(default)(default / 2)]


def contexts(one: Method, option: str) -> Iterator[dict[str, Any]]:
    """Settings in which at most one other option of few values is not its default."""
    small = {name: value for name, value in SMALL.items() if name in one.options.model_fields and one.name != "auto"}
    if one.name == "hybrid":
        small["pixels"] = 0
    yield small
    for name in one.options.model_fields.keys() - {option}:
        for value in choices(one.options(), name):
            if value is not None:
                yield small | {name: value}


@cache
def problem_for(name: str) -> ur.Problem:
    """That of a method, for all tests."""
    return problem(Posed if name in ("hybrid", "auto") else Spaces)


_trajectories: dict[tuple[str, str], dict[str, np.ndarray] | None] = {}
"""{(method, settings): last values}, None where the settings are refused: options meet one another in the contexts of both."""


def trajectory(one: Method, settings: dict[str, Any]) -> dict[str, np.ndarray]:
    key = one.name, repr(sorted(settings.items()))
    if key not in _trajectories:
        try:
            plan: Plan = one.plan(problem_for(one.name), settings)
            found = ur.optimize(plan.problem, plan.estimator, plan.optimizer, steps=STEPS, seed=1).last
        except InputError:
            found = None
        _trajectories[key] = None if found is None else dict(found)
    known = _trajectories[key]
    if known is None:
        raise InputError("refused")
    return known


CASES = [(name, option) for name, one in methods().items() for option in one.options.model_fields]


@pytest.mark.parametrize("everywhere", quick([False, True], False))
@pytest.mark.parametrize(("name", "option"), CASES)
def test_an_option_changes_the_run_or_is_refused(name: str, option: str, everywhere: bool) -> None:
    """In the first context that allows it, or in every one."""
    one, field, tested = method(name), method(name).options.model_fields[option], 0
    for context in contexts(one, option):
        try:
            context = one.with_effect(problem_for(name), context)
            own, without = context.get(option, field.default), trajectory(one, context)
        except InputError:
            continue
        changed, refused = False, False
        for value in others(one.options, option, field.default):
            try:
                found = trajectory(one, {**context, option: value}) if value != own else without
            except InputError:
                refused = True
            else:
                changed |= any(not np.array_equal(without[key], found[key]) for key in without)
        assert changed or refused, f"{option} has no effect with {context}"
        tested += 1
        if not everywhere:
            break
    assert tested


@pytest.mark.parametrize(
    ("name", "settings", "line"),
    [
        ("hybrid", {"beta_1": 0.5, "gradient": "coupled"}, "option beta_1 has no effect with gradient=coupled; it needs gradient=plain"),
        ("hybrid", {"space": "primary"}, "has no effect with image=plain and gradient=plain; it needs image=rcv or gradient=coupled"),
        ("smoothed", {"optimizer": "cma-es", "joint": False}, "it needs optimizer=newton-cg or optimizer=newton"),
        ("smoothed", {"optimizer": "adam", "iterations": 5}, "has no effect with optimizer=adam; it needs optimizer=newton-cg"),
        ("smoothed", {"optimizer": "cma-es", "sigma": "0.2, mapp=0.3"}, "sigma names mapp, which is not a parameter; did you mean map?"),
        ("adaptive", {"scheme": "uniform", "refresh": 3}, "has no effect with scheme=uniform; it needs scheme=adaptive or scheme=loss"),
        ("auto", {"coarse": False}, "option coarse has no effect with these options on this problem; leave it out"),
    ],
)  # fmt: skip
def test_a_refusal_says_what_the_option_needs(name: str, settings: dict[str, Any], line: str) -> None:
    with pytest.raises(InputError) as caught:
        method(name).plan(problem(Posed if name == "hybrid" else Spaces), settings)
    assert str(caught.value).startswith(f"method {name}: ")
    assert str(caught.value).endswith(line)
    assert "\n" not in str(caught.value)


def test_a_choice_that_the_method_makes_anyway_is_no_option_without_effect() -> None:
    own: Any = method("auto").plan(problem()).estimator
    assert method("auto").plan(problem(), {"spp": own.spp, "image": "rcv"}).estimator == own


def test_a_refusal_of_a_method_that_needs_no_problem_comes_before_it_is_loaded() -> None:
    with pytest.raises(InputError, match="option levels has no effect with scheme=loss; it needs scheme=adaptive"):
        method("adaptive").start({"scheme": "loss", "levels": 2})


@pytest.mark.parametrize(
    ("made", "line"),
    [
        (lambda: ur.PathGradient(ur.images.RecursiveControlVariate(whole_views=7)), "whole_views has no effect here; it needs pixel mini"),
        (lambda: ur.MetaEstimator(coupled=True, image=ur.images.RecursiveControlVariate(learn_from_draws=False)), "learn_from_draws has"),
        (lambda: ur.SmoothedDerivatives(0.1, joint=False), 'joint has no effect here; it needs order="hessian" or "hvp"'),
        (lambda: ur.SmoothedDerivatives(0.1, epsilon=0.1), "epsilon has no effect here"),
        (lambda: dataclasses.replace(ur.SmoothedDerivatives(0.1, order="hvp", epsilon=0.1), order="gradient"), ", or its default 0.3"),
    ],
)  # fmt: skip
def test_fields_of_components_that_nothing_reads_are_refused(made: Any, line: str) -> None:
    with pytest.raises(InputError) as caught:
        made()
    assert line in str(caught.value)


def test_options_of_a_registered_method_are_not_judged_by_how_its_parts_look() -> None:
    class Plain(Options):
        """two numbers that no part shows"""

        spp: int = 1

        def build(self) -> Any:
            return ur.PathGradient(), ur.optimizers.Adam()

    assert Method("plain parts", Plain).start({"spp": 2})[0] == ur.PathGradient()


@pytest.mark.parametrize("settings", [{"sigma": "0.2"}, {"sigma_schedule": "exponential(25,0.1)"}])
def test_a_text_that_asks_for_the_default_in_other_words_is_no_option_without_effect(settings: dict[str, Any]) -> None:
    made = problem()
    assert method("smoothed").plan(made, settings).estimator is not None


@pytest.mark.slow
@pytest.mark.mitsuba
def test_a_refusal_renders_little_more_than_the_plan(monkeypatch: pytest.MonkeyPatch) -> None:
    """It planned every choice of every option anew, and each plan rendered pictures of other places: a minute for one line."""
    made, count = ur.gallery.problem("mug", resolution=16), []
    render = MitsubaSession.image_batch

    def counted(*arguments: Any, **named: Any) -> Any:
        count.append(0)
        return render(*arguments, **named)

    monkeypatch.setattr(MitsubaSession, "image_batch", counted)
    method("auto").plan(made)
    once = len(count)
    with pytest.raises(InputError, match="has no effect"):
        method("auto").plan(made, {"tolerance": "3"})
    assert once > 0
    assert len(count) <= 3 * once
