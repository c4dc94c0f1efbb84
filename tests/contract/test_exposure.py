"""Exposures of photographs: factors of pictures whose geometric mean is 1, exact derivatives, whole views and pixels, pairs and batches."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from backends import TEXTURE, linear, surface

import unrender as ur
from tiers import quick
from unrender.core import arrays
from unrender.core.random import Key
from unrender.core.trees import Tree
from unrender.rendering.exposure import EXPOSURE, ExposedRenderer, gains
from unrender.rendering.mitsuba.renderer import MitsubaRenderer
from unrender.rendering.renderer import SampleRequest

MAKE = {
    "linear": (lambda: ExposedRenderer(linear(), [1, 0]), ("map", EXPOSURE)),
    "surface": (lambda: ExposedRenderer(MitsubaRenderer(surface, 2), [1, 0]), (TEXTURE, EXPOSURE)),
}


def numbers(x: Any) -> np.ndarray:
    return np.array(arrays.numpy(x)).astype(np.float64)


def state_of(renderer: ExposedRenderer, keys: tuple[str, ...], seed: int = 5) -> Tree:
    rng = np.random.default_rng(seed)
    found = renderer.values(list(keys))
    return found | {EXPOSURE: renderer.array(rng.normal(0.2, 0.5, (2, 3)))}


@pytest.fixture(scope="module", params=quick(MAKE, "linear"))
def made(request: pytest.FixtureRequest) -> tuple[ExposedRenderer, tuple[str, ...]]:
    make, keys = MAKE[request.param]
    return make(), keys


def requests(renderer: ExposedRenderer, groups: int = 2) -> list[SampleRequest]:
    """A whole film of each sensor, some of its pixels, and pixels of both."""
    like = renderer.array(np.zeros(1))
    pixels = arrays.like_integers(np.array([3, 0, 5, 3, 9]), like)
    sensors = arrays.like_integers(np.array([1, 0, 0, 1, 1]), like)
    return [
        SampleRequest(0, 4, 5, groups),
        SampleRequest(1, 4, 6, groups),
        SampleRequest(1, 4, 7, groups, pixels),
        SampleRequest(0, 4, 8, groups, pixels, sensors),
    ]


def test_pictures_are_those_of_the_scene_times_the_gains(made: tuple[ExposedRenderer, tuple[str, ...]]) -> None:
    renderer, keys = made
    session, plain = renderer.prepare(list(keys), None), renderer.inner.prepare([keys[0]], None)
    state = state_of(renderer, keys)
    factor = gains(numbers(state[EXPOSURE]))
    np.testing.assert_allclose(np.log(factor).mean(0), 0, atol=1e-6)
    assert abs(np.log(factor)).max() > 0.1
    rows = {0: 1, 1: 0}  # the renderer was given the sensors in the order 1, 0
    for request in requests(renderer):
        shown = numbers(plain.image({keys[0]: state[keys[0]]}, request).images)
        own = (
            [rows[s] for s in numbers(request.sensors).astype(int)]
            if request.sensors is not None
            else rows[request.sensor]
        )
        found = numbers(session.image(state, request).images)
        np.testing.assert_allclose(found, shown * factor[own], rtol=1e-5, atol=1e-7)


def test_a_brighter_exposure_of_all_photographs_changes_nothing(made: tuple[ExposedRenderer, tuple[str, ...]]) -> None:
    renderer, keys = made
    session = renderer.prepare(list(keys), None)
    state = state_of(renderer, keys)
    brighter = state | {EXPOSURE: renderer.array(numbers(state[EXPOSURE]) + [1.0, -2.0, 0.3])}
    request = requests(renderer)[0]
    found, other = (numbers(session.image(x, request).images) for x in (state, brighter))
    np.testing.assert_allclose(found, other, rtol=1e-5)


def test_adjoints_are_the_derivatives_of_the_pictures(made: tuple[ExposedRenderer, tuple[str, ...]]) -> None:
    """By central differences of the same random numbers, of whole films, of pixels, and of pixels of several sensors."""
    renderer, keys = made
    session = renderer.prepare(list(keys), None)
    state = state_of(renderer, keys)
    rng = np.random.default_rng(2)
    for request in requests(renderer):
        rendering = session.image(state, request)
        weights = rng.uniform(0.5, 1.5, numbers(rendering.images).shape)
        slopes = np.zeros((2, 3))
        for index in np.ndindex(2, 3):
            values = []
            for amount in (0.02, -0.02):
                exposure = numbers(state[EXPOSURE])
                exposure[index] += amount
                images = numbers(session.image(state | {EXPOSURE: renderer.array(exposure)}, request).images)
                values.append((weights * images).sum() / len(images))
            slopes[index] = (values[0] - values[1]) / 0.04
        gradient = session.adjoint(state, rendering.paths, renderer.array(weights))
        assert list(gradient) == list(state)
        close = {"rtol": 2e-3, "atol": 2e-3 * np.abs(slopes).max()}
        np.testing.assert_allclose(numbers(gradient[EXPOSURE]), slopes, **close)
        assert not np.allclose(numbers(gradient[EXPOSURE]), 1.05 * slopes, **close)


def test_adjoints_of_a_pair_are_those_of_its_pictures() -> None:
    """ln 2 times the sum of weight times picture, by row and channel, less its mean over the rows."""
    make, keys = MAKE["linear"]
    renderer = make()
    session = renderer.prepare(list(keys), "path")
    current, previous = state_of(renderer, keys), state_of(renderer, keys, 1)
    for request in requests(renderer):
        pair = session.image_pair(current, previous, request, "path")
        weights = np.random.default_rng(4).uniform(0.5, 1.5, (2, *pair.images.shape))
        found = session.adjoint_pair(current, previous, pair.paths, *weights)
        rows = [1 - s for s in request.sensors] if request.sensors is not None else [1 - request.sensor]
        for gradient, weight, images in zip(found, weights, (pair.images, pair.previous), strict=True):
            parts = (weight * images).mean(0).reshape(-1, 3)
            expected = np.zeros((2, 3))
            np.add.at(expected, np.broadcast_to(np.array(rows, int), len(parts)), parts * np.log(2))
            np.testing.assert_allclose(gradient[EXPOSURE], expected - expected.mean(0), atol=1e-9)


def test_the_gradient_of_the_scene_passes_through_the_gains(made: tuple[ExposedRenderer, tuple[str, ...]]) -> None:
    renderer, keys = made
    session, plain = renderer.prepare(list(keys), None), renderer.inner.prepare([keys[0]], None)
    state = state_of(renderer, keys)
    scene = {keys[0]: state[keys[0]]}
    request = requests(renderer)[1]
    rendering = session.image(state, request)
    weights = np.random.default_rng(0).uniform(0.5, 1.5, numbers(rendering.images).shape)
    found = session.adjoint(state, rendering.paths, renderer.array(weights))[keys[0]]
    scaled = renderer.array(weights * gains(numbers(state[EXPOSURE]))[0])
    expected = plain.adjoint(scene, plain.image(scene, request).paths, scaled)[keys[0]]
    np.testing.assert_allclose(numbers(found), numbers(expected), rtol=1e-4, atol=1e-6)


def test_batches_and_tangents(made: tuple[ExposedRenderer, tuple[str, ...]]) -> None:
    renderer, keys = made
    session = renderer.prepare(list(keys), None)
    states = [state_of(renderer, keys, seed) for seed in range(3)]
    stacked = {key: np.stack([numbers(state[key]) for state in states]) for key in keys}
    request = requests(renderer, 1)[0]
    found = numbers(session.image_batch(stacked, request))
    expected = np.concatenate([numbers(session.image(state, request).images) for state in states])
    np.testing.assert_allclose(found, expected, rtol=1e-4)
    alone = renderer.prepare([EXPOSURE], None)
    assert numbers(alone.image_batch({EXPOSURE: stacked[EXPOSURE]}, request)).shape == found.shape
    # Of one sample a pixel, along an exposure: the square of the derivative.
    request = SampleRequest(0, 1, 3)
    rendering = session.image(states[0], request)
    still = {keys[0]: renderer.array(0 * numbers(states[0][keys[0]])), EXPOSURE: renderer.array(np.eye(2, 3))}
    moment = numbers(session.tangent_moment(states[0], rendering.paths, still))
    centred = np.eye(2, 3)[1] - np.eye(2, 3).mean(0)
    slope = numbers(rendering.images)[0] * np.log(2) * centred
    np.testing.assert_allclose(moment, slope**2, rtol=1e-3, atol=1e-7)


def drifting() -> tuple[ur.Problem, np.ndarray]:
    """Photographs whose exposures drift, of a map that is unknown."""
    rng = np.random.default_rng(3)
    inner = linear()
    truth = rng.normal(0, 0.4, (2, 3))
    truth -= truth.mean(0)
    session = inner.prepare([], None)
    views = []
    for sensor in range(2):
        exact = numbers(session.image({}, SampleRequest(sensor, 4096, 1)).images[0])
        views.append(ur.View(exact * 2.0 ** truth[sensor], sensor))
    parameters = [ur.Parameter("map", initial=0.3, bounds=(0.0, 1.0)), ur.Parameter(EXPOSURE)]
    return ur.Problem(inner, parameters, views, max_depth=1), truth


ESTIMATORS = {
    "groups": ur.PathGradient(spp=4),
    "control variates": ur.PathGradient(ur.images.RecursiveControlVariate(), spp=4),
    "mini-batches": ur.PathGradient(pixels=ur.pixels.Uniform(16), spp=4),
    "adaptive": ur.PathGradient(pixels=ur.pixels.Adaptive(16), spp=4),
    "coupled": ur.MetaEstimator(coupled=True, spp=4),
}


@pytest.mark.parametrize("name", quick(ESTIMATORS, "groups", "mini-batches"))
def test_the_gradient_of_the_loss_is_unbiased(name: str) -> None:
    """Of L2, against the exact gradient of the exact images, by z-scores of the mean over seeds."""
    problem, _ = drifting()
    point = problem.initial() | {EXPOSURE: np.array([[0.3, 0.0, -0.2], [0.0, 0.1, 0.2]])}

    def loss(exposure: np.ndarray) -> float:
        renderer = problem.renderer
        assert isinstance(renderer, ExposedRenderer)
        exact = renderer.inner.exact({"map": point["map"]})  # pyright: ignore
        return sum(float(problem.loss_value(v, exact * gains(exposure)[v])) for v in range(2))

    expected = np.zeros((2, 3))
    for index in np.ndindex(2, 3):
        step = np.zeros((2, 3))
        step[index] = 1e-4
        expected[index] = (loss(point[EXPOSURE] + step) - loss(point[EXPOSURE] - step)) / 2e-4
    estimator = ESTIMATORS[name]
    state = estimator.init(problem, point)
    found = np.array(
        [
            arrays.numpy(estimator.estimate(problem, point, state, Key(seed))[0].gradient[EXPOSURE])
            for seed in range(200)
        ]
    )
    error = found.std(0) / np.sqrt(len(found))
    assert (np.abs(found.mean(0) - expected) < 4 * error).all()
    assert not (np.abs(found.mean(0) - 1.2 * expected) < 4 * error).all()


def test_a_descent_finds_exposures_and_leaves_the_map_alone() -> None:
    problem, truth = drifting()
    result = ur.optimize(problem, ur.PathGradient(spp=16), ur.optimizers.Adam(0.05), steps=120)
    found = result.parameters[EXPOSURE]
    np.testing.assert_allclose(found - found.mean(0), truth, atol=0.05)
