"""One contract for every renderer: shapes, unbiasedness, pairs, adjoints, tangents, chosen pixels, several sensors, refusals, purity."""

from __future__ import annotations

import gc
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from backends import BACKENDS, LAMP, TEXTURE, Backend, problem, surface
from scipy import stats

import unrender as ur
from tests.analytic import AnalyticRenderer
from tiers import quick
from unrender.core import arrays
from unrender.core.errors import InputError
from unrender.core.random import Key
from unrender.core.trees import Tree
from unrender.rendering.mitsuba.renderer import MitsubaRenderer
from unrender.rendering.renderer import Renderer, RenderSession, SampleRequest, Space

DIFFERENTIABLE = [name for name, backend in BACKENDS.items() if backend.derivatives]


def without_media(names: Iterable[str]) -> list[Any]:
    """`names` for a test, that of media in the long tier: its kernels take longest to compile."""
    names = list(names)
    return quick(names, *(name for name in names if name != "medium"))


@pytest.fixture(autouse=True)
def no_scene_outlives_its_test() -> Iterator[None]:
    """See `no_scene_outlives_its_file`: with the scenes of other backends beside it, each has kernels of its own, and larger ones."""
    yield
    gc.collect()


@pytest.fixture(autouse=True, scope="module")
def renderers_go() -> Iterator[None]:
    """See `no_scene_outlives_its_file`."""
    yield
    Backend.renderer.cache_clear()


SPACES: tuple[Space, ...] = ("path", "primary")
SPP = 64
"""Of most requests: kernels are compiled for it."""


# ---------------------------------------------------------------------------------------------------- helpers


def numbers(x: Any) -> np.ndarray:
    return np.array(arrays.numpy(x)).astype(np.float64)


def session_of(backend: Backend, renderer: Renderer, space: Space | None = None) -> RenderSession:
    return renderer.prepare(list(backend.keys), space, derivatives=backend.derivatives)


def changed(backend: Backend, renderer: Renderer, seed: int = 0) -> tuple[Tree, Tree]:
    """Two states of the parameters, a step apart in a random direction."""
    rng = np.random.default_rng(seed)
    current = renderer.values(list(backend.keys))
    previous = {}
    for key, value in current.items():
        size = np.maximum(np.abs(numbers(value)), 0.1)
        previous[key] = renderer.array(numbers(value) - backend.step * size * rng.uniform(0.5, 1.0, size.shape))
    return current, previous


def weights_of(renderer: Renderer, shape: tuple[int, ...], seed: int = 3) -> Any:
    return renderer.array(np.random.default_rng(seed).uniform(0.5, 1.5, shape))


def inner(a: Tree, b: Tree) -> float:
    return sum(float((numbers(a[key]) * numbers(b[key])).sum()) for key in b)


def estimates(session: RenderSession, state: Tree, spp: int, seeds: range) -> np.ndarray:
    """A few weighted sums of each of some images: (images, sums)."""
    weight: Any = None
    found = []
    for seed in seeds:
        image = numbers(session.image(state, SampleRequest(0, spp, seed)).images[0])
        if weight is None:
            weight = np.random.default_rng(5).uniform(0, 1, (4, *image.shape))
        found.append((weight * image).reshape(4, -1).sum(axis=1))
    return np.array(found)


def agree(a: np.ndarray, b: np.ndarray, scale: float = 1.0) -> bool:
    """Whether the means of two sets of runs (runs, values), one of them times `scale`, differ by noise only, after Šidák."""
    error = np.sqrt(a.var(0, ddof=1) / len(a) + b.var(0, ddof=1) / len(b))
    limit = stats.t.isf((1 - (1 - 1e-3) ** (1 / a.shape[1])) / 2, min(len(a), len(b)) - 1)
    rounding = 1e-5 * np.abs(b.mean(0))
    return bool((np.abs(scale * a.mean(0) - b.mean(0)) <= limit * error + rounding).all())


# ---------------------------------------------------------------------------------------------------- images


@pytest.mark.parametrize("name", without_media(BACKENDS))
def test_shapes_are_those_that_the_renderer_tells(name: str) -> None:
    backend = BACKENDS[name]
    renderer = backend.renderer()
    session = session_of(backend, renderer)
    height, width = renderer.resolutions()[0]
    values = renderer.values(list(backend.keys))
    for key, value in values.items():
        assert arrays.shape(value) == renderer.parameters()[key].shape
    groups = 2 if name != "poses" else 1
    rendering = session.image(values, SampleRequest(0, SPP, 1, groups))
    assert arrays.shape(rendering.images) == (groups, height, width, 3)
    assert rendering.previous is None
    stacked = {key: np.repeat(numbers(value)[None], 3, axis=0) for key, value in values.items()}
    batch = session.image_batch(stacked, SampleRequest(0, SPP, 1))
    assert arrays.shape(batch) == (3, height, width, 3)
    one = numbers(session.image(values, SampleRequest(0, SPP, 1)).images[0])
    for image in numbers(batch):
        np.testing.assert_allclose(image, one, rtol=1e-5, atol=1e-6)
    if not backend.derivatives:
        return
    current, previous = changed(backend, renderer)
    for space in SPACES:
        pair = session_of(backend, renderer, space).image_pair(current, previous, SampleRequest(0, SPP, 1, 2), space)
        assert arrays.shape(pair.images) == arrays.shape(pair.previous) == (2, height, width, 3)
    weights = weights_of(renderer, (2, height, width, 3))
    gradient = session.adjoint(values, rendering.paths, weights)
    assert {key: arrays.shape(value) for key, value in gradient.items()} == {
        key: arrays.shape(value) for key, value in values.items()
    }
    alone = session.image(values, SampleRequest(0, SPP, 1))
    assert arrays.shape(session.tangent_moment(values, alone.paths, values)) == (height, width, 3)


@pytest.mark.parametrize("name", quick(BACKENDS, *(name for name in BACKENDS if name not in ("medium", "poses"))))
def test_images_of_few_samples_have_the_mean_of_those_of_many(name: str) -> None:
    backend = BACKENDS[name]
    session, state = session_of(backend, backend.renderer()), changed(backend, backend.renderer())[1]
    few, many = estimates(session, state, SPP, range(32)), estimates(session, state, 1024, range(100, 112))
    assert agree(few, many)
    assert not agree(few, many, scale=1.2), "too noisy to see a fifth"


@pytest.mark.parametrize("name", quick(DIFFERENTIABLE, "surface"))
def test_a_pair_is_two_images(name: str) -> None:
    """From the same random numbers, to the bit; on the same paths, in the mean; and of equal states equal images."""
    backend = BACKENDS[name]
    renderer = backend.renderer()
    current, previous = changed(backend, renderer)
    session = session_of(backend, renderer, "primary")
    request = SampleRequest(0, SPP, 4, 2)
    pair = session.image_pair(current, previous, request, "primary")
    assert np.array_equal(numbers(pair.images), numbers(session.image(current, request).images))
    # The previous scene's kernel may round otherwise.
    alone = numbers(session.image(previous, request).images)
    np.testing.assert_allclose(numbers(pair.previous), alone, rtol=1e-4, atol=1e-5)
    assert not np.array_equal(numbers(pair.images), numbers(pair.previous))

    session = session_of(backend, renderer, "path")
    same = session.image_pair(current, current, request, "path")
    np.testing.assert_allclose(numbers(same.images), numbers(same.previous), rtol=1e-5, atol=1e-6)
    weight = np.random.default_rng(5).uniform(0, 1, (4, *numbers(pair.images).shape[1:]))
    found = []
    for seed in range(32):
        both = session.image_pair(current, previous, SampleRequest(0, SPP, 500 + seed), "path")
        assert both.previous is not None
        images = [numbers(both.images[0]), numbers(both.previous[0])]
        found.append([(weight * image).reshape(4, -1).sum(axis=1) for image in images])
    for index, state in enumerate((current, previous)):
        assert agree(np.array(found)[:, index], estimates(session, state, SPP, range(100, 132)))


# ---------------------------------------------------------------------------------------------------- derivatives


def adjoint_error(backend: Backend, renderer: Renderer) -> tuple[float, float]:
    """How far the adjoint's derivative along a direction is from a finite difference, relative to it, and the standard error of that."""
    session, path = session_of(backend, renderer), session_of(backend, renderer, "path")
    current, previous = changed(backend, renderer)
    direction = {key: numbers(current[key]) - numbers(previous[key]) for key in current}
    half = 0.25 if backend.same_paths else 1.0
    ends = [
        {key: renderer.array(numbers(current[key]) + s * half * direction[key]) for key in current} for s in (1, -1)
    ]
    height, width = renderer.resolutions()[0]
    weights = weights_of(renderer, (1, height, width, 3))
    found, expected = [], []
    for seed in range(4 if backend.same_paths else 128):
        request = SampleRequest(0, SPP, seed)
        gradient = session.adjoint(current, session.image(current, request).paths, weights)
        found.append(inner(gradient, {key: renderer.array(x) for key, x in direction.items()}))
        if backend.same_paths:
            images = [numbers(session.image(end, request).images) for end in ends]
        else:
            pair = path.image_pair(ends[0], ends[1], SampleRequest(0, SPP, 1000 + seed), "path")
            images = [numbers(pair.images), numbers(pair.previous)]
        expected.append(float((numbers(weights) * (images[0] - images[1])).sum()) / (2 * half))
    a, b = np.array(found), np.array(expected)
    noise = np.std(a - b, ddof=1) if backend.same_paths else np.sqrt(a.var(ddof=1) + b.var(ddof=1))
    return float(abs(a.mean() - b.mean()) / abs(b.mean())), float(noise / np.sqrt(len(a)) / abs(b.mean()))


def check_adjoint(backend: Backend, renderer: Renderer) -> None:
    """Raise `AssertionError` where the adjoint is not the derivative of the image."""
    error, noise = adjoint_error(backend, renderer)
    assert noise < 0.012, "too noisy to see a twentieth"
    assert error < 0.005 + 3.5 * noise, (error, noise)


@pytest.mark.parametrize("name", without_media(DIFFERENTIABLE))
def test_the_adjoint_is_the_derivative_of_the_image(name: str) -> None:
    check_adjoint(BACKENDS[name], BACKENDS[name].renderer())


class WrongAdjoint:
    """A renderer whose adjoints are 5 % too large."""

    def __init__(self, renderer: Renderer):
        self._renderer = renderer

    def __getattr__(self, name: str) -> Any:
        return getattr(self._renderer, name)

    def prepare(self, keys: list[str], space: Space | None, derivatives: bool = True) -> WrongSession:
        return WrongSession(self._renderer.prepare(keys, space, derivatives))


class WrongSession:
    def __init__(self, session: RenderSession):
        self._session = session

    def __getattr__(self, name: str) -> Any:
        return getattr(self._session, name)

    def adjoint(self, parameters: Tree, paths: Any, weights: Any) -> Tree:
        return {key: value * 1.05 for key, value in self._session.adjoint(parameters, paths, weights).items()}


@pytest.mark.parametrize("name", without_media(DIFFERENTIABLE))
def test_an_adjoint_that_is_a_twentieth_wrong_is_caught(name: str) -> None:
    backend = BACKENDS[name]
    with pytest.raises(AssertionError):
        check_adjoint(backend, WrongAdjoint(backend.renderer()))  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize("name", without_media(DIFFERENTIABLE))
@pytest.mark.parametrize("space", SPACES)
def test_the_adjoints_of_a_pair_are_those_of_its_states(name: str, space: Space) -> None:
    backend = BACKENDS[name]
    renderer = backend.renderer()
    session = session_of(backend, renderer, space)
    current, previous = changed(backend, renderer)
    height, width = renderer.resolutions()[0]
    weights, others = (weights_of(renderer, (2, height, width, 3), seed) for seed in (3, 4))
    nothing = renderer.array(np.zeros((2, height, width, 3)))
    request = SampleRequest(0, SPP, 8, 2)
    pair = session.image_pair(current, previous, request, space)
    both = session.adjoint_pair(current, previous, pair.paths, weights, others)

    def same(a: Tree, b: Tree) -> None:
        for key in b:
            scale = np.abs(numbers(b[key])).max()
            assert scale > 0
            np.testing.assert_allclose(numbers(a[key]) / scale, numbers(b[key]) / scale, rtol=2e-3, atol=1e-4)

    same(both[0], session.adjoint(current, pair.paths, weights))
    # Each state's gradient is of its own images' weights alone.
    same(both[0], session.adjoint_pair(current, previous, pair.paths, weights, nothing)[0])
    same(both[1], session.adjoint_pair(current, previous, pair.paths, nothing, others)[1])
    if space == "primary":
        same(both[1], session.adjoint(previous, session.image(previous, request).paths, others))
    equal = session.image_pair(current, current, request, space)
    same(*session.adjoint_pair(current, current, equal.paths, weights, weights))


@pytest.mark.parametrize("name", without_media(DIFFERENTIABLE))
def test_tangent_moments_are_squares_of_the_derivatives_of_single_paths(name: str) -> None:
    """For one sample per pixel: by single parameters, and along all at once."""
    backend = BACKENDS[name]
    renderer = backend.renderer()
    session, current = session_of(backend, renderer), renderer.values(list(backend.keys))
    height, width = renderer.resolutions()[0]
    paths = session.image(current, SampleRequest(0, 1, 7)).paths
    rng = np.random.default_rng(0)
    # Where there is a derivative, and a few more.
    every = {key: renderer.array(np.abs(numbers(x)) + 0.1) for key, x in current.items()}
    moment = numbers(session.tangent_moment(current, paths, every))
    brightest = np.argsort(moment[..., 0].ravel())[::-1][:3]
    places = [(int(i) // width, int(i) % width, 0) for i in {*brightest.tolist(), 0}]
    assert moment[places[0]] > 0 or moment.max() > 0
    derivatives = []
    for place in places:
        weights = np.zeros((1, height, width, 3))
        weights[0][place] = 1.0
        derivatives.append(session.adjoint(current, paths, renderer.array(weights)))
    all_at_once = {key: rng.normal(size=arrays.shape(x)) for key, x in current.items()}
    flat = [(key, index) for key, x in current.items() for index in np.ndindex(arrays.shape(x))]
    tangents = [all_at_once]
    # The single parameters that matter most to the brightest of these pixels.
    best = max(range(len(places)), key=lambda n: moment[places[n]])
    flat.sort(key=lambda part: -abs(float(numbers(derivatives[best][part[0]])[part[1]])))
    for key, index in flat[:2]:
        unit = {name: np.zeros(arrays.shape(x)) for name, x in current.items()}
        unit[key][index] = 1.0
        tangents.append(unit)
    for tangent in tangents:
        given = {key: renderer.array(x) for key, x in tangent.items()}
        found = numbers(session.tangent_moment(current, paths, given))
        expected = [inner(gradient, given) ** 2 for gradient in derivatives]
        np.testing.assert_allclose(
            [found[place] for place in places], expected, rtol=5e-3, atol=1e-5 * max(expected) + 1e-12
        )
        assert max(expected) > 0


# ---------------------------------------------------------------------------------------------------- pixels and sensors


@pytest.mark.parametrize("name", quick([name for name in BACKENDS if name != "poses"], "surface"))
def test_chosen_pixels_are_those_of_the_whole_film(name: str) -> None:
    backend = BACKENDS[name]
    renderer = backend.renderer()
    session, state = session_of(backend, renderer), changed(backend, renderer)[0]
    height, width = renderer.resolutions()[0]
    every = arrays.arange(renderer.array(np.zeros(1)), height * width)
    whole = numbers(session.image(state, SampleRequest(0, SPP, 3, 2)).images).reshape(2, -1, 3)
    chosen = numbers(session.image(state, SampleRequest(0, SPP, 3, 2, every)).images)
    np.testing.assert_allclose(chosen, whole, rtol=1e-5, atol=1e-6)
    backwards = every[::-1] if isinstance(every, np.ndarray) else (height * width - 1) - every
    some = [
        numbers(session.image(state, SampleRequest(0, SPP, seed, 1, backwards)).images[0])[::-1] for seed in range(24)
    ]
    film = [
        numbers(session.image(state, SampleRequest(0, SPP, 100 + seed)).images[0]).reshape(-1, 3) for seed in range(24)
    ]
    weight = np.random.default_rng(5).uniform(0, 1, (4, height * width, 1))
    a, b = (np.array([(weight * image).reshape(4, -1).sum(1) for image in images]) for images in (some, film))
    assert agree(a, b)
    weights = np.random.default_rng(1).uniform(0.5, 1.5, (1, height, width, 3))
    request = SampleRequest(0, SPP, 6)
    expected = session.adjoint(state, session.image(state, request).paths, renderer.array(weights))
    paths = session.image(state, replace(request, pixels=every)).paths
    found = session.adjoint(state, paths, renderer.array(weights.reshape(1, -1, 3)))
    for key in expected:
        scale = np.abs(numbers(expected[key])).max()
        np.testing.assert_allclose(numbers(found[key]) / scale, numbers(expected[key]) / scale, rtol=1e-3, atol=1e-5)


def test_each_sensor_sees_its_own_picture() -> None:
    """Alone, or with a sensor for each pixel."""
    backend = BACKENDS["surface"]
    renderer = backend.renderer()
    session, state = session_of(backend, renderer), renderer.values(list(backend.keys))
    height, width = renderer.resolutions()[1]
    one, two = (numbers(session.image(state, SampleRequest(n, SPP, 3)).images).reshape(-1, 3) for n in (0, 1))
    assert np.abs(one - two).mean() > 0.1 * one.mean()
    every = arrays.arange(renderer.array(np.zeros(1)), height * width)
    for sensor, expected in ((0, one), (1, two)):
        sensors = every * 0 + sensor
        found = session.image(state, SampleRequest(0, SPP, 3, 1, every, sensors)).images[0]
        np.testing.assert_allclose(numbers(found), expected, rtol=1e-3, atol=1e-4)


# ---------------------------------------------------------------------------------------------------- refusals


@pytest.mark.parametrize("name", BACKENDS)
def test_a_parameter_that_is_unknown_is_refused_in_one_line(name: str) -> None:
    with pytest.raises(InputError, match="nothing_of_that_name") as caught:
        BACKENDS[name].renderer().prepare(["nothing_of_that_name"], None)
    assert "\n" not in str(caught.value)


def test_what_cannot_share_paths_is_refused_there() -> None:
    renderer = AnalyticRenderer({"x": np.ones(1)}, np.ones((48, 1)), shares_paths=False)
    with pytest.raises(InputError, match='use space="primary"'):
        renderer.prepare(["x"], "path")
    poses = BACKENDS["poses"]
    with pytest.raises(InputError, match="path gradients"):
        poses.renderer().prepare(list(poses.keys), None)


def test_a_parameter_that_a_session_was_not_prepared_for_is_refused() -> None:
    renderer = BACKENDS["surface"].renderer()
    session = renderer.prepare([TEXTURE], "path")
    with pytest.raises(InputError, match=f"{LAMP}: the renderer was not prepared for it"):
        session.image(renderer.values([TEXTURE, LAMP]), SampleRequest(0, 1, 1))


# ---------------------------------------------------------------------------------------------------- purity


def everything(backend: Backend, renderer: Renderer, disturb: Callable[[], None] = lambda: None) -> list[np.ndarray]:
    """What every method answers, with `disturb` called between a rendering and what is made of it."""
    session = session_of(backend, renderer)
    current, previous = changed(backend, renderer)
    height, width = renderer.resolutions()[0]
    stacked = {key: np.stack([numbers(current[key]), numbers(previous[key])]) for key in current}
    request = SampleRequest(0, SPP, 1)
    rendering = session.image(current, request)
    disturb()
    found: list[Any] = [rendering.images, session.image_batch(stacked, request)]
    if backend.derivatives:
        weights = weights_of(renderer, (1, height, width, 3))
        disturb()
        found.extend(session.adjoint(current, rendering.paths, weights).values())
        for space in SPACES:
            pair = session.image_pair(current, previous, request, space)
            disturb()
            found.extend([pair.images, pair.previous])
            for gradient in session.adjoint_pair(current, previous, pair.paths, weights, weights):
                found.extend(gradient.values())
        disturb()
        found.append(session.tangent_moment(current, rendering.paths, current))
        disturb()
        found.extend(session.adjoint(current, rendering.paths, weights).values())
    disturb()
    found.append(session.image(current, request).images)
    return [numbers(x) for x in found]


def disturbance(backend: Backend, renderer: Renderer) -> Any:
    """Calls of other sessions on the same renderer: of other parameters, and of the same without derivatives, elsewhere."""
    plain = renderer.prepare(list(backend.keys), None, derivatives=False)
    elsewhere = {key: renderer.array(numbers(x) * 0.7) for key, x in renderer.values(list(backend.keys)).items()}
    other = renderer.prepare(list(backend.others), "primary") if backend.others else None
    values = {key: renderer.array(numbers(x) * 0.8) for key, x in renderer.values(list(backend.others)).items()}

    def disturb() -> None:
        plain.image(elsewhere, SampleRequest(0, SPP, 77))
        if other is None:
            return
        pair = other.image_pair(values, renderer.values(list(backend.others)), SampleRequest(0, SPP, 5), "primary")
        other.adjoint(values, pair.paths, pair.images)

    return disturb


@pytest.mark.cpu("atomic additions of a GPU have no order")
@pytest.mark.usefixtures("one_thread")
@pytest.mark.parametrize("name", quick(BACKENDS, *(name for name in BACKENDS if name not in ("medium", "poses"))))
def test_equal_arguments_give_equal_results_whatever_other_sessions_do(name: str) -> None:
    """To the bit, against the same calls with nothing between them; and the scene keeps its own values."""
    backend = BACKENDS[name]
    renderer = backend.renderer()
    expected = everything(backend, renderer)
    own = {key: numbers(x) for key, x in renderer.values([*backend.keys, *backend.others]).items()}
    found = everything(backend, renderer, disturbance(backend, renderer))
    assert len(found) == len(expected)
    for index, (a, b) in enumerate(zip(found, expected, strict=True)):
        np.testing.assert_array_equal(a, b, err_msg=f"result {index}")
    for key, value in renderer.values([*backend.keys, *backend.others]).items():
        np.testing.assert_array_equal(numbers(value), own[key])


@pytest.mark.usefixtures("one_thread")
def test_sessions_of_poses_leave_the_scene_as_it_was() -> None:
    """Shapes, emitters and sensors are in the scenes that they make, too."""
    renderer = MitsubaRenderer(surface, 3)
    values, request = renderer.values([TEXTURE]), SampleRequest(0, SPP, 1)
    before = numbers(renderer.prepare([TEXTURE], None).image(values, request).images)
    poses = [renderer.prepare([key], None, derivatives=False) for key in ("ball.translation", "sensor.rotation")]
    images = [
        numbers(session.image(renderer.values([key]), request).images)
        for session, key in zip(poses, ("ball.translation", "sensor.rotation"), strict=True)
    ]
    np.testing.assert_array_equal(numbers(renderer.prepare([TEXTURE], None).image(values, request).images), before)
    alone = MitsubaRenderer(surface, 3)
    session = alone.prepare(["sensor.rotation"], None, derivatives=False)
    again = session.image(alone.values(["sensor.rotation"]), request).images
    np.testing.assert_array_equal(numbers(again), images[1])


@pytest.mark.parametrize("name", without_media(BACKENDS))
def test_arguments_are_not_changed(name: str) -> None:
    backend = BACKENDS[name]
    renderer = backend.renderer()
    session, (current, previous) = session_of(backend, renderer), changed(backend, renderer)
    before = {key: numbers(x).copy() for key, x in current.items()}, {k: numbers(x).copy() for k, x in previous.items()}
    height, width = renderer.resolutions()[0]
    weights = weights_of(renderer, (1, height, width, 3))
    given = numbers(weights).copy()
    rendering = session.image(current, SampleRequest(0, SPP, 1))
    if backend.derivatives:
        session.adjoint(current, rendering.paths, weights)
        pair = session_of(backend, renderer, "path").image_pair(current, previous, SampleRequest(0, SPP, 1), "path")
        session.adjoint_pair(current, previous, pair.paths, weights, weights)
        session.tangent_moment(current, rendering.paths, previous)
    for tree, values in zip((current, previous), before, strict=True):
        assert list(tree) == list(values)
        for key in tree:
            np.testing.assert_array_equal(numbers(tree[key]), values[key])
    np.testing.assert_array_equal(numbers(weights), given)


# ---------------------------------------------------------------------------------------------------- purity of runs

CV = ur.images.RecursiveControlVariate
METHODS = {
    "plain": lambda: ur.PathGradient(spp=2),
    "control variate": lambda: ur.PathGradient(CV(), spp=2),
    "coupled": lambda: ur.MetaEstimator(coupled=True, spp=2),
}


class Renders(ur.protocols.Callback):
    """Looks at the run's images at every step, in every way there is."""

    def __init__(self) -> None:
        self.images: list[np.ndarray] = []

    def on_step(self, run: Any, record: dict[str, Any]) -> None:
        parameters = {key: arrays.numpy(x) for key, x in run.parameters.items()}
        self.images.append(ur.render(run.problem, parameters, spp=2))
        self.images.append(ur.render(run.problem, spp=2, seed=5))
        self.images.extend(ur.render_pair(run.problem, parameters, parameters, 2, 1))


def optimised(method: str, callbacks: tuple[ur.protocols.Callback, ...] = ()) -> ur.Result:
    estimator = METHODS[method]()
    optimizer = ur.optimizers.MetaAdam() if isinstance(estimator, ur.MetaEstimator) else ur.optimizers.Adam()
    return ur.optimize(problem(), estimator, optimizer, steps=4, seed=3, callbacks=callbacks)


@pytest.fixture(scope="module")
def undisturbed(mitsuba_variant: str) -> Iterator[Callable[[str], ur.Result]]:
    """Runs of problems of their own, each once for all tests; they have one thread, as the tests have."""
    del mitsuba_variant
    found = cache(optimised)
    yield found
    found.cache_clear()


@pytest.mark.usefixtures("one_thread")
@pytest.mark.parametrize("method", quick(METHODS, "control variate"))
def test_a_callback_that_renders_changes_nothing(method: str, undisturbed: Callable[[str], ur.Result]) -> None:
    seen = Renders()
    disturbed, expected = optimised(method, (seen,)), undisturbed(method)
    for key, value in expected.parameters.items():
        np.testing.assert_array_equal(disturbed.parameters[key], value)
    assert [line["loss"] for line in disturbed.history] == [line["loss"] for line in expected.history]
    assert len(seen.images) == 16
    np.testing.assert_array_equal(seen.images[1], seen.images[5])


@pytest.mark.slow
@pytest.mark.usefixtures("one_thread")
def test_two_estimators_take_turns_on_one_problem_as_if_they_were_alone() -> None:
    """Path gradients with derivatives of both parameters, smoothing without; the second begins after the first has begun."""
    estimators = [*(METHODS[name]() for name in METHODS), ur.SmoothedDerivatives(0.02, samples=8, spp=1)]

    def steps(numbers_of: list[int]) -> dict[int, list[np.ndarray]]:
        asked = problem((LAMP,))
        points = [asked.initial(), {LAMP: asked.initial()[LAMP] * 0.9}, {LAMP: asked.initial()[LAMP] * 0.8}]
        states = {n: estimators[n].init(asked, points[0]) for n in numbers_of}
        found: dict[int, list[np.ndarray]] = {n: [] for n in numbers_of}
        for step, point in enumerate(points):
            for n in numbers_of:
                estimate, states[n] = estimators[n].estimate(asked, point, states[n], Key(1, step))
                found[n].append(numbers(estimate.gradient[LAMP]))
        return found

    together = steps(list(range(len(estimators))))
    for n in range(len(estimators)):
        for a, b in zip(together[n], steps([n])[n], strict=True):
            np.testing.assert_array_equal(a, b)


@pytest.mark.usefixtures("one_thread")
def test_two_runs_on_one_problem_are_those_of_two_problems(undisturbed: Callable[[str], ur.Result]) -> None:
    shared = problem()
    for method in ("plain", "control variate", "plain"):
        found = ur.optimize(shared, METHODS[method](), ur.optimizers.Adam(), steps=4, seed=3)
        for key, value in undisturbed(method).parameters.items():
            np.testing.assert_array_equal(found.parameters[key], value)
