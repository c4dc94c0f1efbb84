"""Parameterisations: the maps against closed forms, the chain rule against finite differences, descents that do not see the unit."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import drjit as dr
import numpy as np
import pytest
from drjit.auto import Float

import unrender as ur
from tests.analytic import AnalyticRenderer
from tiers import slow
from unrender.core import registry, trees
from unrender.core.random import Key
from unrender.estimators.base import Estimate
from unrender.estimators.capabilities import (
    FreshGradient,
    Hessian,
    HessianProduct,
    LossFunction,
    Smoothing,
    Variance,
)
from unrender.estimators.coordinates import by_coordinates
from unrender.parameterisations import Identity, Log
from unrender.scene.fingerprint import fingerprint

MAPS = {
    "log": (Log(), (0.0, None), lambda u: np.exp(u)),
    "log from 2": (Log(), (2.0, None), lambda u: 2.0 + np.exp(u)),
}
START = np.full(3, 0.5)


def problem(
    parameterisation: Any,
    bounds: Any = (0.0, None),
    scale: float = 1.0,
    initial: Any = 0.5,
    loss: Any = None,
    noise: float = 0.0,
    rate: float | None = None,
    preconditioner: Any = None,
) -> ur.Problem:
    """A vector and a texture, `scale` times as large as they are for 1, in images that do not depend on it."""
    random = np.random.default_rng(3)
    truth = {"colour": scale * random.uniform(0.3, 0.9, 3), "map": scale * random.uniform(0.3, 0.9, (2, 2, 1))}
    matrix = random.uniform(0.0, 1.0, (48, 7)) / scale
    renderer = AnalyticRenderer(truth, matrix, 0.1, noise, shape=(4, 4))
    start = initial * scale if isinstance(initial, float) else initial
    parameters = [
        ur.Parameter("colour", start, bounds, rate, parameterisation=parameterisation),
        ur.Parameter("map", start, bounds, rate, preconditioner, parameterisation=parameterisation),
    ]
    return ur.Problem(renderer, parameters, [ur.View(renderer.exact(truth))], loss or ur.losses.L2(), truth=truth)


def loss_of(found: ur.Problem, parameters: dict[str, Any]) -> float:
    assert isinstance(found.renderer, AnalyticRenderer)
    return float(found.loss_value(0, found.renderer.exact(parameters)))


@pytest.mark.parametrize("name", MAPS)
def test_maps_are_what_they_say_and_invert_themselves(name: str) -> None:
    given, bounds, formula = MAPS[name]
    found = given.transform(bounds, START)
    u = np.linspace(-9.0, 9.0, 181)
    x = found.forward(u)
    np.testing.assert_allclose(x, formula(u), rtol=1e-6)
    np.testing.assert_allclose(found.inverse(x), u, atol=1e-6)
    h = 1e-5
    slope = (formula(u + h) - formula(u - h)) / (2 * h)
    np.testing.assert_allclose(found.slope(x), slope, rtol=1e-5)
    h = 1e-3
    curvature = (formula(u + h) - 2 * formula(u) + formula(u - h)) / h**2
    np.testing.assert_allclose(found.curvature(x), curvature, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("name", MAPS)
def test_far_away_nothing_overflows(name: str) -> None:
    given, bounds, _ = MAPS[name]
    with np.errstate(all="raise", under="ignore"):
        x = given.transform(bounds, START).forward(np.array([-1e4, 1e4], np.float32))
    assert np.isfinite(x).all()
    assert x[0] <= x[1]
    assert x[0] >= (bounds[0] if bounds[0] is not None else -np.inf)


@pytest.mark.mitsuba
@pytest.mark.parametrize("name", MAPS)
def test_the_device_agrees(name: str) -> None:
    given, bounds, _ = MAPS[name]
    found = given.transform(bounds, START)
    u = np.linspace(-6.0, 6.0, 50, dtype=np.float32)
    x = found.forward(Float(u))
    np.testing.assert_allclose(x.numpy(), found.forward(u), rtol=2e-6, atol=1e-6)
    for method in (found.inverse, found.slope, found.curvature):
        np.testing.assert_allclose(method(x).numpy(), method(x.numpy()), rtol=2e-4, atol=2e-6)
    assert dr.is_array_v(found.inverse(x))


def test_the_identity_changes_nothing() -> None:
    plain, given = (
        ur.optimize(problem(p), ur.PathGradient(spp=2), steps=20, optimizer=ur.optimizers.Adam())
        for p in (None, "identity")
    )
    for key in plain.parameters:
        np.testing.assert_array_equal(plain.parameters[key], given.parameters[key])


@pytest.mark.parametrize(("name", "bounds"), [("log", (0, None)), ("log", (0, 2))])
def test_derivatives_are_those_of_finite_differences(name: str, bounds: Any) -> None:
    found = problem(name, bounds)
    random = np.random.default_rng(1)
    x = {key: random.uniform(0.2, 1.2, shape) for key, shape in found.shapes().items()}
    gradient, hessian = _derivatives(found, x)
    estimate = Estimate(
        loss_of(found, x),
        gradient,
        (
            Variance({key: g * g for key, g in gradient.items()}),
            FreshGradient(gradient),
            Hessian(hessian),
            HessianProduct(lambda v: _unflat(hessian @ _flat(v), x)),
            LossFunction(lambda points: np.array([loss_of(found, _unflat(point, x)) for point in points])),
            Smoothing({"colour": 0.1, "map": 0.2}),
        ),
    )
    made = by_coordinates(estimate, found, x)
    start = _flat(found.coordinates.of(x))

    def at(u: np.ndarray) -> float:
        transforms = found.coordinates.transforms
        return loss_of(found, {key: transforms[key].forward(part) for key, part in _unflat(u, x).items()})

    h, unit = 1e-3, np.eye(len(start))
    first = np.array([(at(start + h * e) - at(start - h * e)) / (2 * h) for e in unit])
    second = np.array([
        [
            (at(start + h * (e + f)) - at(start + h * (e - f)) - at(start - h * (e - f)) + at(start - h * (e + f))) / (4 * h * h)
            for f in unit
        ]
        for e in unit
    ])  # fmt: skip
    np.testing.assert_allclose(_flat(made.gradient), first, rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(_flat(made.require("test", FreshGradient).values), first, rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(_flat(made.require("test", Variance).values), first**2, rtol=1e-3, atol=1e-8)
    np.testing.assert_allclose(made.require("test", Hessian).matrix, second, rtol=2e-3, atol=2e-5)
    v = random.normal(size=len(start))
    product = made.require("test", HessianProduct).apply(_unflat(v, x))
    np.testing.assert_allclose(_flat(product), second @ v, rtol=2e-3, atol=1e-4)
    losses = made.require("test", LossFunction).evaluate(np.stack([start, start + 0.3]))
    np.testing.assert_allclose(losses, [at(start), at(start + 0.3)], rtol=1e-6)
    slopes = found.coordinates.slopes(x)
    sigma = made.require("test", Smoothing).sigma
    transform = found.coordinates.transforms["map"]
    steepest = np.max([transform.slope(x["map"] + shift) for shift in (-0.2, 0.0, 0.2)], axis=0)
    np.testing.assert_allclose(np.asarray(sigma["map"]) * steepest, 0.2)
    assert (np.asarray(sigma["map"]) * slopes["map"] > 0.1).all(), "hardly less than by the slope here"
    assert by_coordinates(made, found, x) is made, "a second time it would be transformed twice"


def _flat(tree: Any) -> np.ndarray:
    return np.concatenate([np.ravel(x) for x in tree.values()])


def _unflat(vector: np.ndarray, like: dict[str, Any]) -> dict[str, Any]:
    return {"colour": vector[:3], "map": vector[3:].reshape(like["map"].shape)}


def _derivatives(found: ur.Problem, x: dict[str, Any]) -> tuple[dict[str, Any], np.ndarray]:
    """Of the exact L2 loss by x."""
    renderer = found.renderer
    assert isinstance(renderer, AnalyticRenderer)
    residual = (renderer.exact(x) - np.asarray(found.views[0].reference)).reshape(-1)
    gradient = 2 * residual @ renderer.matrix / residual.size
    return _unflat(gradient, x), 2 * renderer.matrix.T @ renderer.matrix / residual.size


def test_a_gradient_that_is_not_transformed_would_be_noticed(monkeypatch: pytest.MonkeyPatch) -> None:
    found = problem("log")
    monkeypatch.setattr(type(found.coordinates), "slopes", lambda self, parameters: {})
    with pytest.raises(AssertionError):
        test_derivatives_are_those_of_finite_differences("log", (0, None))


@pytest.mark.parametrize("method", ["adam", "auto"])
def test_the_unit_does_not_matter(method: str) -> None:
    """With all values, and the unit of the images' derivatives, times c, the descent is that times c: exactly for a power of 2."""
    results = []
    for c in (1.0, 1024.0):
        found = problem("log", scale=c)
        if method == "adam":
            adam = ur.optimizers.Adam(0.05, epsilon=1e-30)
            results.append(ur.optimize(found, ur.PathGradient(spp=2), adam, steps=30).parameters)
        else:
            results.append(ur.optimize(found, "auto", steps=30).parameters)
    for key, values in results[0].items():
        assert abs(values - 0.5).max() > 0.05
        np.testing.assert_allclose(results[1][key] / 1024.0, values, rtol=2e-3)


def test_the_unit_would_matter_without() -> None:
    moved = [
        np.abs(
            ur.optimize(problem(None, scale=c), ur.PathGradient(spp=2), ur.optimizers.Adam(0.05), steps=10).parameters[
                "map"
            ]
            / c
            - 0.5
        )
        for c in (1.0, 1024.0)
    ]
    assert moved[1].max() < 0.01 * moved[0].max()


@pytest.mark.parametrize("start", ["edges", *(pytest.param(x, marks=pytest.mark.slow) for x in (0.0, 2.0, 1))])
def test_values_on_a_bound_come_off_it(start: Any) -> None:
    """Where u is infinite, the loop's margin keeps it finite."""
    random = np.random.default_rng(3)
    truth = {"x": random.uniform(0.5, 1.5, (3,))}
    renderer = AnalyticRenderer(truth, np.eye(48, 3), 0.1, 0.0, shape=(4, 4))
    initial = [0.0, 2.0, 1.0] if start == "edges" else start
    one = ur.Parameter("x", initial, (0, 2), parameterisation="log")
    found = ur.Problem(renderer, [one], [ur.View(renderer.exact(truth))], ur.losses.L2(), truth=truth)
    result = ur.optimize(found, ur.PathGradient(spp=2), ur.optimizers.Adam(0.2), steps=200)
    np.testing.assert_allclose(result.parameters["x"], truth["x"], atol=0.02)


def test_a_start_on_a_bound_is_told_of() -> None:
    found = problem("log", initial=0.0)
    assert found.notices == [
        "parameter colour: 3 of 3 initial values are at a bound, which log leaves slowly",
        "parameter map: 4 of 4 initial values are at a bound, which log leaves slowly",
    ]
    assert problem("log").notices == problem(None, initial=0.0).notices == []


def test_a_single_number() -> None:
    renderer = AnalyticRenderer({"x": np.array(5000.0)}, np.ones((48, 1)) / 5000, 0.0, 0.0, shape=(4, 4))
    one = ur.Parameter("x", 50, (0, None), parameterisation="log")
    found = ur.Problem(renderer, [one], [ur.View(renderer.exact({"x": np.array(5000.0)}))])
    result = ur.optimize(found, ur.PathGradient(spp=2), ur.optimizers.Adam(0.1), steps=150)
    assert result.parameters["x"] == pytest.approx(5000.0, rel=0.01)


def test_elements_without_a_step_keep_their_value() -> None:
    found = problem("log", (0, 2))
    x = {key: np.random.default_rng(0).uniform(0, 2, shape).astype(np.float32) for key, shape in found.shapes().items()}
    _, after = found.coordinates.moved(x, trees.zeros_like(x))
    for key, value in x.items():
        np.testing.assert_array_equal(after[key], value)


def test_preconditioners_act_on_the_variable() -> None:
    smooth = ur.preconditioners.LargeSteps(1.0)
    found = problem("log", preconditioner=smooth)
    x = {"colour": np.array([0.2, 0.5, 1.0]), "map": np.array([0.1, 0.4, 0.9, 1.6]).reshape(2, 2, 1)}
    g = {"colour": np.ones(3), "map": np.arange(4.0).reshape(2, 2, 1)}
    slopes = found.coordinates.slopes(x)
    np.testing.assert_allclose(
        found.coordinates.pull_back(g, slopes)["map"], smooth.apply(x["map"] * g["map"]), rtol=1e-6
    )
    forward = found.coordinates.push_forward(g, slopes)
    np.testing.assert_allclose(forward["map"], x["map"] * smooth.apply(g["map"]), rtol=1e-6)
    _, moved = found.coordinates.moved(x, g)
    np.testing.assert_allclose(moved["map"], x["map"] * np.exp(smooth.apply(g["map"])), rtol=1e-6)


@pytest.mark.parametrize("coupled", [False, True])
def test_meta_estimates_are_of_the_variable(coupled: bool) -> None:
    """Without noise they are exact at every step of a drift, with the chain rule at each of the two states."""
    found = problem("log")
    estimator = ur.MetaEstimator(coupled=coupled)
    x = found.initial()
    state = estimator.init(found, x)
    for step in range(4):
        estimate, state = estimator.estimate(found, x, state, Key(0, step))
        exact = found.coordinates.pull_back(_derivatives(found, x)[0], found.coordinates.slopes(x))
        for key, value in exact.items():
            np.testing.assert_allclose(estimate.gradient[key], value, rtol=1e-4, atol=1e-9)
        x = {key: value * 1.1 for key, value in x.items()}


@pytest.mark.parametrize(
    "optimizer",
    [ur.optimizers.ScheduleFree(0.1), slow(ur.optimizers.Adam(0.05)), slow(ur.optimizers.SGD(0.05, momentum=0.5))],
    ids=repr,
)
def test_a_resumed_run_is_the_uninterrupted_one(optimizer: Any, tmp_path: Path) -> None:
    chosen = {"estimator": ur.PathGradient(spp=2), "optimizer": optimizer, "seed": 3}
    whole = ur.optimize(problem("log", (0, 2), noise=0.5), steps=9, **chosen)
    ur.optimize(problem("log", (0, 2), noise=0.5), steps=4, run_directory=tmp_path / "run", **chosen)
    with pytest.raises(ur.InputError, match="parameterisation"):
        ur.resume(tmp_path / "run", problem(None, (0, 2), noise=0.5), steps=9)
    again = ur.resume(tmp_path / "run", problem("log", (0, 2), noise=0.5), steps=9)
    for key, values in whole.parameters.items():
        np.testing.assert_array_equal(again.parameters[key], values)


def test_the_fingerprint_has_it() -> None:
    known = fingerprint(problem("log"))
    assert known["parameter map: parameterisation"] == "Log()"
    assert not any("parameterisation" in part for part in fingerprint(problem(None)))


@pytest.mark.parametrize("method", ["auto", "plain"])
def test_what_a_method_chose_names_it(method: str) -> None:
    said = ur.optimize(problem("log"), method, steps=1).choices
    assert "parameterised as log (colour, map)" in said


@pytest.mark.parametrize("name", ["identity", "log"])
def test_each_is_registered(name: str) -> None:
    made = registry.components("parameterisation")[name.capitalize()]
    assert made in (Identity, Log)
    assert problem(made(), (0, 2)).unknowns["map"].parameterisation == made()


@pytest.mark.parametrize(
    ("given", "bounds", "message"),
    [
        ("lgo", (0, 1), r"unknown 'lgo'; did you mean log"),
        ("log", (None, 1), r"log needs a lower bound, got bounds open to 1; give bounds, such as \[0, inf\]"),
        ("log", None, r"log needs a lower bound, got bounds open to open"),
        (3, (0, 1), "expected one of unrender.parameterisations, or its name, got 3"),
        (Log, (0, 1), "expected one of unrender.parameterisations"),
        ("log(1)", (0, 1), r"expected log\(\), got 'log\(1\)'"),
        ({"type": "Log", "skale": 1}, (0, 1), "Log has no option skale"),
    ],
)  # fmt: skip
def test_bad_ones_are_one_line(given: Any, bounds: Any, message: str) -> None:
    with pytest.raises(ur.InputError, match=message) as error:
        problem(given, bounds)
    assert "\n" not in str(error.value)
    assert "parameter colour: parameterisation" in str(error.value)


@pytest.mark.parametrize("name", ["inverse", "slope", "curvature", "forward", "transform"])
def test_a_map_of_ones_own_that_is_not_consistent_is_refused(name: str) -> None:
    """A slope that is five times too large, or a wrong inverse, passed: the run ended as worse than its start, or with wrong errors."""
    transform: Any = Log().transform((0.0, 1.0), START)
    right: Any = getattr(transform, name, None)
    wrong = (lambda v: 5.0 * right(v) + 1.0) if name != "forward" else (lambda v: right(-v))
    mine: Any = type(
        "Mine",
        (),
        {each: staticmethod(getattr(transform, each)) for each in ("forward", "inverse", "slope", "curvature")},
    )
    setattr(mine, name, staticmethod(wrong))
    rule = type("Rule", (), {"transform": lambda self, bounds, initial: 3 if name == "transform" else mine()})()
    message = "its transform, 3, fails" if name == "transform" else "Mine.(inverse|slope|curvature) does not belong"
    with pytest.raises(ur.InputError, match=f"parameter colour: parameterisation: {message}"):
        problem(rule, (0, 1))
