"""`SmoothedDerivatives` and `LossValues`: what they refuse, count, and cost in memory."""

from __future__ import annotations

import itertools
import tracemalloc
from typing import Any

import numpy as np
import pytest

import unrender as ur
from tests.analytic import AnalyticRenderer
from unrender.core.random import Key
from unrender.estimators.smoothed import positive_diagonal
from unrender.schedules import Exponential


def problem(n: int = 3, **more: Any) -> ur.Problem:
    """`n` numbers seen in four pixels; images without noise."""
    rng = np.random.default_rng(0)
    renderer = AnalyticRenderer({"x": rng.uniform(0.3, 0.7, n)}, rng.random((12, n)) / n, noise=0.0, shape=(2, 2))
    view = ur.View(renderer.exact({}))
    return ur.Problem(renderer, [ur.Parameter("x", initial=0.5, **more)], [view], truth=renderer.values(["x"]))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"sigma": 0.0}, "sigma must be a finite number > 0, got 0.0"),
        ({"sigma": -1}, "sigma must be a finite number > 0, got -1"),
        ({"sigma": float("nan")}, "sigma must be a finite number > 0"),
        ({"sigma": {"x": 0}}, "sigma of x must be a finite number > 0, got 0"),
        ({"sigma": 0.1, "samples": 3}, "samples must be a whole number of at least 4, got 3"),
        ({"sigma": 0.1, "samples": 8, "low_discrepancy": True}, "samples must be a whole number of at least 16, got 8"),
        ({"sigma": 0.1, "order": "third"}, 'order must be "gradient", "hessian" or "hvp"'),
        ({"sigma": 0.1, "order": "hvp", "product": True}, 'product=True requires order="gradient"'),
        ({"sigma": 0.1, "spp": 0}, "spp must be a whole number of at least 1, got 0"),
        ({"sigma": 0.1, "epsilon": 0}, "epsilon must be a finite number > 0, got 0"),
        ({"sigma": 0.1, "order": "hvp", "hessian_rate": 1.5}, "hessian_rate must be at most 1, got 1.5"),
        ({"sigma": 0.1, "hessian_rate": 0.5}, 'hessian_rate requires order="hvp", got'),
        ({"sigma": 0.1, "hessian_form": "banded"}, 'hessian_form must be "full" or "diagonal"'),
        ({"sigma": 0.1, "order": "hvp", "hessian_form": "diagonal"}, 'hessian_form="diagonal" requires hessian_rate'),
        ({"sigma": 0.1, "orthogonal": True, "low_discrepancy": True}, "orthogonal requires aggregate"),
        ({"sigma": 0.1, "orthogonal": True, "aggregate": False}, "orthogonal requires aggregate"),
        ({"sigma": 0.1, "orthogonal": True, "product": True}, "orthogonal requires aggregate"),
    ],
)
def test_arguments_that_make_no_sense(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(ur.InputError) as caught:
        ur.SmoothedDerivatives(**arguments)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_problems_that_it_cannot_take() -> None:
    with pytest.raises(ur.InputError, match="sigma has no entry for parameter x"):
        ur.estimate(problem(), ur.SmoothedDerivatives({}))
    with pytest.raises(ur.InputError, match="sigma names y, which is not a parameter"):
        ur.estimate(problem(), ur.SmoothedDerivatives({"*": 0.1, "y": 0.1}))
    renderer = AnalyticRenderer({"x": np.full((2, 2, 1), 0.5), "y": np.full(1, 0.5)}, np.ones((12, 5)), shape=(2, 2))
    smooth = ur.Parameter("x", initial=0.2, preconditioner=ur.preconditioners.LargeSteps(1.0))
    asked = ur.Problem(renderer, [smooth], [ur.View(renderer.exact({}))])
    for estimator in (ur.estimators.LossValues(), ur.SmoothedDerivatives(0.1)):
        with pytest.raises(ur.InputError, match="CMAES: parameter x has a preconditioner"):
            ur.optimize(asked, estimator, ur.optimizers.CMAES(), steps=1)
    log = ur.Parameter("y", initial=0.2, bounds=(0.1, 2.0), parameterisation=ur.parameterisations.Log())
    asked = ur.Problem(renderer, [smooth, log], [ur.View(renderer.exact({}))])
    with pytest.raises(ur.InputError, match="parameter x has a preconditioner and y a parameterisation"):
        ur.estimate(asked, ur.SmoothedDerivatives(0.1))
    with pytest.raises(ur.InputError, match=r'"hvp".*does not provide'):
        ur.optimize(problem(), ur.SmoothedDerivatives(0.1), ur.optimizers.NewtonCG(), steps=1)
    with pytest.raises(ur.InputError, match=r'"gradient".*does not provide'):
        ur.optimize(problem(), ur.estimators.LossValues(), ur.optimizers.Adam(), steps=1)


@pytest.mark.mitsuba
def test_a_parameter_that_cannot_be_perturbed_is_refused() -> None:
    asked = ur.gallery.problem("mug", resolution=8, reference_spp=1)
    with pytest.raises(ur.InputError, match=r"mug\.faces cannot be recovered: Mitsuba marks it as not differentiable"):
        ur.Problem(asked.renderer, [ur.Parameter("mug.faces")], asked.views)


def test_all_paths_are_counted_those_of_products_too() -> None:
    def samples(estimator: Any, optimizer: Any) -> int:
        history = ur.optimize(problem(), estimator, optimizer, steps=1).history
        return history[0]["samples"] // (4 * estimator.spp)  # renders

    optimizers = ur.optimizers
    gradient = ur.SmoothedDerivatives(0.1, samples=16)
    assert samples(gradient, optimizers.Adam()) == 1 + 16
    assert samples(ur.SmoothedDerivatives(0.1, samples=16, aggregate=False), optimizers.Adam()) == 1 + 3 * 16
    products = ur.SmoothedDerivatives(0.1, samples=16, order="hvp", spp=2)
    assert samples(products, optimizers.NewtonCG(iterations=3)) == 1 + 16
    products = ur.SmoothedDerivatives(0.1, samples=16, order="hvp", spp=2, joint=False)
    assert samples(products, optimizers.NewtonCG(iterations=1)) == 1 + 16 + 32
    for joint, form in itertools.product((True, False), ("full", "diagonal")):
        kept = ur.SmoothedDerivatives(0.1, samples=16, order="hvp", joint=joint, hessian_rate=0.5, hessian_form=form)
        assert samples(kept, optimizers.NewtonCG(iterations=3)) == 1 + 16
    whole = ur.SmoothedDerivatives(0.1, samples=16, order="hessian", aggregate=False, joint=False)
    assert samples(whole, optimizers.Newton()) == 1 + 3 * 16 + 6 * 16
    assert samples(ur.estimators.LossValues(), optimizers.CMAES(population=7)) == 1 + 7


@pytest.mark.parametrize("order", ["gradient", "hessian", "hvp"])
def test_gradient_and_curvature_take_one_launch(order: Any) -> None:
    """The loss at the parameters is rendered beside the first perturbations, and only once."""
    asked, counts = problem(), []
    renderer = asked.renderer
    assert isinstance(renderer, AnalyticRenderer)
    render = renderer.image_batch

    def watch(parameters: dict[str, np.ndarray], request: Any) -> np.ndarray:
        counts.append(len(parameters["x"]))
        return render(parameters, request)

    renderer.image_batch = watch  # pyright: ignore[reportAttributeAccessIssue]
    estimator = ur.SmoothedDerivatives(0.1, samples=16, order=order)
    parameters = {"x": np.full(3, 0.4)}
    found, _ = estimator.estimate(asked, parameters, estimator.init(asked, parameters), Key(0))
    if found.hvp is not None:
        found.hvp(parameters)
    assert counts == [1 + 16]
    assert found.losses is not None
    assert found.losses(np.full((1, 3), 0.4)) == found.loss
    assert counts == [1 + 16]
    assert found.losses(np.full((2, 3), 0.4)) == pytest.approx([found.loss] * 2)
    np.testing.assert_allclose(found.info["images"][0], renderer.exact(parameters), rtol=1e-6)


class _Landscape:
    """A loss of one number: pictures of what `height` says, against black, in an L1 loss."""

    def __init__(self, height: Any):
        truth = AnalyticRenderer({"x": np.zeros(1)}, np.ones((12, 1)), noise=0.0, shape=(2, 2))
        self.problem = ur.Problem(
            truth, [ur.Parameter("x", initial=0.0)], [ur.View(np.zeros((2, 2, 3)))], ur.losses.L1()
        )
        truth.image_batch = self.render  # pyright: ignore[reportAttributeAccessIssue]
        self.height = height

    def render(self, parameters: dict[str, np.ndarray], request: Any) -> np.ndarray:
        del request
        return np.broadcast_to(self.height(parameters["x"])[:, :, None, None], (len(parameters["x"]), 2, 2, 3))

    def age(self, at: float, steps: int = 40, **options: Any) -> float:
        estimator = ur.SmoothedDerivatives(0.1, samples=8, adaptive_annealing=True, **options)
        parameters = {"x": np.array([at])}
        state = estimator.init(self.problem, parameters)
        for step in range(steps):
            _, state = estimator.estimate(self.problem, parameters, state, Key(step))
        return state.age / steps


@pytest.mark.parametrize("options", [{}, {"order": "hvp"}, {"order": "hvp", "joint": False}], ids=str)
def test_sigma_waits_for_the_descent_to_arrive(options: dict[str, Any]) -> None:
    """At the bottom of a paraboloid time passes, on a slope, a plateau and a summit it stands still."""
    paraboloid = _Landscape(lambda x: 1 + x * x)
    assert 0.5 < paraboloid.age(0.0, **options) <= 1.0
    assert paraboloid.age(3.0, **options) < 0.05
    assert _Landscape(lambda x: np.abs(x)).age(0.0, **options) > 0.7
    assert _Landscape(lambda x: np.ones_like(x)).age(0.0, **options) == 0.0
    assert _Landscape(lambda x: 9 - x * x).age(0.0, **options) == 0.0
    still = ur.SmoothedDerivatives(0.1, samples=8, schedule=Exponential(1), adaptive_annealing=True, **options)
    parameters = {"x": np.array([3.0])}
    found, _ = still.estimate(paraboloid.problem, parameters, still.init(paraboloid.problem, parameters), Key(0))
    assert found.sigma == {"x": 0.1}


def test_sigma_follows_its_schedule() -> None:
    """Of a linear loss in an L1 problem the gradient is the same at any σ, but perturbed points tell it."""
    asked, seen = problem(), []
    renderer = asked.renderer
    assert isinstance(renderer, AnalyticRenderer)
    render = renderer.image_batch

    def watch(parameters: dict[str, np.ndarray], request: Any) -> np.ndarray:
        if len(parameters["x"]) > 1:
            seen.append(float(np.abs(parameters["x"] - parameters["x"].mean(0)).max()))
        return render(parameters, request)

    renderer.image_batch = watch  # pyright: ignore[reportAttributeAccessIssue]
    estimator = ur.SmoothedDerivatives(0.1, samples=64, schedule=Exponential(1, floor=0.2))
    state, parameters = estimator.init(asked, asked.initial()), asked.initial()
    for _ in range(5):
        _, state = estimator.estimate(asked, parameters, state, Key(0))
    np.testing.assert_allclose(np.array(seen) / seen[0], [1, 0.5, 0.25, 0.2, 0.2], rtol=1e-6)


@pytest.mark.parametrize(
    ("factor", "expected"),
    [
        (0.0, "schedule must stay above 0, got 0 at step 0; set its floor"),
        (10**400, "schedule must return a finite factor >= 0, got an integer of 1329 bits at step 0"),
        (None, "schedule must return a finite factor >= 0, got None at step 0"),
    ],
)
def test_schedules_of_sigma_that_return_no_factor_are_one_line(factor: Any, expected: str) -> None:
    asked = problem()
    estimator = ur.SmoothedDerivatives(0.1, samples=8, schedule=lambda step: factor)
    with pytest.raises(ur.InputError, match=f"^SmoothedDerivatives: {expected}$"):
        estimator.estimate(asked, asked.initial(), estimator.init(asked, asked.initial()), Key(0))


@pytest.mark.parametrize("joint", [True, False])
def test_products_never_make_a_matrix(joint: bool) -> None:
    """A step of Newton-CG on 6000 numbers, whose Hessian would take 288 MB."""
    asked = problem(6000)
    estimator = ur.SmoothedDerivatives(0.05, samples=8, order="hvp", joint=joint)
    optimizer = ur.optimizers.NewtonCG(iterations=2)
    parameters = asked.initial()
    state, memory = estimator.init(asked, parameters), optimizer.init(parameters)
    tracemalloc.start()
    found, _ = estimator.estimate(asked, parameters, state, Key(0))
    optimizer.update(found, memory, parameters)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 200 * 8 * 6000


@pytest.mark.parametrize("joint", [True, False], ids=["joint", "differences"])
def test_a_hessian_that_is_kept_is_that_of_the_loss_and_so_is_the_gradient(joint: bool) -> None:
    """A quadratic, whose smoothed derivatives are its own: means over steps, within 5 standard errors of blocks' means."""
    matrix, at, sigma, blocks = np.array([[2.0, 0.5, 0.0], [0.5, 1.0, -0.3], [0.0, -0.3, 0.5]]), np.ones(3), 0.1, 12
    estimator = ur.SmoothedDerivatives(sigma, samples=16, order="hvp", joint=joint, hessian_rate=0.3)
    hessian, found = None, []
    for step in range(600):
        gradient, _, hessian = estimator._stored_hessian(
            lambda x: 0.5 * np.einsum("bi,ij,bj->b", x, matrix, x), at, np.full(3, sigma), step, hessian, 0.3
        )
        found.append(np.concatenate([gradient, hessian.ravel() / sigma**2]))
    parts = np.array(found)[len(found) // blocks :].reshape(blocks - 1, -1, 12).mean(axis=1)
    error = parts.std(axis=0, ddof=1) / np.sqrt(blocks - 1)
    expected = np.concatenate([matrix @ at, matrix.ravel()])
    assert (np.abs(parts.mean(axis=0) - expected) < 5 * error).all()
    assert not (np.abs(parts.mean(axis=0) - 1.3 * expected) < 5 * error).all()
    asked, x = problem(), {"x": np.full(3, 0.4)}
    one, state = estimator.estimate(asked, x, estimator.init(asked, x), Key(0))
    assert state.hessian is not None
    assert one.hvp is not None
    np.testing.assert_allclose(one.hvp({"x": np.array([1.0, 0, 0])})["x"], state.hessian[:, 0] / sigma**2, rtol=1e-6)


@pytest.mark.parametrize("orthogonal", [True, False])
@pytest.mark.parametrize("joint", [True, False], ids=["joint", "differences"])
def test_a_diagonal_that_is_kept_is_that_of_the_loss(joint: bool, orthogonal: bool) -> None:
    """A quadratic whose curvatures differ by a factor of 10: after 60 steps the diagonal is its, and so are products."""
    n, sigma = 12, 0.1
    bend, at = np.geomspace(0.3, 3.0, n), np.ones(n)
    estimator = ur.SmoothedDerivatives(
        sigma, 16, "hvp", joint=joint, hessian_rate=0.8, hessian_form="diagonal", orthogonal=orthogonal
    )
    kept, gradients = None, []
    for step in range(60):
        gradient, _, kept = estimator._stored_hessian(
            lambda x: 0.5 * (x * x) @ bend, at, np.full(n, sigma), step, kept, estimator.hessian_rate or 0.0
        )
        gradients.append(gradient)
    assert kept is not None
    np.testing.assert_allclose(kept / sigma**2, bend, rtol=0.02)
    error = np.std(gradients, axis=0, ddof=1) / np.sqrt(len(gradients))
    assert (np.abs(np.mean(gradients, axis=0) - bend) < 5 * error).all()
    asked, x = problem(5000), {"x": np.full(5000, 0.4)}  # more than a matrix is kept of
    one, state = estimator.estimate(asked, x, estimator.init(asked, x), Key(0))
    assert state.hessian is not None
    assert state.hessian.shape == (5000,)
    assert one.hvp is not None
    v = np.random.default_rng(0).normal(size=5000)
    np.testing.assert_allclose(
        one.hvp({"x": v})["x"], positive_diagonal(state.hessian) * v / sigma**2, rtol=1e-5, atol=1e-6
    )


def test_a_hessian_of_too_many_parameters_is_not_kept() -> None:
    with pytest.raises(ur.InputError, match="hessian_rate would store a matrix of 5000 × 5000 elements"):
        ur.estimate(problem(5000), ur.SmoothedDerivatives(0.1, order="hvp", hessian_rate=0.5))
