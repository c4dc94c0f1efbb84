"""Methods by name: their options, and the words for wrong ones."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from tests.analytic import AnalyticRenderer
from unrender import Parameter, Problem, View, pixels, schedules
from unrender.core.errors import InputError
from unrender.estimators.loss_values import LossValues
from unrender.estimators.meta import MetaEstimator
from unrender.estimators.path import PathGradient, StockGradient
from unrender.estimators.smoothed import SmoothedDerivatives
from unrender.images import Plain, RecursiveControlVariate
from unrender.methods.base import method, methods, parse_schedule
from unrender.optimizers import CMAES, LBFGS, Adam, MetaAdam, Newton, NewtonCG


@pytest.mark.parametrize("name", methods())
def test_every_method_starts_with_its_defaults_and_documents_them(name: str):
    made = method(name)
    estimator, optimizer = made.start()
    assert optimizer.requires <= estimator.provides
    assert made.summary
    for option, field in made.options.model_fields.items():
        assert field.description
        assert not field.is_required()
        assert made.expected(option)


def test_plain_takes_its_options():
    estimator, optimizer = method("plain").start({"spp": "16", "learning_rate": "0.5", "schedule": "cosine(10, 0.25)"})
    assert estimator == PathGradient(Plain(), spp=16)
    assert optimizer == Adam(0.5, schedule=schedules.Cosine(10, 0.25))


def test_rcv_takes_its_options():
    options = {"spp": 3, "adjoint_spp": "1", "space": "primary", "alpha": 0.5, "beta": "0.75", "beta_1": "0.8"}
    estimator, optimizer = method("rcv").start(options)
    assert estimator == PathGradient(RecursiveControlVariate("primary", 0.5, 0.75), spp=3, adjoint_spp=1)
    assert optimizer == Adam(beta_1=0.8)
    estimator, _ = method("rcv").start({"spp": 4, "counts": "adaptive"})
    assert estimator == PathGradient(RecursiveControlVariate(), pixels.AdaptiveCounts(), spp=4)


def test_meta_and_coupled_take_their_options():
    estimator, optimizer = method("meta").start(
        {
            "proportional_spp": "4",
            "difference_spp": 2,
            "beta_difference": "0.5",
            "schedule": "cosine(10)",
            "difference_images": "proportional",
        }
    )
    assert estimator == MetaEstimator(4, 2, beta_difference=0.5, difference_images="proportional")
    assert optimizer == MetaAdam(0.002, schedule=schedules.Cosine(10))
    estimator, optimizer = method("coupled").start(
        {"spp": 6, "image": "rcv", "space": "primary", "optimizer": "adam", "learning_rate": 0.1}
    )
    assert estimator == MetaEstimator(coupled=True, spp=6, image=RecursiveControlVariate("primary"), space="primary")
    assert optimizer == Adam(0.1)


def test_adaptive_takes_its_options():
    estimator, optimizer = method("adaptive").start(
        {"pixels": "512", "levels": 0, "refresh": "10", "learning_rate": 0.1}
    )
    assert estimator == PathGradient(pixels=pixels.Adaptive(512, 0, 10), spp=2)
    assert optimizer == Adam(0.1)
    estimator, _ = method("adaptive").start({"scheme": "loss", "uniform": 0.5, "image": "rcv", "whole_views": 7})
    image = RecursiveControlVariate(whole_views=7)
    assert estimator == PathGradient(image, pixels.LossProportional(4096, uniform=0.5), spp=2)
    estimator, _ = method("adaptive").start({"scheme": "uniform", "spp": 3})
    assert estimator == PathGradient(pixels=pixels.Uniform(4096), spp=3)


def test_smoothed_takes_its_options():
    estimator, optimizer = method("smoothed").start({"sigma": "0.4", "step": 0.25, "sigma_schedule": "cosine(50)"})
    narrowing = schedules.Cosine(50)
    assert estimator == SmoothedDerivatives(0.4, 16, "hvp", spp=2, schedule=narrowing)
    assert optimizer == NewtonCG(trust_radius=0.25, iterations=3)
    settings = {"sigma": 0.4, "step": 0.25, "spp": 4, "sigma_schedule": "none", "joint": "false"}
    cases: list[tuple[str, Any, Any]] = [
        ("newton", "hessian", Newton(trust_radius=0.25)),
        ("lbfgs", "gradient", LBFGS(trust_radius=0.25)),
        ("adam", "gradient", Adam(0.1)),
    ]
    for name, order, made in cases:
        estimator, optimizer = method("smoothed").start({**settings, "optimizer": name})
        assert estimator == SmoothedDerivatives(0.4, 16, order, joint=order == "gradient", spp=4)
        assert optimizer == made
    estimator, _ = method("smoothed").start({"sigma": "0.2, mug.rotation.y=0.6"})
    assert estimator == SmoothedDerivatives(
        {"*": 0.2, "mug.rotation.y": 0.6}, 16, "hvp", spp=2, schedule=schedules.Exponential(25, 0.1)
    )
    assert method("smoothed").start({**settings, "optimizer": "cma-es"}) == (LossValues(4), CMAES(sigma0=0.1))


def test_stock_takes_its_options():
    estimator, optimizer = method("stock").start({"spp": "8", "learning_rate": 0.5, "beta_2": 0.9})
    assert estimator == StockGradient(8)
    assert optimizer == Adam(0.5, beta_2=0.9)
    with pytest.raises(InputError, match="method stock: option spp: expected a whole number above 0, got '0'"):
        method("stock").start({"spp": "0"})


def test_none_is_none():
    assert method("plain").configure({"adjoint_spp": "none", "schedule": "None"}) == method("plain").configure({})


@pytest.mark.parametrize(
    ("name", "settings", "message"),
    [
        ("plain", {"sp": 1}, "method plain has no option sp; did you mean spp?"),
        ("plain", {"space": "path"}, "method plain has no option space; it has learning_rate, "),
        ("plain", {"spp": "-2"}, "method plain: option spp: expected a whole number above 0, got '-2'"),
        ("plain", {"spp": "2.5"}, "option spp: expected a whole number above 0, got '2.5'"),
        ("plain", {"spp": ""}, "option spp: expected a whole number above 0, got ''"),
        ("plain", {"adjoint_spp": "0"}, "option adjoint_spp: expected a whole number above 0 or none, got '0'"),
        ("plain", {"learning_rate": "0"}, "option learning_rate: expected a number above 0, got '0'"),
        ("plain", {"learning_rate": "nan"}, "option learning_rate: expected a number above 0, got 'nan'"),
        ("plain", {"learning_rate": "inf"}, "option learning_rate: expected a number above 0, got 'inf'"),
        ("plain", {"learning_rate": "fast"}, "option learning_rate: expected a number above 0, got 'fast'"),
        ("plain", {"beta_1": "1"}, "option beta_1: expected a number of at least 0 and below 1, got '1'"),
        ("rcv", {"space": "paths"}, "method rcv: option space: expected path or primary, got 'paths'"),
        ("smoothed", {"sigma": "-1"}, "method smoothed: sigma: expected a number above 0, got '-1'"),
        ("smoothed", {"sigma": -1}, "option sigma: expected a number above 0 or text or none, got -1"),
        ("smoothed", {"sigma": "a.b=1"}, "method smoothed: sigma: expected a number for the other parameters too"),
        ("smoothed", {"sigma": "0.1, a.b=wide"}, "method smoothed: sigma: expected a number above 0, got 'wide'"),
        ("smoothed", {"joint": "maybe"}, "option joint: expected true or false, got 'maybe'"),
        ("smoothed", {"samples": 3}, "option samples: expected a whole number of at least 4, got 3"),
        ("plain", {"schedule": "cosin(3)"}, "method plain: schedule: unknown 'cosin'; did you mean cosine?"),
    ],
)
def test_refuses_options(name: str, settings: dict[str, Any], message: str):
    with pytest.raises(InputError) as caught:
        method(name).start(settings)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_unknown_methods_get_a_suggestion():
    with pytest.raises(InputError, match=r"unknown method rvc; did you mean rcv\?"):
        method("rvc")
    with pytest.raises(InputError, match=r"unknown method zzz; there are auto, plain, rcv"):
        method("zzz")


@pytest.mark.parametrize(
    ("text", "schedule"),
    [
        ("constant", schedules.Constant()),
        ("constant()", schedules.Constant()),
        (" Exponential( 100 ) ", schedules.Exponential(100)),
        ("steps(50)", schedules.Steps(50)),
        ("steps(50, 0.1)", schedules.Steps(50, 0.1)),
        ("warmup(20)", schedules.Warmup(20)),
        ("warmup(20) then cosine(280)", schedules.Warmup(20, schedules.Cosine(280))),
        ("warmup(2) then warmup(3) then constant(2)", schedules.Warmup(2, schedules.Warmup(3, schedules.Constant(2)))),
        (None, None),
    ],
)
def test_schedules_are_read(text: str | None, schedule: Any):
    assert parse_schedule(text) == schedule


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "schedule: unknown ''"),
        ("((", "schedule: unknown '\\(\\('"),
        ("cosine", r"expected cosine\(steps, floor\), got 'cosine'"),
        ("cosine(1, 2, 3)", r"expected cosine\(steps, floor\)"),
        ("cosine(-3)", "steps must be a whole number of at least 1"),
        ("cosine(x)", "expected a number, got 'x'"),
        ("steps(3) then steps(4)", "only warmup"),
        ("warmup(3) then", "unknown ''"),
    ],
)
def test_schedules_are_refused(text: str, message: str):
    with pytest.raises(InputError, match=message):
        parse_schedule(text)


@pytest.mark.parametrize(("sigma", "width"), [(None, 20.0), ("0.2, lamp=45", 45.0)])
def test_first_steps_are_widths_in_units_of_the_variable(sigma: str | None, width: float) -> None:
    """A lamp of 150 in logarithms: a step of its width would multiply it by e^20."""
    values = {"lamp": np.array([150.0]), "other": np.array([0.5])}
    renderer = AnalyticRenderer(values, np.ones((48, 2)))
    lamp = Parameter("lamp", bounds=(0, None), parameterisation="log")
    problem = Problem(renderer, [lamp, Parameter("other")], [View(renderer.exact(values))])
    rates = {"*": 0.1, "lamp": 0.5 * width / 150.0, "other": 0.1}
    settings = {"sigma": sigma} if sigma else {}
    adam = method("smoothed").plan(problem, {**settings, "optimizer": "adam"}).optimizer
    assert isinstance(adam, Adam)
    assert adam.learning_rate == pytest.approx(rates)
    search = method("smoothed").plan(problem, {**settings, "optimizer": "cma-es"}).optimizer
    assert isinstance(search, CMAES)
    assert isinstance(search.learning_rate, dict)
    assert {key: search.sigma0 * unit for key, unit in search.learning_rate.items()} == pytest.approx(rates)
    both = method("hybrid").plan(problem, {**settings, "perturbed": "lamp"}).optimizer
    assert isinstance(both, Adam)
    assert both.learning_rate == pytest.approx({"*": 0.01, "lamp": 0.2 * width / 150.0})
