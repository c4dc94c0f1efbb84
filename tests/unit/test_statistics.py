"""Running covariance, control weight and recursion against closed forms, in NumPy and on the device."""

import numpy as np
import pytest

import kernels
from unrender import statistics
from unrender.core import arrays
from unrender.statistics import welford
from unrender.statistics.recursion import advance

DECAYS = [(0.9, 0.999), (0.5, 0.9), (0.0, 0.0), (0.0, 0.99), (0.99, 0.5)]


def run(xs, ys, alpha=0.9, beta=0.999):
    state = welford.init(xs[0])
    for x, y in zip(xs, ys, strict=True):
        state = welford.update(state, x, y, alpha, beta)
    return state


def direct(xs, ys, alpha, beta):
    """The weighted sum that the module's docstring defines, with every weight written out."""

    def weights(count, decay):
        raw = decay ** np.arange(count - 1, -1, -1.0)
        return raw / raw.sum()

    products = []
    for k in range(1, len(xs)):
        a = weights(k, alpha)
        innovation_x = xs[k] - np.tensordot(a, xs[:k], 1)
        innovation_y = ys[k] - np.tensordot(a, ys[:k], 1)
        products.append(innovation_x * innovation_y / (1 + (a**2).sum()))
    return np.tensordot(weights(len(products), beta), products, 1)


def listing_2(xs, ys, alpha, beta):
    """Listing 2 of the paper as printed, its 0/0 at the first sample taken as 0."""
    mean_x = mean_y = moment = 0.0
    for n, (x, y) in enumerate(zip(xs, ys, strict=True), 1):
        dy = y - mean_y / (1 - alpha ** (n - 1)) if n > 1 else 0.0
        mean_y = alpha * mean_y + (1 - alpha) * y
        mean_x = alpha * mean_x + (1 - alpha) * x
        dx = x - mean_x / (1 - alpha**n)
        moment = beta * moment + (1 - beta) * dx * dy
    return moment / (1 - beta ** len(xs))


@pytest.fixture
def stream():
    random = np.random.default_rng(3)
    xs = random.normal(5.0, 2.0, (40, 6, 3))
    return xs, 0.6 * xs + random.normal(-1.0, 1.0, xs.shape)


@pytest.mark.parametrize(("alpha", "beta"), DECAYS)
@pytest.mark.parametrize("count", [2, 3, 40])
def test_covariance_is_the_direct_weighted_sum(stream, alpha, beta, count):
    xs, ys = (s[:count] for s in stream)
    expected = direct(xs, ys, alpha, beta)
    np.testing.assert_allclose(welford.covariance(run(xs, ys, alpha, beta)), expected, rtol=1e-9, atol=1e-12)


def test_covariance_is_not_another_weighted_sum(stream):
    """The comparison above is sharp: one decay slightly off, or the innovations not divided by 1 + s, and it fails."""
    xs, ys = stream
    actual = welford.covariance(run(xs, ys))
    for alpha, beta in [(0.89, 0.999), (0.9, 0.99)]:
        assert not np.allclose(actual, direct(xs, ys, alpha, beta), rtol=1e-3)
    assert not np.allclose(actual, listing_2(xs, ys, 0.9, 0.999), rtol=1e-3)


@pytest.mark.parametrize(("alpha", "beta"), DECAYS)
@pytest.mark.parametrize("count", [2, 3, 30])
def test_unbiased_for_independent_samples_exactly(alpha, beta, count):
    """cov_n = Σ_jk Q_jk x_j y_k is unbiased exactly when trace Q = 1 and Σ Q = 0. Pixel j of this stream is 1 at
    sample j alone, so its variance is Q_jj; a constant stream's is Σ Q."""
    unit = np.eye(count)
    assert welford.covariance(run(unit, unit, alpha, beta)).sum() == pytest.approx(1.0, rel=1e-12)
    constant = np.full((count, 1), 7.25)
    assert welford.covariance(run(constant, constant, alpha, beta)) == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize("count", [2, 5, 40])
def test_listing_2_is_this_covariance_times_the_factor_that_the_docstring_states(stream, count):
    xs, ys = (s[:count] for s in stream)
    alpha, beta = 0.9, 0.999
    factor = 2 * alpha / (1 + alpha) * (1 - beta ** (count - 1)) / (1 - beta**count)
    expected = welford.covariance(run(xs, ys, alpha, beta)) * factor
    np.testing.assert_allclose(listing_2(xs, ys, alpha, beta), expected, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("alpha", [0.9, 0.5, 0.0])
def test_drift_adds_what_the_docstring_states(alpha):
    """A noiseless ramp: all of its 'covariance' is drift."""
    ramp = np.arange(600.0)[:, None]
    added = welford.covariance(run(0.3 * ramp, -0.2 * ramp, alpha, 0.9))
    assert added == pytest.approx(0.3 * -0.2 * (1 + alpha) / (2 * (1 - alpha) ** 2), rel=1e-9)


def test_nothing_known_before_two_samples(stream):
    xs, ys = stream
    np.testing.assert_array_equal(welford.covariance(welford.init(xs[0])), np.zeros_like(xs[0]))
    np.testing.assert_array_equal(welford.covariance(run(xs[:1], ys[:1])), np.zeros_like(xs[0]))
    assert np.all(welford.covariance(run(xs[:2], xs[:2])) > 0)


def test_cauchy_schwarz_holds_for_the_estimates(stream):
    """The three statistics share their weights, so a correlation estimated from them is one."""
    xs, ys = stream
    var_x, var_y, cov = (welford.covariance(run(*pair)) for pair in [(xs, xs), (ys, ys), (xs, ys)])
    assert np.all(var_x > 0)
    assert np.all(cov**2 <= var_x * var_y)


def test_control_weight_closed_form():
    assert statistics.control_weight(1.0, 1.0, 1.0) == 0.5
    assert statistics.control_weight(0.3, 1.0, 0.5) == pytest.approx(0.2)
    cov = np.array([2.0, -1.0, 0.0, np.nan, 1.0, 1.0, 0.0])
    var_previous = np.array([1.0, 1.0, 1.0, 1.0, np.nan, 1.0, 0.0])
    var_cv = np.array([0.5, 0.5, 0.0, 1.0, 1.0, np.inf, 0.0])
    np.testing.assert_array_equal(
        statistics.control_weight(cov, var_previous, var_cv), [1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]
    )


def test_control_weight_has_the_least_variance():
    random = np.random.default_rng(4)
    var_current, var_previous, var_cv = random.uniform(0.5, 2.0, (3, 200))
    cov = random.uniform(0.0, 1.0, 200) * np.sqrt(var_current * var_previous)

    def variance(w):
        return statistics.control_variate_variance(w, var_current, var_previous, cov, var_cv)

    w = statistics.control_weight(cov, var_previous, var_cv)
    assert np.all((w > 0) & (w < 1))
    for other in (w - 0.01, w + 0.01, 0 * w, 0 * w + 1):
        assert np.all(variance(w) < variance(other))


def test_control_variate_variance_closed_form():
    assert statistics.control_variate_variance(0.0, 2.0, 3.0, 1.0, 5.0) == 2.0
    assert statistics.control_variate_variance(0.5, 2.0, 3.0, 1.0, 5.0) == 2.0 + 0.25 * 3 - 2 * 0.5 + 0.25 * 5
    assert statistics.control_variate_variance(1.0, 0.1, 0.1, 5.0, 0.0) == 0.0  # -9.8 is no variance


def test_the_recursion_is_the_mean_of_an_unchanging_scene():
    images = np.random.default_rng(5).normal(size=(10, 4, 3))
    memory = images[0]
    for n in range(1, 10):
        memory = advance(memory, images[n], images[n], n / (n + 1))
    np.testing.assert_allclose(memory, images.mean(axis=0), atol=1e-12)


def test_the_recursion_forgets_a_memory_that_is_not_finite():
    memory, ones = np.array([np.nan, np.inf, 3.0]), np.ones(3)
    np.testing.assert_array_equal(advance(memory, 2 * ones, ones, 0.5 * ones), [2.0, 2.0, 3.0])
    assert np.isnan(advance(ones, ones * np.nan, ones, 0.5)).all()  # a broken current image must show


def step(state, memory, x, y):
    """One turn of everything, as an image estimator takes it."""
    cov = welford.covariance(state)
    w = statistics.control_weight(cov, 1.0 + cov * cov, 0.5)
    variance = statistics.control_variate_variance(w, 1.0, 1.0, cov, 0.5)
    return welford.update(state, x, y), advance(memory, x, y, w), w, variance


@pytest.mark.mitsuba
def test_device_agrees_with_numpy_and_compiles_nothing_after_warm_up(stream):
    xs, ys = (s.astype(np.float32) for s in stream)
    host = welford.init(xs[0].astype(float)), xs[0].astype(float)
    device = welford.init(kernels.on_device(xs[0])), kernels.on_device(xs[0])
    compiled = []
    for x, y in zip(xs, ys, strict=True):
        host = step(*host[:2], x.astype(float), y.astype(float))
        x, y = kernels.on_device(x), kernels.on_device(y)
        with kernels.recorded() as new:
            device = step(*device[:2], x, y)
            arrays.evaluate(device)
        assert new
        compiled.append(sum(new))
        for a, b in zip(device[1:], host[1:], strict=True):
            np.testing.assert_allclose(arrays.numpy(a), b, rtol=2e-5, atol=2e-5)
    assert not any(compiled[3:]), compiled
    np.testing.assert_allclose(
        arrays.numpy(welford.covariance(device[0])), welford.covariance(host[0]), rtol=1e-5, atol=1e-5
    )


@pytest.mark.mitsuba
def test_device_treats_the_unknown_as_numpy_does():
    import mitsuba as mi

    nan, inf = float("nan"), float("inf")
    cov = np.array([2.0, -1.0, nan, 1.0, 1.0, 0.0], np.float32)
    var_previous = np.array([1.0, 1.0, 1.0, nan, 1.0, 0.0], np.float32)
    var_cv = np.array([0.5, 0.5, 1.0, 1.0, inf, 0.0], np.float32)
    weight = statistics.control_weight(*(mi.TensorXf(a) for a in (cov, var_previous, var_cv)))
    np.testing.assert_array_equal(arrays.numpy(weight), [1.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    memory, ones = mi.TensorXf(np.array([nan, inf, 3.0], np.float32)), mi.TensorXf(np.ones(3, np.float32))
    np.testing.assert_array_equal(arrays.numpy(advance(memory, 2 * ones, ones, 0.5 * ones)), [2.0, 2.0, 3.0])
    zeros = arrays.numpy(welford.covariance(welford.update(welford.init(ones), ones, ones)))
    np.testing.assert_array_equal(zeros, np.zeros(3))
