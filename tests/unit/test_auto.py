"""What `auto` chooses, that it can be set, and that it copes with problems that have next to nothing to recover."""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import tomli_w

from tests.analytic import AnalyticRenderer
from unrender import images, losses, optimizers, pixels
from unrender.core.errors import InputError
from unrender.estimators.base import Estimate
from unrender.estimators.capabilities import Hessian, HessianNoise
from unrender.estimators.derivative_images import MOST_AVERAGED, cost
from unrender.estimators.emitter_selection import EmitterSelection
from unrender.estimators.gauss_newton import GaussNewton
from unrender.estimators.meta import MetaEstimator
from unrender.estimators.path import PathGradient
from unrender.estimators.path_then_newton import PathThenNewton
from unrender.estimators.smoothed import SmoothedDerivatives
from unrender.io import toml_lines
from unrender.methods import auto as module
from unrender.methods import method
from unrender.methods.paths import MetaMethod, SamplingOptions
from unrender.methods.plan import Plan
from unrender.methods.rules import newton, paths
from unrender.methods.rules.constants import CONSTANTS
from unrender.methods.rules.paths import first_rates
from unrender.methods.rules.traits import Traits, choose_image, renders_half
from unrender.preconditioners import LargeSteps, Sobolev
from unrender.rendering.parameter_errors import ErrorMeasure
from unrender.runs.optimize import optimize
from unrender.runs.reopen import resume
from unrender.scene.parameter import Parameter, ParameterSettings, Unknown
from unrender.scene.problem import Problem
from unrender.scene.references import View

SHAPE = (4, 4)
TRUTH = {"map": np.random.default_rng(0).uniform(0.2, 0.8, (3, 3, 1)), "gain": np.full(1, 200.0)}


def problem(loss: Any = None, shares_paths: bool = True, noise: float = 0.3, **options: Any) -> Problem:
    """A texture within bounds and a number without an upper one."""
    matrix = np.random.default_rng(1).uniform(0.0, 1.0, (SHAPE[0] * SHAPE[1] * 3, 10))
    matrix[:, -1] *= 1e-3
    renderer = AnalyticRenderer(TRUTH, matrix, 0.1, noise, shape=SHAPE, shares_paths=shares_paths)
    unknown = [
        Parameter("map", initial=0.5, bounds=(0, 1), **options),
        Parameter("gain", initial=100.0, bounds=(0, None)),
    ]
    return Problem(renderer, unknown, [View(renderer.exact(TRUTH))], loss=loss or losses.L2(), truth=TRUTH)


def constants(monkeypatch: pytest.MonkeyPatch, **other: Any) -> None:
    """Let `auto` use other numbers."""
    monkeypatch.setattr(module, "CONSTANTS", dataclasses.replace(CONSTANTS, **other))


def test_repeated_defaults_are_those_of_the_components() -> None:
    """Options repeat them, since they are checked without Dr.Jit."""
    assert (CONSTANTS.averaged_values, CONSTANTS.correlation) == (MOST_AVERAGED, Sobolev().correlation)
    own = {each.name: each.default for each in dataclasses.fields(MetaEstimator)}
    for name in ("beta_proportional", "beta_difference"):
        assert MetaMethod.model_fields[name].default == own[name]
    assert SamplingOptions.model_fields["emitters"].annotation == EmitterSelection


def chosen(made: Problem, **settings: Any) -> tuple[Any, Any]:
    choice = method("auto").plan(made, settings)
    return choice.estimator, choice.optimizer


@pytest.mark.parametrize("loss", [losses.L1(), losses.L2()])
def test_images_have_a_memory(loss: Any) -> None:
    estimator, _ = chosen(problem(loss))
    tolerance = 0.0 if loss.linear else CONSTANTS.tolerance
    fresh = {"spp": CONSTANTS.spp[1], "tolerance": tolerance, "fresh_from": CONSTANTS.fresh_from}
    memory = CONSTANTS.linear_memory if loss.linear else CONSTANTS.memory
    assert estimator == PathGradient(images.RecursiveControlVariate("path", max_weight=memory), **fresh)
    estimator, _ = chosen(problem(loss, shares_paths=False))
    assert estimator.image == images.RecursiveControlVariate("primary", max_weight=memory)
    assert chosen(problem(loss), image="plain", spp=6)[0] == PathGradient(spp=6, tolerance=tolerance)
    if loss.linear:
        with pytest.raises(InputError, match="method auto: option tolerance has no effect with these options on this"):
            chosen(problem(loss), tolerance=0)
    else:
        assert chosen(problem(loss), tolerance=0)[0].tolerance == 0
    reasons = method("auto").plan(problem(loss), {}).reasons
    assert any("damped where noise exceeds the residual" in line for line in reasons) == (not loss.linear)


def test_textures_are_smoothed_unless_they_have_a_preconditioner() -> None:
    _, optimizer = chosen(problem())
    assert (optimizer.preconditioner, optimizer.preconditioned) == (Sobolev(), ("map",))
    _, optimizer = chosen(problem(), correlation=1 / 32)
    assert optimizer.preconditioner == Sobolev(correlation=1 / 32)
    for made, settings in ((problem(preconditioner=LargeSteps(1.0)), {}), (problem(), {"smooth": False})):
        _, optimizer = chosen(made, **settings)
        assert (optimizer.preconditioner, optimizer.preconditioned) == (None, ())


def test_rates_are_shares_of_the_range_or_of_the_size() -> None:
    _, optimizer = chosen(problem(), parameterise=False)
    assert optimizer.learning_rate == pytest.approx({"*": 0.1, "map": 0.1, "gain": 10.0})
    assert optimizer.reparameterised == ()
    _, optimizer = chosen(problem(), learning_rate=0.02, parameterise=False)
    assert optimizer.learning_rate == pytest.approx({"*": 0.02, "map": 0.02, "gain": 2.0})
    state = optimizer.init(problem(learning_rate=0.5).initial(), problem(learning_rate=0.5).learning_rates)
    assert state.learning_rates == pytest.approx({"map": 0.5, "gain": 2.0})


def test_an_albedo_begins_slowly_beside_an_unknown_extinction() -> None:
    fog, haze = "fog.interior_medium.{}.data", "haze.interior_medium.{}.data"
    found = {fog.format("albedo"): 0.6, fog.format("sigma_t"): 2.0, haze.format("albedo"): 0.6}
    unknowns = {
        key: Unknown(
            Parameter(key),
            np.full((2, 2, 2, 1), value, np.float32),
            (0.0, None if "sigma_t" in key else 1.0),
            ErrorMeasure(),
        )
        for key, value in found.items()
    }
    known: Any = SimpleNamespace(unknowns=unknowns)
    assert list(first_rates(known, 0.1).values()) == pytest.approx([0.02, 0.2, 0.1])


def test_positive_numbers_move_as_logarithms() -> None:
    _, optimizer = chosen(problem())
    assert optimizer.reparameterised == ("gain",)
    assert method("auto").plan(problem()).settings["gain"].parameterisation == "log"
    assert optimizer.learning_rate == pytest.approx({"*": 0.1, "map": 0.1, "gain": 0.1})
    for change in (
        {"bounds": (0, 500)},
        {"bounds": None},
        {"learning_rate": 1.0},
        {"initial": 0.0},
        {"parameterisation": "identity"},
    ):
        base = problem()
        parameters = [dataclasses.replace(p, **change) if p.key == "gain" else p for p in base.parameters]
        other = Problem(base.renderer, parameters, base.original_views)
        assert chosen(other)[1].reparameterised == (), change


def test_a_run_with_logarithms_is_taken_up_where_it_stopped(tmp_path: Path) -> None:
    whole = optimize(problem(), "auto", steps=9)
    optimize(problem(), "auto", steps=4, run_directory=tmp_path)
    assert any(line == "parameterised as log (gain)" for line in whole.choices)
    for key, value in resume(tmp_path, problem(), steps=9).parameters.items():
        np.testing.assert_array_equal(value, whole.parameters[key])


def test_the_problem_is_kept_as_it_was_given() -> None:
    """What `auto` adds is the plan's: the problem of its run folder is anybody's."""
    given = problem()
    plan = method("auto").plan(given)
    assert plan.problem is given
    configured = plan.configured().unknowns
    assert [key for key, unknown in configured.items() if unknown.parameterisation is not None] == ["gain"]
    assert all(unknown.parameterisation is None for unknown in given.unknowns.values())


def test_a_step_has_so_many_paths(monkeypatch: pytest.MonkeyPatch) -> None:
    for number, spp in ((1, 2), (16, 2), (63, 2), (64, 4), (200, 8), (1 << 15, 16)):
        constants(monkeypatch, paths=number)
        assert chosen(problem())[0].spp == spp, number
    assert chosen(problem(), spp=5)[0].spp == 5
    assert chosen(problem())[1].wiener


def test_large_views_are_drawn_from(monkeypatch: pytest.MonkeyPatch) -> None:
    constants(monkeypatch, most_pixels=10, batch_pixels=5, batch_paths=20)
    estimator, optimizer = chosen(problem(losses.L1()))
    assert estimator.pixels == pixels.Uniform(5)
    assert estimator.spp == 4
    assert estimator.image == images.Plain()
    assert not optimizer.wiener
    assert chosen(problem(), pixels=7)[0].pixels == pixels.Uniform(7)


def test_it_says_what_it_has_chosen_and_why() -> None:
    said = method("auto").plan(problem(losses.L1())).reasons
    assert said[0].startswith("recursive control variates, 16 samples per pixel: earlier")
    assert said[1] == "L1 damped where noise exceeds the residual"
    assert said[2] == "Sobolev gradients of map"
    assert said[3] == "parameterised as log (gain)"
    assert said[4] == "schedule-free Adam, first rate 0.1 (map, gain)"
    assert method("rcv").plan(problem()).reasons == ()


def test_what_path_gradients_do_not_reach_is_smoothed(monkeypatch: pytest.MonkeyPatch) -> None:
    made = problem()

    def prepare(*given: Any) -> None:
        raise InputError("no path gradients of map")

    monkeypatch.setattr(made.renderer, "prepare", prepare)
    plan = method("smoothed").plan(made)
    assert chosen(made) == (plan.estimator, plan.optimizer)
    assert isinstance(plan.estimator, SmoothedDerivatives)
    assert plan.estimator.sigma == pytest.approx({"map": 0.2, "gain": 20.0})  # a gain of 50 without an upper bound
    (line,) = method("auto").plan(made).reasons
    assert line == "derivatives of a smoothed loss (method smoothed): no path gradients of map"


def test_it_is_what_runs_where_nothing_is_said(tmp_path: Path) -> None:
    made = problem(losses.L1())
    result = optimize(made, steps=400)
    assert result.method == "auto"
    before, after = (made.parameter_error(values) for values in (result.initial, result.parameters))
    assert after["map"] < 0.5 * before["map"]
    assert after["gain"] < 0.5 * before["gain"]
    whole = optimize(problem(losses.L1()), steps=30, run_directory=tmp_path / "whole")
    optimize(problem(losses.L1()), steps=17, run_directory=tmp_path / "part")
    ended = resume(tmp_path / "part", problem(losses.L1()), steps=30)
    for key, value in whole.parameters.items():
        np.testing.assert_array_equal(ended.parameters[key], value)
    assert isinstance(optimize(problem(), optimizer=optimizers.Adam(), steps=1).steps, int)


def test_it_is_stored_and_made_again() -> None:
    made = problem(losses.L1())
    plan = method("auto").plan(made)
    again = Plan.from_table(made, toml_lines.parse(tomli_w.dumps(plan.table()), "plan.toml"), "plan.toml")
    settings = {key: own for key, own in plan.settings.items() if own != ParameterSettings()}
    assert again == dataclasses.replace(plan, settings=settings, reasons=())
    first, second = (optimize(made, each, steps=5, progress=False) for each in (plan, again))
    for key, value in first.parameters.items():
        np.testing.assert_array_equal(second.parameters[key], value)


@pytest.mark.parametrize(
    ("table", "words"),
    [
        ({"estimator": "why not"}, "plan.toml: estimator: why not; pass it"),
        ({"estimator": {"type": "PathGradent"}}, 'plan.toml: estimator: unknown type "PathGradent"'),
        ({"estimator": {"type": "Adam"}}, "plan.toml: estimator: Adam is not an estimator"),
        ({"settings": {"map": {"colour": 1}}}, "plan.toml: settings: map: expected parameterisation"),
        ({"settings": {"map": {"preconditioner": {"type": "Adam"}}}}, "plan.toml: settings: map: "),
        ({"settings": {"map": {"coarse_to_fine": 3}}}, "plan.toml: settings: map: expected a table such as"),
        ({"settings": {"mop": {"start_factor": 2.0}}}, "plan.toml: settings: mop is not an unknown; did you mean"),
        ({"settings": 3}, "plan.toml: settings: expected a table of settings by key, got 3"),
        ({"settings": {"gain": 3}}, "plan.toml: settings: gain: expected parameterisation"),
        *(
            ({"settings": {"gain": {"start": start}}}, "plan.toml: settings: gain: start must be a")
            for start in (3, "a", "ab", {"x": 1}, [float("nan")], [float("inf")], ["a"], [True], [[1.0]])
        ),
        (
            {"settings": {"gain": {"start": [1e39]}}},
            "plan.toml: settings: gain: start must be at most 3.4e+38, got 1e+39",
        ),
        *(
            (
                {"settings": {"gain": {"start_factor": factor}}},
                "plan.toml: settings: gain: start_factor must be a finite number > 0",
            )
            for factor in ("ab", float("nan"), 0.0, -1.0, [1.0], True)
        ),
    ],
)
def test_a_plan_that_says_something_else_is_refused_in_one_line(table: Any, words: str) -> None:
    made = problem()
    with pytest.raises(InputError, match=re.escape(words)):
        Plan.from_table(made, method("plain").plan(made).table() | table, "plan.toml")


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"gain": {"start": []}}, "parameter gain: start: expected 1 numbers, got 0"),
        ({"gain": {"start": [1.0, 2.0]}}, "parameter gain: start: expected 1 numbers, got 2"),
        ({"gain": {"start": [-50.0]}}, "parameter gain: start: expected numbers of at least 0, got -50 to -50"),
        (
            {"map": {"start": [0.5] * 8 + [1.5]}},
            "parameter map: start: expected numbers of at least 0 and at most 1, got 0.5 to 1.5",
        ),
        ({"gain": {"start_factor": 1e38}}, "parameter gain: start_factor: 1e+38 times the initial value is infinite"),
        ({"gain": {"parameterisation": 3}}, "parameter gain: parameterisation: expected"),
    ],
)
def test_a_plan_with_an_unsuitable_start_is_refused_in_one_line(settings: Any, words: str) -> None:
    made = problem()
    plan = Plan.from_table(made, method("plain").plan(made).table() | {"settings": settings}, "plan.toml")
    for run in (plan.configured, lambda: optimize(made, plan, steps=1, progress=False)):
        with pytest.raises(InputError, match=re.escape(words)):
            run()


def test_a_start_of_a_plan_is_inside_the_bounds() -> None:
    made = problem()
    for settings in ({"start": [0.0] * 4 + [1.0] * 5}, {"start_factor": 8.0}):
        plan = Plan.from_table(made, method("plain").plan(made).table() | {"settings": {"map": settings}}, "plan.toml")
        begun = np.asarray(plan.configured().start()["map"])
        assert (begun > 0.0).all()
        assert (begun < 1.0).all()
        np.testing.assert_allclose(begun.max(), 1.0, atol=1e-3)


@pytest.mark.parametrize("loss", [losses.L1(), losses.L2(), losses.RelativeL2()])
@pytest.mark.parametrize("reference", [0.0, 1.0])
def test_pictures_without_anything_in_them(loss: Any, reference: float) -> None:
    """A black reference pulls all to the lower bound; nothing ceases to be finite."""
    made = problem(loss)
    made = Problem(
        made.renderer,
        made.parameters,
        [View(np.full((*SHAPE, 3), reference, np.float32))],
        loss=loss,
    )
    result = optimize(made, steps=60)
    assert result.skipped == 0
    assert all(np.isfinite(value).all() for value in result.parameters.values())


def test_one_unknown_number() -> None:
    renderer = AnalyticRenderer({"x": np.zeros(1)}, np.ones((3, 1)), 0.0, 0.05, shape=(1, 1))
    made = Problem(renderer, [Parameter("x", initial=0.0)], [View(renderer.exact({"x": np.full(1, 0.7)}))])
    result = optimize(made, steps=300)
    assert abs(float(result.parameters["x"][0]) - 0.7) < 0.02


def test_textures_of_one_material_share_the_rate() -> None:
    """Base colour and roughness of the pot divide it by √2; the wall has all of it, and a number 0.3 of it."""
    values = {
        "pot.bsdf.base_color.data": np.full((4, 4, 3), 0.5),
        "pot.bsdf.roughness.data": np.full((4, 4, 1), 0.5),
        "pot.bsdf.metallic.value": np.full(1, 0.5),
        "wall.bsdf.reflectance.data": np.full((4, 4, 3), 0.5),
    }
    count = sum(value.size for value in values.values())
    renderer = AnalyticRenderer(values, np.ones((SHAPE[0] * SHAPE[1] * 3, count)), 0.1, 0.0, shape=SHAPE)
    unknown = [Parameter(key, initial=0.5, bounds=(0, 1)) for key in values]
    made = Problem(renderer, unknown, [View(renderer.exact(values))])
    _, optimizer = chosen(made)
    rates = [optimizer.learning_rate[key] for key in values]
    assert rates == pytest.approx([0.1 / 2**0.5, 0.1 / 2**0.5, 0.03, 0.1])


@pytest.mark.parametrize("loss", [losses.L1(), losses.L2()])
def test_mini_batches_of_views_are_damped_as_whole_views_are(loss: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Those of pixels here and there are not: their noise is not known."""
    for sampler, damped in ((pixels.All(), True), (pixels.Views(1), True), (pixels.Uniform(4), False)):
        monkeypatch.setattr(paths, "choose_sampler", lambda traits, sampler=sampler: (sampler, ""))
        expected = CONSTANTS.tolerance if damped and not loss.linear else 0.0
        assert chosen(problem(loss))[0].tolerance == expected


def test_images_of_meshes_have_a_memory_where_noise_biases_the_loss() -> None:
    """And where a step shows half of the views."""

    def image(loss: Any, sampler: Any) -> str:
        made = problem(loss)
        unknowns = {**made.unknowns, "map": dataclasses.replace(made.unknowns["map"], faces=np.zeros((0, 3)))}
        moving = made.with_parts(unknowns=unknowns)
        return type(choose_image(Traits(moving, module.AutoMethod.model_validate({}), CONSTANTS), sampler)[0]).__name__

    for loss, name in (
        (losses.L1(), "RecursiveControlVariate"),
        (losses.Huber(), "RecursiveControlVariate"),
        (losses.L2(), "Plain"),
    ):
        assert image(loss, pixels.All()) == name
    assert image(losses.L1(), pixels.Uniform(4)) == "Plain"
    many: Any = SimpleNamespace(views=[None] * 16)
    samplers = (pixels.All(), pixels.Views(8), pixels.Views(7), pixels.Uniform(4))
    assert [renders_half(many, sampler) for sampler in samplers] == [True, True, False, False]


def test_few_numbers_that_change_the_pictures_form_take_gauss_newton_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    matrix = np.random.default_rng(1).uniform(0.0, 1.0, (48, 4))
    truth = {"place": np.full(3, 0.4), "gain": np.full(1, 0.5)}
    renderer = AnalyticRenderer(truth, matrix, 0.1, 0.3, shape=SHAPE)
    unknown = [Parameter(key, initial=0.2) for key in truth]
    made = Problem(renderer, unknown, [View(renderer.exact(truth))], truth=truth)
    assert isinstance(chosen(made)[0], PathThenNewton)
    known = renderer.parameters()
    formed = dict(known) | {"place": dataclasses.replace(known["place"], nonlinear=True)}
    monkeypatch.setattr(AnalyticRenderer, "parameters", lambda self: formed)
    plan = method("auto").plan(made)
    samples = 4 * CONSTANTS.number_spp[1], 4 * CONSTANTS.difference_spp[1]  # 16 pixels have the paths of 64
    expected = GaussNewton(*samples, noise_limit=CONSTANTS.noise_limit, remember=True)
    assert plan.estimator == expected
    constants(monkeypatch, number_paths=0, number_spp=(4, 1 << 20))  # as on a large film
    renders = 2 * 4 * samples[1]
    assert chosen(made)[0].spp == cost(renders * made.pixels, 16) // made.pixels, "an image takes less than differences"
    constants(monkeypatch)
    lit = {key: dataclasses.replace(info, nonlinear=True, brightness="light") for key, info in known.items()}
    formed.update(lit)
    assert method("auto").plan(made).estimator == expected, "lights alone are weighted as BSDFs"
    formed["place"] = dataclasses.replace(lit["place"], scattering="bsdf")
    by_channel = dataclasses.replace(expected, noise_limit=CONSTANTS.bsdf_noise_limit, by_channel=True)
    assert method("auto").plan(made).estimator == by_channel
    formed.update(dict(known) | {"place": dataclasses.replace(known["place"], nonlinear=True)})
    assert isinstance(plan.optimizer, optimizers.AveragedNewton)
    assert "4 numbers" in plan.reasons[0]
    assert "not linear in place" in plan.reasons[0]
    for settings in ({"image": "plain"}, {"pixels": 8}):
        assert isinstance(chosen(made, **settings)[0], PathGradient)
    constants(monkeypatch, few_numbers=3)
    assert isinstance(chosen(made)[0], PathGradient)
    monkeypatch.undo()
    result = optimize(made, plan, steps=40, progress=False)
    assert result.status == "finished"
    assert all(error < 0.05 for error in made.parameter_error(result.parameters).values())


@pytest.mark.parametrize(
    ("small", "reached", "newton"), [(True, True, True), (False, True, False), (False, False, True)]
)
def test_numbers_of_bsdfs_take_gauss_newton_steps_on_small_films_or_without_path_gradients(
    monkeypatch: pytest.MonkeyPatch, small: bool, reached: bool, newton: bool
) -> None:
    """The limit is the size of this film, or just below. Without a roughness there are path gradients."""
    matrix = np.random.default_rng(1).uniform(0.0, 1.0, (SHAPE[0] * SHAPE[1] * 3, 4))
    renderer = AnalyticRenderer({"rough": np.full(1, 0.4), "colour": np.full(3, 0.5)}, matrix, 0.1, 0.3, shape=SHAPE)
    unknown = [Parameter(key, initial=0.2) for key in ("rough", "colour")]
    made = Problem(renderer, unknown, [View(np.full((*SHAPE, 3), 0.5))])
    constants(monkeypatch, bsdf_pixels=4 * SHAPE[0] * SHAPE[1] - (0 if small else 1))
    if not reached:
        monkeypatch.setattr("unrender.methods.rules.traits.refusal", lambda problem: "no path gradient of rough")
    else:
        assert isinstance(chosen(made)[0], PathThenNewton)
    known = dict(renderer.parameters())
    known["rough"] = dataclasses.replace(known["rough"], scattering="bsdf")
    known["colour"] = dataclasses.replace(known["colour"], brightness="reflectance")
    monkeypatch.setattr(AnalyticRenderer, "parameters", lambda self: known)
    plan = method("auto").plan(made)
    assert isinstance(plan.estimator, GaussNewton) == newton
    assert ("not linear in rough" in plan.reasons[0]) == newton
    absolute = Problem(renderer, unknown, made.views, loss=losses.L1())
    assert isinstance(chosen(absolute)[0], GaussNewton) != reached
    assert isinstance(chosen(absolute)[0], PathGradient) == reached
    one = Problem(renderer, unknown[:1], made.views)
    assert isinstance(chosen(one)[0], PathGradient) == reached


LIT = {
    "map": np.random.default_rng(2).uniform(0.2, 0.8, (3, 3, 1)),
    "sky": np.full((2, 2, 1), 3.0),
    "lamp": np.array([4.0]),
}


def lit(monkeypatch: pytest.MonkeyPatch, sky: float, lamp: float, bounded: bool = False) -> Problem:
    """A texture, a light with texels and a lamp, whose images are linear in both lights."""
    matrix = np.random.default_rng(1).uniform(0.0, 1.0, (SHAPE[0] * SHAPE[1] * 3, 14))
    matrix[:, :9] *= 0.2
    renderer = AnalyticRenderer(LIT, matrix, 0.0, 0.3, shape=SHAPE)
    lights = {key: dataclasses.replace(renderer.parameters()[key], brightness="light") for key in ("sky", "lamp")}
    known = dict(renderer.parameters()) | lights
    monkeypatch.setattr(AnalyticRenderer, "parameters", lambda self: known)
    bounds = (0, 100) if bounded else (0, None)
    unknown = [
        Parameter("map", initial=0.5, bounds=(0, 1)),
        Parameter("sky", initial=sky, bounds=bounds),
        Parameter("lamp", initial=lamp, bounds=bounds),
    ]
    return Problem(renderer, unknown, [View(renderer.exact(LIT))], truth=LIT)


@pytest.mark.parametrize(("sky", "lamp"), [(30.0, 40.0), (0.3, 0.4), (30.0, 0.4), (3.0, 40.0)])
def test_lights_far_from_the_references_start_at_a_multiple(
    sky: float, lamp: float, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    made = lit(monkeypatch, sky, lamp)
    plan = method("auto").plan(made)
    assert any(reason.startswith("lights start by least squares: ") for reason in plan.reasons)
    factors = {key: own.start_factor or 0.0 for key, own in plan.settings.items()}
    assert factors.pop("map") == 0.0
    np.testing.assert_allclose([factors["sky"], factors["lamp"]], [3.0 / sky, 4.0 / lamp], rtol=0.15)
    whole = optimize(made, plan, steps=6, run_directory=tmp_path / "whole")
    begun = optimize(made, plan, steps=3, run_directory=tmp_path / "part")
    np.testing.assert_allclose(begun.initial["sky"], 3.0, rtol=0.15)
    np.testing.assert_array_equal(resume(tmp_path / "part", made, steps=6).parameters["sky"], whole.parameters["sky"])


def test_lights_that_are_near_or_bounded_start_where_they_were_asked_to(monkeypatch: pytest.MonkeyPatch) -> None:
    for made in (lit(monkeypatch, 2.0, 6.0), lit(monkeypatch, 30.0, 40.0, bounded=True)):
        assert all(own.start_factor is None for own in method("auto").plan(made).settings.values())


def test_a_light_that_suits_the_loss_keeps_its_start(monkeypatch: pytest.MonkeyPatch) -> None:
    """A light that is far too bright for the squared difference from saturated references has no censored loss."""
    given = lit(monkeypatch, 3.0, 40.0)
    values = {**LIT, "map": np.full((3, 3, 1), 0.5), "lamp": np.array([40.0])}
    renderer: Any = given.renderer
    reference, reasons = np.minimum(renderer.exact(values), 1.0), {}
    for loss in (losses.L2(), losses.Censored(losses.L2(), 1.0)):
        made = given.replaced(views=[View(reference)], loss=loss)
        reasons[made.loss] = method("auto").plan(made).reasons
    starts = [any(reason.startswith("lights start") for reason in each) for each in reasons.values()]
    assert starts == [True, False]


def test_cameras_take_gauss_newton_steps_unless_images_or_pixels_are_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    known = AnalyticRenderer(TRUTH, np.ones((48, 10)), shape=SHAPE).parameters()
    rigid = {key: dataclasses.replace(of, viewpoint=True, rigid=True) for key, of in known.items()}
    monkeypatch.setattr(AnalyticRenderer, "parameters", lambda self: rigid)
    estimator, optimizer = chosen(problem())
    spp = 4 * CONSTANTS.image_spp[1]  # 16 pixels have the paths of 64
    largest: dict[str, float] = dict.fromkeys(("map", "gain"), 0.2 * CONSTANTS.pose_reach)
    assert estimator == GaussNewton(spp, spp // CONSTANTS.per_derivative, largest=largest)
    assert isinstance(optimizer, optimizers.AveragedNewton)
    assert chosen(problem(losses.L1()), tolerance=3, spp=40)[0] == GaussNewton(40, 5, tolerance=3.0, largest=largest)
    for settings in ({"image": "plain"}, {"pixels": 8}):
        assert isinstance(chosen(problem(), **settings)[1], optimizers.Adam)


def test_curvature_that_is_noise_does_not_hide_what_other_directions_explain() -> None:
    """At the best place of `box2` at 32² one direction had the curvature -1.6e-13: "-396205 of the loss explained"."""
    matrices = (
        Hessian(np.array([[0.5, -4e-10], [-4e-10, -8e-14]])),
        HessianNoise(np.diag([0.05, 2.0])),
    )
    gradient = {"x": np.array([0.02, 0.01])}

    class Noisy:
        def init(self, *_: Any) -> None: ...

        def estimate(self, *_: Any) -> tuple[Estimate, None]:
            return Estimate(0.0005, gradient, matrices, {"images": {0: np.zeros((1, 1, 3))}}), None

    class OfLoss:
        def loss_value(self, *_: Any) -> Any:
            return np.float64(0.0005)

    explained: Any = newton._explained
    assert explained(gradient, OfLoss(), Noisy()) == pytest.approx(0.8)
