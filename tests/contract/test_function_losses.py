"""Losses that are functions of Dr.Jit or PyTorch, with every estimator."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import drjit as dr
import numpy as np
import pytest
from backends import TEXTURE
from backends import problem as mitsuba_problem
from test_estimators import ESTIMATORS

import unrender as ur
from tests.contract.analytic import problem
from tiers import slow
from unrender.core.errors import InputError


def of_drjit(image: Any, reference: Any) -> Any:
    return dr.mean(dr.square(image - reference), axis=None)


def of_torch(image: Any, reference: Any) -> Any:
    return ((image - reference) ** 2).mean()


LOSSES: dict[str, Callable[..., Any]] = {"drjit": of_drjit, "torch": of_torch}


def needs(framework: str) -> None:
    if framework == "torch":
        pytest.importorskip("torch")


WHOLE = [
    name
    for name in ESTIMATORS
    if not any(word in name for word in ("pixels", "counts", "all four", "denoised"))  # all four: pixels among them
    and "Gauss-Newton" not in name
]


@pytest.mark.parametrize("framework", LOSSES)
@pytest.mark.parametrize("name", WHOLE)
def test_it_is_the_loss_that_it_computes(name: str, framework: str) -> None:
    """The same numbers as with L2, from the same draws: of value, gradient and all else."""
    needs(framework)
    found, expected = (
        ur.estimate(problem(loss, views=2), ESTIMATORS[name](), seed=3) for loss in (LOSSES[framework], None)
    )
    assert found.loss == pytest.approx(expected.loss, rel=1e-9)
    for key, gradient in expected.gradient.items():
        np.testing.assert_allclose(found.gradient[key], gradient, rtol=1e-8, atol=1e-12)


@pytest.mark.parametrize("name", [name for name in ESTIMATORS if "pixels" in name][:1])
def test_it_takes_no_mini_batches(name: str) -> None:
    with pytest.raises(InputError, match="is a loss of full images, which does not support pixel mini-batches"):
        ur.estimate(problem(of_drjit), ESTIMATORS[name]())


def test_it_has_no_gauss_newton_matrix() -> None:
    with pytest.raises(InputError, match="GaussNewton requires a per-pixel loss, such as L2, got FunctionLoss"):
        ur.estimate(problem(of_drjit), ESTIMATORS["Gauss-Newton"]())


@pytest.mark.parametrize("framework", ["drjit", slow("torch")])
def test_on_mitsubas_arrays(framework: str) -> None:
    needs(framework)
    expected = mitsuba_problem((TEXTURE,))
    problem = ur.Problem(expected.renderer, expected.parameters, expected.views, LOSSES[framework], max_depth=3)
    estimator = ur.PathGradient(spp=4)
    one, two = (ur.estimate(each, estimator) for each in (expected, problem))
    assert one.loss == pytest.approx(two.loss, rel=1e-4)
    np.testing.assert_allclose(two.gradient[TEXTURE], one.gradient[TEXTURE], rtol=1e-3, atol=1e-7)


def test_a_run_with_one_is_resumed_with_the_problem_itself(tmp_path: Path) -> None:
    estimator, optimizer = ur.PathGradient(spp=2), ur.optimizers.Adam(0.02)
    whole = ur.optimize(problem(of_drjit), estimator, optimizer, steps=6)
    ur.optimize(problem(of_drjit), estimator, optimizer, steps=3, run_directory=tmp_path / "run")
    found = ur.resume(tmp_path / "run", problem=problem(of_drjit), steps=6)
    np.testing.assert_array_equal(found.parameters["map"], whole.parameters["map"])
    with pytest.raises(InputError, match=r"loss was .*of_drjit, is .*L2"):
        ur.resume(tmp_path / "run", problem=problem(), steps=9)


def test_a_mask_blends_and_a_weight_scales() -> None:
    mask = np.zeros((4, 4), np.float32)
    mask[:2] = 1
    given = problem()
    found = []
    for loss in (of_drjit, ur.losses.L2()):
        view = ur.View(np.asarray(given.views[0].reference), weight=3.0, mask=mask)
        asked = ur.Problem(given.renderer, given.parameters, [view], loss)
        found.append(ur.estimate(asked, ur.PathGradient(spp=4)))
    assert found[0].loss == pytest.approx(found[1].loss, rel=1e-6)
    np.testing.assert_allclose(found[0].gradient["map"], found[1].gradient["map"], rtol=1e-6)


def test_it_may_change_its_arguments() -> None:
    def in_place(image: Any, reference: Any) -> Any:
        image -= reference
        return dr.mean(dr.square(image), axis=None)

    found = [ur.estimate(problem(loss), ur.PathGradient(spp=4)) for loss in (of_drjit, in_place)]
    assert np.abs(found[0].gradient["map"]).max() > 0
    np.testing.assert_array_equal(found[0].gradient["map"], found[1].gradient["map"])


def test_one_of_the_image_alone() -> None:
    def brightness(image: Any) -> Any:
        return dr.square(dr.mean(image, axis=None) - 0.5)

    asked = problem(brightness)
    result = ur.optimize(asked, ur.PathGradient(spp=8), ur.optimizers.Adam(0.02), steps=60)
    assert np.mean(ur.render(asked, result.parameters, spp=256)) == pytest.approx(0.5, abs=0.05)


class Module:
    """As a module of PyTorch: its signature says nothing."""

    def __call__(self, *given: Any, **options: Any) -> Any:
        return of_drjit(*given)


def test_what_it_is_called_with() -> None:
    assert ur.losses.FunctionLoss(Module()).takes_reference
    assert ur.losses.FunctionLoss(of_drjit).takes_reference
    assert not ur.losses.FunctionLoss(lambda image, power=2.0: dr.mean(image**power)).takes_reference
    assert ur.estimate(problem(Module()), ur.PathGradient()).loss > 0
    assert repr(ur.losses.FunctionLoss(of_drjit)).endswith("test_function_losses.of_drjit")
    assert repr(ur.losses.FunctionLoss(Module())).endswith("Module")


@pytest.mark.parametrize(
    ("loss", "message"),
    [
        (lambda image, reference: image - reference, r"with Dr.Jit's tensors: it returns TensorXf of shape \(4, 4, 3\), exp"),
        (lambda image, reference: 3.0, "it returns float, expected a scalar of Dr.Jit"),
        (lambda image, reference: dr.mean(dr.detach(image)), "detached from it$"),
        (lambda image, reference: dr.mean(dr.detach(image), axis=None), "does not depend on the image, or is detached from it"),
        (lambda image, reference: dr.mean(image, axis=None) * dr.nan, "its value at an image that is nearly the reference is nan"),
        (lambda image, reference: image.nonsense(), "has no attribute 'nonsense'"),
        (lambda image, reference, more: 0, r"expected a function of \(image\) or of \(image, reference\), it takes image, ref"),
        (lambda *, image: 0, r"expected a function of \(image\)"),
        (lambda: 0, "it takes nothing"),
        ("L3", "expected one of unrender.losses, such as L2"),
        (ur.losses.L1, "expected one of unrender.losses, such as L2"),
    ],
)  # fmt: skip
def test_what_is_no_loss_is_one_line(loss: Any, message: str) -> None:
    with pytest.raises(InputError, match=message) as caught:
        problem(loss)
    assert str(caught.value).startswith("loss: ")
    assert "\n" not in str(caught.value)
