"""Newton, Newton-CG, L-BFGS and CMA-ES against closed forms, with noise, in NumPy and on the device."""

import dataclasses
import math
from typing import Any

import drjit as dr
import numpy as np
import pytest
from scipy.optimize import lsq_linear

import kernels
import unrender as ur
from tests.analytic import AnalyticRenderer
from unrender.core import trees
from unrender.core.errors import InputError
from unrender.estimators.base import Estimate
from unrender.estimators.capabilities import AtBounds, Capability, Hessian, HessianProduct, LossFunction, Smoothing
from unrender.optimizers import CMAES, LBFGS, Adam, AveragedNewton, Newton, NewtonCG, Partitioned
from unrender.optimizers.cma_es import CMAESState
from unrender.schedules import Constant, Exponential

LIKE = {"a": np.zeros((2, 2)), "b": np.zeros(2)}
FIRST_STEPS = [Newton(), NewtonCG(), LBFGS()]


def split(x, like=LIKE):
    return trees.unravel(x, like)


def paraboloid(n: int = 6, seed: int = 0, condition: float = 1000.0) -> tuple[np.ndarray, np.ndarray]:
    """A positive definite Hessian, and a minimum."""
    rng = np.random.default_rng(seed)
    q, _ = np.linalg.qr(rng.normal(size=(n, n)))
    return q @ np.diag(np.geomspace(10 / condition, 10, n)) @ q.T, rng.normal(size=n)


def known(gradient, hessian=None, like=LIKE, losses=None) -> Estimate:
    """The gradient of a quadratic, and its Hessian, products and losses where they are given."""
    capabilities: list[Capability] = []
    if hessian is not None:
        capabilities = [Hessian(hessian), HessianProduct(lambda v: split(hessian @ trees.ravel(v), like))]
    if losses is not None:
        capabilities.append(LossFunction(losses))
    return Estimate(0.0, split(gradient, like), tuple(capabilities))


def first_step(optimizer, gradient, hessian=None, learning_rates=None, like=LIKE) -> np.ndarray:
    step, _ = optimizer.update(known(gradient, hessian, like), optimizer.init(like, learning_rates), like)
    return trees.ravel(step)


def descend(optimizer, function, x, steps, learning_rates=None):
    """The values and the last point of a descent on `function`: x (n,) to value, gradient (n,) and Hessian (n, n)."""
    state, values = optimizer.init({"x": x}, learning_rates), []
    for _ in range(steps):
        value, gradient, hessian = function(x)
        values.append(value)
        step, state = optimizer.update(known(gradient, hessian, {"x": x}), state, {"x": x})
        x = x + step["x"]
    return np.array([*values, function(x)[0]]), x


def rosenbrock(x):
    """Its valley bends in all dimensions; the minimum is 0, at ones."""
    a, b = x[:-1], x[1:]
    gradient = np.zeros_like(x)
    gradient[:-1] += -2 * (1 - a) - 400 * a * (b - a * a)
    gradient[1:] += 200 * (b - a * a)
    hessian = np.zeros((x.size, x.size))
    i = np.arange(x.size - 1)
    hessian[i, i] += 2 + 1200 * a * a - 400 * b
    hessian[i + 1, i + 1] += 200
    hessian[i, i + 1] = hessian[i + 1, i] = -400 * a
    return float(np.sum((1 - a) ** 2 + 100 * (b - a * a) ** 2)), gradient, hessian


# ---------------------------------------------------------------------------------------------------- one step


def test_one_newton_step_ends_at_the_bottom_of_a_paraboloid():
    hessian, minimum = paraboloid()
    step = first_step(Newton(trust_radius=None, damping=1e-6), -hessian @ minimum, hessian)
    np.testing.assert_allclose(step, minimum, rtol=1e-9)


def test_newton_cg_is_the_linear_solve_after_n_products():
    hessian, minimum = paraboloid(condition=20)
    exact = NewtonCG(trust_radius=1e3, iterations=6, tolerance=0.0, damping=0.0)
    np.testing.assert_allclose(first_step(exact, -hessian @ minimum, hessian), minimum, rtol=1e-8)
    fewer = dataclasses.replace(exact, iterations=5)
    assert not np.allclose(first_step(fewer, -hessian @ minimum, hessian), minimum, rtol=1e-4)


def test_newton_cg_ends_at_its_tolerance():
    hessian, minimum = paraboloid()
    gradient = -hessian @ minimum
    left = []
    for tolerance in (0.5, 0.1, 1e-3):
        step = first_step(
            NewtonCG(trust_radius=1e3, iterations=60, tolerance=tolerance, damping=0.0), gradient, hessian
        )
        left.append(np.linalg.norm(gradient + hessian @ step) / np.linalg.norm(gradient))
        assert left[-1] <= tolerance
    assert left[0] > left[1] > left[2]


@pytest.mark.parametrize("count", [1, 3])
def test_newton_cg_asks_for_no_more_products_than_it_may(count):
    hessian, minimum = paraboloid()
    calls = []

    def product(tree):
        calls.append(1)
        return {"a": hessian @ tree["a"]}

    optimizer = NewtonCG(trust_radius=1e3, iterations=count, tolerance=0.0, damping=0.0)
    gradient = {"a": -hessian @ minimum}
    optimizer.update(Estimate(0.0, gradient, (HessianProduct(product),)), optimizer.init(gradient), gradient)
    assert len(calls) == count


@pytest.mark.parametrize("optimizer", [Newton(trust_radius=0.25), NewtonCG(trust_radius=0.25)], ids=["Newton", "CG"])
@pytest.mark.parametrize("shift", [3.0, 30.0], ids=["saddle", "hill"])
def test_where_the_objective_bends_downwards_the_step_descends_to_the_radius(optimizer, shift):
    hessian, minimum = paraboloid()
    hessian = hessian - shift * np.eye(6)
    gradient = hessian @ minimum
    step = first_step(optimizer, gradient, hessian)
    assert step @ gradient < 0
    assert gradient @ step + step @ hessian @ step / 2 < -0.1 * 0.25 * np.linalg.norm(gradient)
    assert np.linalg.norm(step) <= 0.25 * (1 + 1e-9)
    if isinstance(optimizer, NewtonCG) or shift == 3.0:
        assert np.linalg.norm(step) == pytest.approx(0.25, rel=1e-6)


@pytest.mark.parametrize("radius", [1e-3, 0.1, 100.0])
def test_on_a_line_the_length_is_the_losss_own_and_not_the_products(radius):
    """Products too large by any factor, a gradient that is mostly noise: the step still ends where the loss is least along it."""
    hessian, minimum = paraboloid(condition=10.0)
    like, rng = {"x": np.zeros(6)}, np.random.default_rng(3)
    gradient = hessian @ -minimum + 3 * rng.standard_normal(6)

    def losses(points):
        away = points - minimum
        return 0.5 * np.einsum("bi,ij,bj->b", away, hessian, away)

    def step(sign):
        estimate = known(sign * gradient, 50 * hessian, like, losses)
        optimizer = NewtonCG(trust_radius=radius, iterations=1, line=True)
        assert optimizer.requires == {"gradient", "hvp", "losses"}
        return trees.ravel(optimizer.update(estimate, optimizer.init(like), like)[0])

    found = step(1.0)
    assert np.linalg.norm(found) <= radius * (1 + 1e-9)
    direction = -gradient / np.linalg.norm(gradient)
    assert found @ direction == pytest.approx(np.linalg.norm(found))
    slope = direction @ hessian @ (found - minimum)
    assert slope == pytest.approx(0.0, abs=1e-9) if radius == 100.0 else slope < 0.0
    assert not step(-1.0).any(), "a direction that climbs was followed"


@pytest.mark.parametrize("radius", [1e-3, 0.1, 1.0])
def test_newtons_step_is_the_best_one_within_its_radius(radius):
    hessian, minimum = paraboloid()
    gradient = -hessian @ minimum
    step = first_step(Newton(trust_radius=radius, damping=1e-6), gradient, hessian)
    assert np.linalg.norm(step) == pytest.approx(radius, rel=1e-6)
    others = np.random.default_rng(0).normal(size=(2000, 6))
    others *= radius / np.linalg.norm(others, axis=1, keepdims=True)
    others = np.concatenate([others, (step + 0.1 * others) / 1.1, radius * minimum[None] / np.linalg.norm(minimum)])
    model = others @ gradient + 0.5 * np.einsum("bi,ij,bj->b", others, hessian, others)
    assert (gradient @ step + 0.5 * step @ hessian @ step <= model + 1e-12).all()


@pytest.mark.parametrize("optimizer", [Newton(), NewtonCG()], ids=["Newton", "CG"])
def test_without_curvature_the_step_is_the_gradients_and_as_long_as_the_radius(optimizer):
    gradient = np.array([3.0, 0, 0, 0, 0, -4.0]) * 1e-7
    step = first_step(optimizer, gradient, np.zeros((6, 6)))
    np.testing.assert_allclose(step, -0.5 * gradient / np.linalg.norm(gradient), rtol=1e-9)


@pytest.mark.parametrize(
    ("optimizer", "what"),
    [
        (optimizer, what)
        for optimizer in FIRST_STEPS
        for what in ("zero gradient", "bad curvature", "bad gradient")
        if not (isinstance(optimizer, LBFGS) and what == "bad curvature")  # it asks for none
    ],
    ids=lambda value: value if isinstance(value, str) else type(value).__name__,
)
def test_no_step_where_nothing_is_known(optimizer, what):
    hessian, minimum = paraboloid()
    gradient = -hessian @ minimum
    if what == "zero gradient":
        gradient = np.zeros(6)
    elif what == "bad curvature":
        hessian[2, 1] = np.nan
    else:
        gradient[3] = np.inf
    np.testing.assert_array_equal(first_step(optimizer, gradient, hessian), np.zeros(6))
    np.testing.assert_array_equal(first_step(Newton(trust_radius=None), gradient, 0 * hessian), np.zeros(6))


def test_a_later_product_that_is_not_finite_ends_the_iterations():
    hessian, minimum = paraboloid()
    optimizer, calls = NewtonCG(trust_radius=1e3, iterations=6, tolerance=0.0, damping=0.0), []

    def product(v):
        calls.append(1)
        return split(hessian @ trees.ravel(v) * (np.nan if len(calls) == 3 else 1.0))

    gradient = -hessian @ minimum
    estimate = Estimate(0.0, split(gradient), (HessianProduct(product),))
    step, _ = optimizer.update(estimate, optimizer.init(LIKE), LIKE)
    expected = first_step(dataclasses.replace(optimizer, iterations=2), gradient, hessian)
    np.testing.assert_array_equal(trees.ravel(step), expected)
    assert len(calls) == 3


@pytest.mark.parametrize("noise", [0.3, 3.0, 100.0])
def test_noisy_products_lead_neither_upwards_nor_astray(noise):
    """Products with noise of their own, of no symmetric matrix."""
    for seed in range(50):
        rng = np.random.default_rng(seed)
        hessian, minimum = paraboloid(seed=seed)
        gradient = -hessian @ minimum

        def product(v, rng=rng, hessian=hessian):
            exact = hessian @ trees.ravel(v)
            return split(exact + noise * np.linalg.norm(exact) / math.sqrt(6) * rng.normal(size=6))

        optimizer = NewtonCG(trust_radius=0.5, iterations=12, tolerance=0.0)
        step, _ = optimizer.update(
            Estimate(0.0, split(gradient), (HessianProduct(product),)), optimizer.init(LIKE), LIKE
        )
        assert trees.ravel(step) @ gradient < 0
        assert 0 < np.linalg.norm(trees.ravel(step)) <= 0.5 * (1 + 1e-9)


def test_damping_helps_against_a_noisy_hessian():
    def error(damping):
        left = []
        for seed in range(20):
            rng = np.random.default_rng(seed)
            hessian, x = paraboloid(10, seed, condition=10)
            optimizer = Newton(damping=damping)
            state = optimizer.init({"x": x})
            for _ in range(30):
                noise = rng.normal(size=(10, 10)) * np.linalg.norm(hessian) / 20
                estimate = known(hessian @ x, hessian + noise + noise.T, {"x": x})
                step, state = optimizer.update(estimate, state, {"x": x})
                x = x + step["x"]
            left.append(np.linalg.norm(x))
        return np.median(left)

    assert error(0.3) < 0.1 * error(1e-3)


# ---------------------------------------------------------------------------------------------------- scales

RATES = {"a": 0.01, "b": 5.0}
SPREAD = np.array([0.01] * 4 + [5.0] * 2)


@pytest.mark.parametrize(
    "optimizer",
    [Newton(), Newton(trust_radius=0.01), NewtonCG(), NewtonCG(trust_radius=0.01, iterations=2), LBFGS()],
    ids=repr,
)
def test_steps_are_those_of_the_scaled_problem(optimizer):
    hessian, minimum = paraboloid()
    unscaled = hessian / SPREAD[:, None] / SPREAD
    gradient = -hessian @ minimum
    expected = SPREAD * first_step(optimizer, gradient, hessian)
    found = first_step(optimizer, gradient / SPREAD, unscaled, RATES)
    np.testing.assert_allclose(found, expected, rtol=1e-6)
    assert np.linalg.norm(found / SPREAD) <= optimizer.trust_radius * (1 + 1e-9)


def test_learning_rates_do_not_matter_inside_the_trust_region():
    hessian, minimum = paraboloid(condition=10)
    cg = NewtonCG(trust_radius=1e4, iterations=6, tolerance=0.0, damping=0.0)
    for optimizer in (Newton(trust_radius=1e4, damping=1e-12), cg):
        step = first_step(optimizer, -hessian @ minimum, hessian, {"a": 0.5, "b": 1.0})
        np.testing.assert_allclose(step, minimum, rtol=1e-5)


@pytest.mark.parametrize("kind", [Newton, NewtonCG, LBFGS])
def test_share_and_schedule_are_factors_of_the_step(kind):
    gradient, (hessian, _) = np.arange(6.0), paraboloid()
    whole = first_step(kind(), gradient, hessian)
    np.testing.assert_allclose(first_step(kind(step_scale=0.25), gradient, hessian), 0.25 * whole)
    np.testing.assert_allclose(first_step(kind(schedule=Constant(0.5)), gradient, hessian), 0.5 * whole)


# ---------------------------------------------------------------------------------------------------- through Adam


@pytest.mark.parametrize("kind", [Newton, NewtonCG, LBFGS])
def test_through_adam_the_steps_opposite_is_adams_gradient(kind):
    """Of the first kind of step, on a fixed list of gradients at fixed parameters."""
    rng = np.random.default_rng(1)
    adam, (hessian, _) = Adam(0.02, beta_1=0.8), paraboloid()
    plain, passed = kind(), kind(inner_optimizer=adam, schedule=Exponential(3))
    own, state, states = passed.init(LIKE, {"b": 0.3}), adam.init(LIKE, {"b": 0.3}), plain.init(LIKE, {"b": 0.3})
    for step in range(5):
        estimate = known(rng.normal(size=6), hessian)
        direction, states = plain.update(estimate, states, LIKE)
        expected, state = adam.update(Estimate(0.0, split(-trees.ravel(direction))), state, LIKE)
        found, own = passed.update(estimate, own, LIKE)
        np.testing.assert_allclose(trees.ravel(found), 0.5 ** (step / 3) * trees.ravel(expected), rtol=1e-12)


@pytest.mark.parametrize(
    "optimizer", [Newton(inner_optimizer=Adam(0.05)), NewtonCG(inner_optimizer=Adam(0.05))], ids=["Newton", "CG"]
)
def test_through_adam_reaches_the_bottom(optimizer):
    hessian, minimum = paraboloid(condition=100)
    optimizer = dataclasses.replace(optimizer, schedule=Exponential(60))

    def function(x):
        return 0.5 * (x - minimum) @ hessian @ (x - minimum), hessian @ (x - minimum), hessian

    values, _ = descend(optimizer, function, np.zeros(6), 400)
    assert values[-1] < 1e-4 * values[0]


# ---------------------------------------------------------------------------------------------------- descents


@pytest.mark.parametrize(
    ("optimizer", "steps"),
    [
        (Newton(damping=1e-3), 60),
        (NewtonCG(iterations=10, damping=0.0), 100),
        (LBFGS(history=10), 250),
        (LBFGS(trust_radius=2.0), 250),
    ],
    ids=repr,
)
def test_goes_down_the_valley_of_rosenbrock(optimizer, steps):
    values, x = descend(optimizer, rosenbrock, np.zeros(10), steps)
    assert values[-1] < 1e-10
    np.testing.assert_allclose(x, 1.0, atol=1e-4)


def test_lbfgs_is_bfgs_without_the_matrix():
    hessian, x = paraboloid(condition=20)
    optimizer = LBFGS(trust_radius=1e3, history=4, curvature=1e-6)
    state, pairs, before = optimizer.init({"x": x}), [], None
    for _ in range(8):
        gradient = hessian @ x
        if before is not None:
            pairs = [*pairs, (x - before[0], gradient - before[1])][-4:]
            s, y = pairs[-1]
            inverse = np.eye(6) * (s @ y) / (y @ y)
            for s, y in pairs:
                left = np.eye(6) - np.outer(s, y) / (s @ y)
                inverse = left @ inverse @ left.T + np.outer(s, s) / (s @ y)
            expected = -inverse @ gradient
        else:
            expected = -100 * gradient / np.linalg.norm(gradient)
        before = (x, gradient)
        step, state = optimizer.update(known(gradient, like={"x": x}), state, {"x": x})
        np.testing.assert_allclose(step["x"], expected, rtol=1e-7)
        x = x + step["x"]
    assert state.count == 4


def test_lbfgs_leaves_out_what_tells_of_no_curvature():
    """On a hill every pair does; it goes down, a tenth of the radius at a time."""
    optimizer, x = LBFGS(), np.array([1.0, 2.0])
    state = optimizer.init({"x": x})
    for _ in range(5):
        step, state = optimizer.update(Estimate(0.0, {"x": -x}), state, {"x": x})
        assert np.linalg.norm(step["x"]) == pytest.approx(0.05)
        assert step["x"] @ x > 0
        x = x + step["x"]
    assert state.count == 0
    _, state = optimizer.update(Estimate(0.0, {"x": -x}), state, {"x": x})  # neither moved nor changed
    assert state.count == 0


def test_lbfgs_bears_noise_in_proportion_to_the_gradient():
    rng = np.random.default_rng(0)

    def function(x):
        value, gradient = 0.5 * x @ hessian @ x, hessian @ x
        noise = rng.normal(size=10) * np.linalg.norm(gradient) / math.sqrt(10)
        return value, gradient + 0.2 * noise, hessian

    for seed in range(5):
        hessian, x = paraboloid(10, seed, condition=100)
        values, _ = descend(LBFGS(), function, x, 100)
        assert values[-1] < 1e-6 * values[0]


# ---------------------------------------------------------------------------------------------------- CMA-ES


def sphere(points):
    return np.sum((points - 0.3) ** 2, axis=1)


def search(optimizer, losses, state, parameters, steps, project=lambda x: x):
    """The parameters and states after each step."""
    path, states = [], []
    for _ in range(steps):
        step, state = optimizer.update(Estimate(0.0, {}, (LossFunction(losses),)), state, parameters)
        parameters = {key: project(x + step[key]) for key, x in parameters.items()}
        path.append(trees.ravel(parameters))
        states.append(state)
    return np.array(path), states, parameters


def read_back(state: CMAESState) -> CMAESState:
    """The state after a journey as plain arrays."""
    fields = {f.name: getattr(state, f.name) for f in dataclasses.fields(state)}
    assert {type(value) for value in fields.values()} == {dict, np.ndarray}
    return CMAESState(**{k: v.copy() for k, v in fields.items()})


@pytest.mark.parametrize("diagonal", [False, True])
def test_cma_es_converges_on_a_sphere(diagonal, tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    np.random.seed(5)  # noqa: NPY002
    expected = np.random.random()  # noqa: NPY002
    np.random.seed(5)  # noqa: NPY002
    optimizer, start = CMAES(sigma0=0.5, diagonal=diagonal), {"a": np.ones((2, 2)), "b": np.ones(1)}
    path, _, _ = search(optimizer, sphere, optimizer.init(start), start, 150)
    np.testing.assert_allclose(path[-1], 0.3, atol=1e-6)
    assert np.random.random() == expected, "the global generator was used"  # noqa: NPY002
    assert capfd.readouterr() == ("", "")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("n", "options"),
    [(1, {}), (2, {}), (5, {}), (5, {"population": 20}), (5, {"diagonal": True}), (320, {"diagonal": True})],
)
def test_a_search_read_back_goes_on_as_if_it_had_never_been_away(n, options):
    """With generations that teach nothing, and parameters that were projected, on the way."""

    def losses(points):
        calls.append(1)
        values = sphere(points)
        return np.zeros(len(points)) if len(calls) % 7 in (0, 3, 4) else np.where(values > 3 * n, np.nan, values)

    def go(away):
        calls.clear()
        state, parameters, path = optimizer.init(start), start, []
        for step in range(12):
            found, states, parameters = search(
                optimizer,
                losses,
                read_back(state) if step in away else state,
                parameters,
                1,
                lambda x: np.maximum(x, 0.4),
            )
            path.append(found[0])
            state = states[0]
        return np.array(path), state

    calls: list[int] = []
    optimizer, start = CMAES(seed=3, **options), {"x": np.ones(n)}
    path, state = go(())
    again, other = go((1, 5, 6, 9))
    np.testing.assert_array_equal(path, again)
    assert state.held.size > 0
    for f in dataclasses.fields(state):
        np.testing.assert_equal(getattr(other, f.name), getattr(state, f.name))


def test_cma_es_is_pure():
    """A state can be updated more than once, in any order."""
    optimizer, start = CMAES(), {"x": np.ones(4)}
    path, states, _ = search(optimizer, sphere, optimizer.init(start), start, 6)
    for index in (2, 2, 4, 1):
        again, _, _ = search(optimizer, sphere, states[index], {"x": path[index]}, 5 - index)
        np.testing.assert_array_equal(again, path[index + 1 :])


def test_seeds_are_told_apart():
    start = {"x": np.ones(4)}
    a, b, c = (search(CMAES(seed=s), sphere, CMAES(seed=s).init(start), start, 3)[0] for s in (0, 0, 1))
    np.testing.assert_array_equal(a, b)
    assert not np.array_equal(a, c)


def test_the_search_is_as_wide_as_learning_rates_say():
    seen = []

    def losses(points):
        seen.append(points)
        return points @ np.ones(6)

    optimizer = CMAES(sigma0=0.5, population=4000)
    optimizer.update(Estimate(0.0, {}, (LossFunction(losses),)), optimizer.init(LIKE, RATES), LIKE)
    np.testing.assert_allclose(seen[0].std(axis=0), 0.5 * SPREAD, rtol=0.05)
    scaled = search(CMAES(), sphere, CMAES().init(LIKE), LIKE, 5)[0]
    other = search(CMAES(), lambda p: sphere(p / SPREAD), CMAES().init(LIKE, RATES), LIKE, 5)[0]
    np.testing.assert_allclose(other / SPREAD, scaled, rtol=1e-9)


def test_the_search_follows_parameters_that_bounds_hold_back():
    """Otherwise the mean drifts off where losses are all the same, and the search narrows before it is back."""
    truth = np.random.default_rng(1).random(10)
    truth[:2] = 0, 1

    def losses(points):
        return np.mean((np.clip(points, 0, 1) - truth) ** 2, axis=1)

    optimizer, start = CMAES(sigma0=0.2), {"x": np.full(10, 0.5)}
    path, states, _ = search(optimizer, losses, optimizer.init(start), start, 200, lambda x: np.clip(x, 0, 1))
    np.testing.assert_allclose(path[-1], truth, atol=1e-4)
    assert 0 < len(states[-1].held) == len(states[-1].held_at) < 20


@pytest.mark.parametrize("value", [0.0, np.nan, np.inf])
def test_a_plateau_moves_nothing_and_ends_nothing(value):
    """Not even after the descent has ended: losses that all agree tell of nothing."""
    start = {"x": np.ones(3)}
    optimizer = CMAES(sigma0=0.5)
    path, states, there = search(optimizer, lambda p: np.full(len(p), value), optimizer.init(start), start, 20)
    np.testing.assert_array_equal(path, np.ones((20, 3)))
    seen = []

    def losses(points):
        seen.append(points)
        return sphere(points)

    path, _, _ = search(optimizer, losses, states[-1], there, 100)
    np.testing.assert_allclose(path[-1], 0.3, atol=1e-4)
    assert len(np.unique(np.concatenate(seen), axis=0)) == 100 * len(seen[0])


@pytest.mark.slow
def test_a_long_search_survives_its_own_success():
    """Until losses underflow, and on an ellipsoid that is as flat as numbers allow."""
    start = {"x": np.ones(3)}
    optimizer = CMAES(sigma0=0.5)
    path, _, _ = search(optimizer, lambda p: np.sum(p**2, axis=1), optimizer.init(start), start, 3000)
    assert np.abs(path[-1]).max() < 1e-150
    q, _ = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))
    squares = lambda p: ((p @ q) ** 2) @ np.array([1e-7, 1.0, 1e7])  # noqa: E731
    path, _, _ = search(optimizer, squares, optimizer.init(start), start, 1500)
    assert np.isfinite(path).all()
    assert squares(path[-1][None])[0] < 1e-15


# ---------------------------------------------------------------------------------------------------- all of them


@pytest.mark.mitsuba
def test_states_and_steps_on_the_device_are_those_of_numpy():
    import mitsuba as mi

    hessian, minimum = paraboloid()
    device = {key: kernels.on_device(x) for key, x in LIKE.items()}
    optimizers: list[Any] = [*FIRST_STEPS, Newton(inner_optimizer=Adam()), CMAES()]
    for optimizer in optimizers:
        like, other = LIKE, device
        states, compiled = [optimizer.init(like), optimizer.init(other)], []
        for _ in range(6):
            place = minimum - trees.ravel(like)
            expected, states[0] = optimizer.update(known(-hessian @ place, hessian, like, sphere), states[0], like)
            with kernels.recorded() as new:
                found, states[1] = optimizer.update(known(-hessian @ place, hessian, other, sphere), states[1], other)
                dr.eval(found, states[1])
            compiled.append(sum(new))
            assert all(isinstance(x, mi.TensorXf) for x in found.values())
            assert all(found[key].shape == x.shape for key, x in LIKE.items())
            np.testing.assert_allclose(trees.ravel(found), trees.ravel(expected), rtol=2e-4, atol=1e-6)
            like = {key: x + expected[key] for key, x in like.items()}
            other = {key: kernels.on_device(x) for key, x in like.items()}
        # One more may be an input in another order; a number that became a literal makes four.
        assert sum(compiled[2:]) <= 1, f"a kernel in each step: {optimizer} {compiled}"


@pytest.mark.mitsuba
def test_steps_have_the_parameters_type_and_memory_of_their_own():
    import mitsuba as mi

    single = {"x": np.ones((2, 3), np.float32)}
    vector = np.arange(6.0)
    found = trees.unravel(vector, single)
    vector[:] = 0
    assert found["x"].dtype == np.float32
    np.testing.assert_array_equal(found["x"], np.arange(6.0).reshape(2, 3))
    lone = {"a": mi.Float([1, 2]), "b": mi.TensorXf(np.array(3.0, np.float32))}
    np.testing.assert_array_equal(trees.ravel(trees.unravel(np.array([4.0, 5.0, 6.0]), lone)), [4, 5, 6])


@pytest.mark.parametrize(
    ("optimizer", "order"),
    [
        (Newton(trust_radius=2.0), "hessian"),
        (NewtonCG(trust_radius=2.0, inner_optimizer=Adam(0.03, schedule=Exponential(20))), "hvp"),
        (LBFGS(trust_radius=2.0), "gradient"),
        (CMAES(sigma0=0.2), "gradient"),
    ],
    ids=["Newton", "NewtonCG", "LBFGS", "CMAES"],
)
def test_a_whole_run(optimizer, order):
    truth = {"x": np.array([0.2, 0.8]), "y": np.array([0.4])}
    renderer = AnalyticRenderer(truth, np.random.default_rng(0).random((4 * 4 * 3, 3)), noise=0.05)
    parameters = [ur.Parameter("x", 0.5, bounds=(0, 1)), ur.Parameter("y", 0.6, bounds=(0, 1), learning_rate=0.5)]
    problem = ur.Problem(renderer, parameters, [ur.View(renderer.exact(truth))], truth=truth)
    estimator = ur.SmoothedDerivatives(0.03, samples=16, order=order)
    found = ur.optimize(problem, estimator, optimizer, steps=60)
    assert max(problem.parameter_error(found.parameters).values()) < 0.1
    again = ur.optimize(problem, estimator, optimizer, steps=60)
    for key in truth:
        np.testing.assert_array_equal(found.parameters[key], again.parameters[key])


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Newton(damping=0.0), "Newton: damping must be a finite number > 0 and < 1, got 0.0"),
        (lambda: Newton(trust_radius=-1), "Newton: trust_radius must be a finite number > 0, got -1"),
        (lambda: Newton(learning_rate=0), "Newton: learning_rate must be a finite number > 0, got 0"),
        (lambda: Newton(step_scale=1.5), "Newton: step_scale must be at most 1, got 1.5"),
        (lambda: Newton(inner_optimizer="adam"), "Newton: inner_optimizer must be an Adam or None, got 'adam'"),  # type: ignore
        (lambda: NewtonCG(iterations=0), "NewtonCG: iterations must be a whole number of at least 1, got 0"),
        (lambda: NewtonCG(trust_radius=0), "NewtonCG: trust_radius must be a finite number > 0, got 0"),
        (lambda: NewtonCG(tolerance=1.0), "NewtonCG: tolerance must be a finite number >= 0 and < 1, got 1.0"),
        (lambda: LBFGS(history=2.5), "LBFGS: history must be a whole number of at least 1, got 2.5"),  # type: ignore
        (lambda: LBFGS(curvature=0), "LBFGS: curvature must be a finite number > 0 and < 1, got 0"),
        (
            lambda: LBFGS(trust_radius=None),  # type: ignore
            "LBFGS: trust_radius must be a finite number > 0, got None",
        ),
        (lambda: CMAES(sigma0=0.0), "CMAES: sigma0 must be a finite number > 0, got 0.0"),
        (lambda: CMAES(population=3), "CMAES: population must be a whole number of at least 4, got 3"),
        (lambda: CMAES(seed=-1), "CMAES: seed must be a whole number of at least 0, got -1"),
        (lambda: CMAES(diagonal=1), "CMAES: diagonal must be true or false, got 1"),  # type: ignore
        (lambda: CMAES(learning_rate=-1), "CMAES: learning_rate must be a finite number > 0, got -1"),
        (
            lambda: CMAES().init(LIKE, {"c": 1.0}),
            'CMAES: learning rate given for unknown parameter "c"',
        ),
        (
            lambda: search(CMAES(population=6), lambda p: p, CMAES(population=6).init(LIKE), LIKE, 1),
            "CMAES: losses must have shape (6,), one per point, got (6, 6)",
        ),
    ],
)
def test_bad_arguments_are_named(make, message):
    with pytest.raises(InputError) as caught:
        make()
    assert str(caught.value).startswith(message)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("optimizer", [Newton(), NewtonCG(), LBFGS()], ids=["Newton", "NewtonCG", "LBFGS"])
def test_trust_regions_are_as_wide_as_the_smoothing(optimizer):
    """Half a σ of each parameter, wherever the gradient is steep enough; and no farther than with σ as the unit of the parameters."""
    parameters = {"a": np.zeros(2), "b": np.zeros(1)}
    gradient = {"a": np.array([3e3, -1e3]), "b": np.array([2e3])}

    def first(sigma: dict[str, float] | None, own: dict[str, float] | None = None) -> np.ndarray:
        scale = np.array([sigma["a"], sigma["a"], sigma["b"]]) if sigma else np.ones(3)
        hessian = np.diag(1 / scale**2)
        products = HessianProduct(lambda v: trees.unravel(hessian @ trees.ravel(v), parameters))
        smoothing = () if sigma is None else (Smoothing(sigma),)
        found = Estimate(0.0, gradient, (Hessian(hessian), products, *smoothing))
        return trees.ravel(optimizer.update(found, optimizer.init(parameters, own), parameters)[0])

    for sigma in ({"a": 0.2, "b": 0.2}, {"a": 0.01, "b": 0.5}):
        step = first(sigma)
        reach = np.linalg.norm(step / np.array([sigma["a"], sigma["a"], sigma["b"]]))
        assert reach == pytest.approx(0.05 if isinstance(optimizer, LBFGS) else 0.5)
    assert np.linalg.norm(first(None)) == pytest.approx(0.05 if isinstance(optimizer, LBFGS) else 0.5)
    # a parameter's own rate is in its units, and no multiple of σ
    np.testing.assert_array_equal(first({"a": 0.01, "b": 0.5}, {"b": 0.01}), first({"a": 0.01, "b": 0.5}))


@pytest.mark.parametrize(
    "optimizer",
    [
        Newton(trust_radius=2.0, damping=1e-3),
        NewtonCG(trust_radius=2.0, iterations=8, damping=1e-3, tolerance=1e-3),
        LBFGS(trust_radius=2.0),
        AveragedNewton(),
    ],
    ids=lambda optimizer: type(optimizer).__name__,
)
@pytest.mark.parametrize("known", [True, False])
def test_bounded_elements_do_not_lead_the_others_astray(optimizer: Any, known: bool) -> None:
    """Half of eight correlated elements are at bounds where the loss is least. The planted fault leaves these unknown."""
    rng = np.random.default_rng(0)
    matrix = rng.normal(size=(40, 8))
    matrix[:, 1:] += 0.8 * matrix[:, :1]
    hessian, minimum = matrix.T @ matrix / 40, rng.uniform(-0.6, 1.6, 8)
    root = np.linalg.cholesky(hessian).T
    expected = lsq_linear(root, root @ minimum, (0.0, 1.0)).x
    x = np.full(8, 0.5)
    state = optimizer.init({"x": x})
    for _ in range(60):
        at = AtBounds(lambda x=x: {"x": (x >= 1.0).astype(float) - (x <= 0.0)})
        curvature = Hessian(hessian), HessianProduct(lambda v: {"x": hessian @ v["x"]})
        estimate = Estimate(0.0, {"x": hessian @ (x - minimum)}, (*curvature, *([at] if known else [])))
        step, state = optimizer.update(estimate, state, {"x": x})
        x = np.clip(x + step["x"], 0.0, 1.0)
    assert bool(np.abs(x - expected).max() < 1e-3) is known


def test_the_loop_tells_optimizers_which_elements_are_at_their_bounds() -> None:
    """Two numbers with nearly the same picture, whose minimum without bounds is far outside."""
    matrix = np.random.default_rng(0).uniform(size=(48, 1)) * [1.0, 0.8] + 0.1 * np.eye(48, 2)
    renderer = AnalyticRenderer({"a": np.array([-1.0]), "b": np.array([1.5])}, matrix, 0.0, 0.0)
    reference = renderer.exact({"a": np.array([-1.0]), "b": np.array([1.5])})
    problem = ur.Problem(renderer, [ur.Parameter("a", 0.5, (0, 1)), ur.Parameter("b", 0.5)], [ur.View(reference)])
    best = matrix[:, 1] @ reference.ravel() / (matrix[:, 1] @ matrix[:, 1])
    result = ur.optimize(problem, ur.GaussNewton(2, 2), AveragedNewton(), steps=9)
    assert result.parameters["a"] == pytest.approx([1e-4], abs=1e-6)
    assert result.parameters["b"] == pytest.approx([best], abs=1e-3)


def test_parts_of_a_partition_know_smoothing_and_bounds() -> None:
    """Both are what the same optimizer gets alone: the trust region is in units of σ, and an element at its bound stays."""
    like, gradient = {"a": np.zeros(2), "b": np.zeros(1)}, {"a": np.array([3.0, 1.0]), "b": np.ones(1)}
    at = AtBounds(lambda: {"a": np.array([-1.0, 0.0]), "b": np.zeros(1)})
    whole = Estimate(0.0, gradient, (Smoothing({"a": 0.01, "b": 0.5}), at))
    partition = Partitioned(("b",), Adam(), LBFGS())
    steps, _ = partition.update(whole, partition.init(like), like)
    np.testing.assert_allclose(steps["a"], [0.0, -0.05 * 0.01])
