"""Adam and SGD against closed forms, in NumPy and on the device."""

import dataclasses

import drjit as dr
import numpy as np
import pytest

import kernels
from unrender.core import arrays
from unrender.core.errors import InputError
from unrender.estimators.base import Estimate
from unrender.estimators.capabilities import Variance
from unrender.optimizers import SGD, Adam, Chain, MetaAdam, ScheduleFree
from unrender.optimizers.transforms import ClipDirection, ScaleByDeviation
from unrender.schedules import Constant, Cosine, Exponential, Steps, Warmup

OPTIMIZERS = [
    SGD(0.1),
    SGD(0.1, momentum=0.9),
    Adam(0.1),
    Adam(0.1, beta_1=0.5, beta_2=0.9, epsilon=0.01),
]
EVERY = [*OPTIMIZERS, ScheduleFree(0.1)]


def take(optimizer, gradients, parameters=None, learning_rates=None):
    """The steps that a list of gradients {key: array} leads to."""
    state = optimizer.init(parameters or gradients[0], learning_rates)
    steps = []
    for gradient in gradients:
        step, state = optimizer.update(Estimate(0.0, gradient), state, parameters or gradient)
        steps.append(step)
    return steps


@pytest.fixture
def gradients():
    random = np.random.default_rng(6)
    return [{"a": random.normal(size=(4, 3)), "b": 1e-3 * random.normal(size=(2,))} for _ in range(30)]


def test_adam_is_the_ratio_of_the_direct_weighted_means(gradients):
    optimizer = Adam(0.1, beta_1=0.8, beta_2=0.95, epsilon=1e-3)
    for key in ("a", "b"):
        g = np.array([gradient[key] for gradient in gradients])
        for n, step in enumerate(take(optimizer, gradients), 1):
            w_1, w_2 = (beta ** np.arange(n - 1, -1, -1.0) for beta in (0.8, 0.95))
            mean = np.tensordot(w_1 / w_1.sum(), g[:n], 1)
            square = np.tensordot(w_2 / w_2.sum(), g[:n] ** 2, 1)
            np.testing.assert_allclose(step[key], -0.1 * mean / (np.sqrt(square) + 1e-3), rtol=1e-10)


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
def test_adams_first_step_is_the_learning_rate_whatever_the_scale(scale):
    (step,) = take(Adam(0.25, epsilon=1e-30), [{"a": scale * np.array([3.0, -0.1, 0.0])}])
    np.testing.assert_allclose(step["a"], [-0.25, 0.25, 0.0], rtol=1e-12)


def test_sgd_closed_form(gradients):
    for n, step in enumerate(take(SGD(0.2), gradients)):
        np.testing.assert_allclose(step["a"], -0.2 * gradients[n]["a"])
    g = np.array([gradient["a"] for gradient in gradients])
    for n, step in enumerate(take(SGD(0.2, momentum=0.7), gradients), 1):
        np.testing.assert_allclose(step["a"], -0.2 * np.tensordot(0.7 ** np.arange(n - 1, -1, -1.0), g[:n], 1))


@pytest.mark.parametrize("optimizer", OPTIMIZERS, ids=repr)
def test_learning_rates_are_the_parameters_own(optimizer, gradients):
    plain = take(optimizer, gradients)
    own = take(optimizer, gradients, learning_rates={"b": 0.5})
    for a, b in zip(plain, own, strict=True):
        np.testing.assert_array_equal(a["a"], b["a"])
        np.testing.assert_allclose(5.0 * a["b"], b["b"])


@pytest.mark.parametrize("optimizer", OPTIMIZERS, ids=repr)
@pytest.mark.parametrize(
    "schedule", [Constant(0.5), Exponential(3), Cosine(20), Steps(4), Warmup(5, Cosine(10, 0.1))], ids=repr
)
def test_schedules_act(optimizer, schedule, gradients):
    plain = take(optimizer, gradients)
    scheduled = take(dataclasses.replace(optimizer, schedule=schedule), gradients)
    for step, (a, b) in enumerate(zip(plain, scheduled, strict=True)):
        np.testing.assert_allclose(b["a"], schedule(step) * a["a"], rtol=1e-12, atol=1e-15)


@pytest.mark.parametrize("optimizer", [SGD(0.1), SGD(0.02, momentum=0.9), Adam(0.1, schedule=Cosine(1500))], ids=repr)
def test_reaches_the_bottom_of_a_parabola(optimizer):
    scale, bottom = np.array([1.0, 5.0]), np.array([2.0, -3.0])
    parameters = {"x": np.zeros(2)}
    state = optimizer.init(parameters)
    for _ in range(1500):
        estimate = Estimate(0.0, {"x": scale * (parameters["x"] - bottom)})
        steps, state = optimizer.update(estimate, state, parameters)
        parameters = {"x": parameters["x"] + steps["x"]}
    np.testing.assert_allclose(parameters["x"], bottom, atol=1e-4)


def test_adam_goes_down_the_valley_of_rosenbrock():
    optimizer, parameters = Adam(0.02, schedule=Exponential(3000)), {"x": np.array([-1.2, 1.0])}
    state = optimizer.init(parameters)
    for _ in range(10_000):
        x, y = parameters["x"]
        gradient = np.array([-2 * (1 - x) - 400 * x * (y - x * x), 200 * (y - x * x)])
        steps, state = optimizer.update(Estimate(0.0, {"x": gradient}), state, parameters)
        parameters = {"x": parameters["x"] + steps["x"]}
    np.testing.assert_allclose(parameters["x"], [1.0, 1.0], atol=1e-2)


@pytest.mark.parametrize("optimizer", EVERY, ids=repr)
def test_pure_and_of_the_parameters_kind(optimizer, gradients):
    gradients = [{key: g.astype(np.float32) for key, g in gradient.items()} for gradient in gradients[:2]]
    state = optimizer.init(gradients[0])
    _, state = optimizer.update(Estimate(0.0, gradients[0]), state, gradients[0])
    kept = {f.name: str(getattr(state, f.name)) for f in dataclasses.fields(state)}
    first, _ = optimizer.update(Estimate(0.0, gradients[1]), state, gradients[0])
    second, _ = optimizer.update(Estimate(0.0, gradients[1]), state, gradients[0])
    assert {f.name: str(getattr(state, f.name)) for f in dataclasses.fields(state)} == kept
    for key in first:
        np.testing.assert_array_equal(first[key], second[key])
        assert first[key].dtype == np.float32


def kernels_per_step(optimizer, gradients):
    """Number of kernels that each step on the device compiles; also checks the steps against NumPy's."""
    import mitsuba as mi

    shared = {key: kernels.on_device(np.stack([g[key] for g in gradients])) for key in gradients[0]}
    state, compiled = optimizer.init({key: shared[key][0] for key in shared}), []
    for n, expected in enumerate(take(optimizer, gradients)):
        gradient = {key: shared[key][n] for key in shared}
        dr.eval(gradient)
        with kernels.recorded() as new:
            steps, state = optimizer.update(Estimate(0.0, gradient), state, gradient)
            arrays.evaluate(steps, state)
        assert new
        compiled.append(sum(new))
        for key, step in steps.items():
            assert isinstance(step, mi.TensorXf)
            np.testing.assert_allclose(arrays.numpy(step), expected[key], rtol=1e-4, atol=1e-7)
    return compiled


@pytest.mark.mitsuba
@pytest.mark.parametrize("optimizer", EVERY, ids=repr)
def test_device_agrees_with_numpy_and_compiles_nothing_after_warm_up(optimizer, gradients):
    optimizer = dataclasses.replace(optimizer, schedule=Warmup(5, Cosine(20)))
    assert not any(kernels_per_step(optimizer, gradients)[3:])


@pytest.mark.mitsuba
def test_a_changing_python_number_would_be_noticed(gradients, monkeypatch):
    """The test above is able to fail: with plain numbers, every step's kernel is a new one."""
    monkeypatch.setattr(arrays, "scalar", lambda value, like: value)
    assert all(kernels_per_step(Adam(0.0123, schedule=Cosine(123)), gradients)[3:])


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Adam(0), "Adam: learning_rate must be a finite number > 0, got 0"),
        (lambda: Adam(learning_rate=True), "Adam: learning_rate must be a finite number > 0, got True"),
        (lambda: Adam(beta_1=1.0), "Adam: beta_1 must be a finite number >= 0 and < 1, got 1.0"),
        (lambda: Adam(beta_2=-0.1), "Adam: beta_2 must be a finite number >= 0 and < 1, got -0.1"),
        (lambda: Adam(epsilon=0.0), "Adam: epsilon must be a finite number > 0, got 0.0"),
        (
            lambda: Adam(schedule="cosine"),  # type: ignore
            "Adam: schedule must be one of unrender.schedules or None, got 'cosine'",
        ),
        (lambda: SGD(float("nan")), "SGD: learning_rate must be a finite number > 0, got nan"),
        (lambda: SGD(momentum=1), "SGD: momentum must be a finite number >= 0 and < 1, got 1"),
        (
            lambda: Adam().init({"wall": np.zeros(2)}, {"wal": 0.1}),
            'Adam: learning rate given for unknown parameter "wal"; did you mean wall?',
        ),
        (
            lambda: SGD().init({"wall": np.zeros(2)}, {"wall": -1.0}),
            'SGD: learning rate of "wall" must be a finite number > 0, got -1.0',
        ),
        (
            lambda: take(SGD(schedule=lambda step: -1.0), [{"a": np.ones(1)}]),
            "SGD: schedule must return a finite factor >= 0, got -1.0 at step 0",
        ),
    ],
)
def test_bad_arguments_are_named(make, message):
    with pytest.raises(InputError) as caught:
        make()
    assert str(caught.value) == message


# ---------------------------------------------------------------------------------------------------- MetaAdam


def meta_take(optimizer, gradients, variances, learning_rates=None):
    state, steps = optimizer.init(gradients[0], learning_rates), []
    for gradient, variance in zip(gradients, variances, strict=True):
        step, state = optimizer.update(Estimate(0.0, gradient, (Variance(variance),)), state, gradient)
        steps.append(step)
    return steps


def test_meta_adam_divides_by_the_deviation_it_is_given(gradients):
    variances = [{key: np.square(g) / (n + 1) for key, g in tree.items()} for n, tree in enumerate(gradients)]
    optimizer = MetaAdam(0.1, epsilon=1e-12, schedule=Steps(10, 0.5))
    for n, step in enumerate(meta_take(optimizer, gradients, variances, {"b": 0.3})):
        for key, rate in (("a", 0.1), ("b", 0.3)):
            expected = -rate * 0.5 ** (n // 10) * gradients[n][key] / np.sqrt(variances[n][key] + 1e-12)
            np.testing.assert_allclose(step[key], expected, rtol=1e-12)


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
def test_meta_adams_first_step_is_the_learning_rate_whatever_the_scale(scale):
    """A first meta-estimate's variance is its square; an element that knows nothing stays where it is."""
    gradient = {"a": scale * np.array([3.0, -0.1, 0.0])}
    (step,) = meta_take(MetaAdam(0.25, epsilon=1e-30), [gradient], [{"a": gradient["a"] ** 2}])
    np.testing.assert_allclose(step["a"], [-0.25, 0.25, 0.0], rtol=1e-9)


def test_meta_adams_steps_may_be_limited():
    gradient, variance = {"a": np.array([3.0, -2.0, 0.1])}, {"a": np.array([1e-4, 1.0, 1.0])}
    (step,) = meta_take(Chain((ScaleByDeviation(), ClipDirection(5.0)), 0.1), [gradient], [variance])
    np.testing.assert_allclose(step["a"], [-0.5, 0.2, -0.01])


@pytest.mark.mitsuba
def test_meta_adam_is_the_same_on_the_device_and_compiles_nothing(gradients):
    variances = [{key: np.square(g) + 0.1 for key, g in tree.items()} for tree in gradients]
    optimizer = MetaAdam(0.1, schedule=Exponential(7))
    expected = meta_take(optimizer, gradients, variances)
    device = [{key: kernels.on_device(x) for key, x in tree.items()} for tree in gradients]
    spread = [{key: kernels.on_device(x) for key, x in tree.items()} for tree in variances]
    state, made = optimizer.init(device[0]), 0
    for n, (gradient, variance) in enumerate(zip(device, spread, strict=True)):
        with kernels.recorded() as new:
            step, state = optimizer.update(Estimate(0.0, gradient, (Variance(variance),)), state, gradient)
            dr.eval(step)
        made += sum(new)
        np.testing.assert_allclose(np.array(step["a"]), expected[n]["a"], rtol=1e-4)
    assert made <= 6, "a kernel for each size, in a few orders of its inputs; not one per step"


@pytest.mark.parametrize(
    ("options", "field"),
    [({"learning_rate": 0}, "learning_rate"), ({"epsilon": 0.0}, "epsilon")],
)
def test_meta_adam_refuses(options, field):
    with pytest.raises(InputError, match=f"MetaAdam: {field}"):
        MetaAdam(**options)


@pytest.mark.parametrize("begun", [-1, 4, 2**63 - 1])
def test_a_chain_that_began_after_its_step_is_refused(begun: int) -> None:
    """A damaged checkpoint may say so; moments of fewer than zero steps overflow."""
    parameters = {"a": np.ones(2)}
    state = dataclasses.replace(Adam(0.1).init(parameters), begun=begun)
    with pytest.raises(InputError, match="begun"):
        Adam(0.1).update(Estimate(0.0, parameters), state, parameters)
