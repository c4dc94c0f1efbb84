"""Responses of photographs, on a renderer of known integrals: the curve, exact derivatives, bias, what is refused, recovery."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from test_photographs_parameters import check_adjoint, requests

import unrender as ur
from tests.analytic import AnalyticRenderer
from tiers import slow
from unrender.app.capture import pictures, unknowns
from unrender.core.errors import InputError
from unrender.rendering.photographs import OF_PHOTOGRAPHS, scene_values, with_photographs
from unrender.rendering.renderer import SampleRequest
from unrender.rendering.response import RESPONSE, RESPONSE_BOUND, RespondingRenderer, curve

GIVEN = np.array([[0.3, -0.4], [-0.2, 0.5], [0.1, 0.2]])
X = np.concatenate([[-0.1, 0.0, 2.0**-10], np.linspace(1e-4, 2.0**-9, 7), np.linspace(0.01, 1.6, 40)])


def scene(noise: float = 0.3) -> AnalyticRenderer:
    """Five sensors, whose pictures are linear in four texels, from 0.1 to about 1."""
    rng = np.random.default_rng(0)
    texels = rng.uniform(0.3, 0.9, (2, 2, 1))
    return AnalyticRenderer({"map": texels}, rng.uniform(0, 0.35, (36, 4)), 0.1, noise, shape=(3, 4), sensors=5)


def values(response: np.ndarray, x: np.ndarray) -> np.ndarray:
    """(N, 3), of x (N, 3) or (N, 1)."""
    return curve(response[:, 0], response[:, 1], x).values


def test_curves_begin_at_black_end_at_white_and_rise() -> None:
    x = np.sort(X)[:, None]
    for scale in (0.0, 1.0, RESPONSE_BOUND / 0.5):
        given = np.clip(scale * GIVEN, -RESPONSE_BOUND, RESPONSE_BOUND)
        found = values(given, x)
        np.testing.assert_allclose(values(given, np.array([[0.0], [1.0]])), [[0] * 3, [1] * 3], atol=1e-12)
        assert (np.diff(found, axis=0) > 0).all()
    np.testing.assert_allclose(values(0 * GIVEN, x), np.broadcast_to(x, (len(x), 3)), rtol=1e-12, atol=1e-15)


def test_curves_are_a_power_after_a_moebius_transformation() -> None:
    x = np.linspace(0.01, 1, 30)[:, None]
    a, b = GIVEN.T
    np.testing.assert_allclose(values(np.stack([a, -1.6 * a], 1), x), x ** np.exp(a), rtol=1e-12)
    np.testing.assert_allclose(values(GIVEN * [0, 1], x), np.exp(b) * x / (1 - x + np.exp(b) * x), rtol=1e-12)


def test_derivatives_are_those_of_finite_differences() -> None:
    x = X[(np.abs(X - 2.0**-10) > 1e-5) & (np.abs(X - 1) > 1e-4)][:, None] + np.zeros(3)  # but for the two kinks
    at = curve(GIVEN[:, 0], GIVEN[:, 1], x)
    h = 1e-6
    for found, one, two in (
        (at.slopes, values(GIVEN, x + h), values(GIVEN, x - h)),
        (at.by_contrast, values(GIVEN + [h, 0], x), values(GIVEN - [h, 0], x)),
        (at.by_brightness, values(GIVEN + [0, h], x), values(GIVEN - [0, h], x)),
    ):
        np.testing.assert_allclose(found, (one - two) / (2 * h), rtol=1e-5, atol=1e-7)


def test_pictures_and_adjoints_are_the_curves() -> None:
    renderer = RespondingRenderer(scene())
    state = {"map": renderer.values(["map"])["map"], RESPONSE: GIVEN}
    np.testing.assert_array_equal(renderer.values([RESPONSE])[RESPONSE], np.zeros((3, 2)))
    session, plain = renderer.prepare(list(state), None), renderer.inner.prepare(["map"], None)
    for request in requests():
        shown = plain.image({"map": state["map"]}, request).images
        np.testing.assert_allclose(session.image(state, request).images, values(GIVEN, shown), rtol=1e-9)
    check_adjoint(renderer, state, RESPONSE, 1e-5)
    check_adjoint(renderer, state, "map", 1e-5)
    stacked = {key: np.stack([value, 0.9 * value]) for key, value in state.items()}
    again = session.image_batch(stacked, SampleRequest(1, 4, 6))
    np.testing.assert_allclose(again[:1], session.image(state, SampleRequest(1, 4, 6)).images, rtol=1e-5)
    alone = renderer.prepare([RESPONSE], None).image_batch({RESPONSE: np.stack([GIVEN, 0 * GIVEN])}, requests()[3])
    assert alone.shape[-1] == 3


def test_adjoints_of_a_pair_are_those_of_its_pictures() -> None:
    renderer = RespondingRenderer(scene())
    first = {"map": renderer.values(["map"])["map"], RESPONSE: GIVEN}
    second = {"map": 0.8 * first["map"], RESPONSE: -0.5 * GIVEN}
    session = renderer.prepare(list(first), "path")
    request = requests()[0]
    pair = session.image_pair(first, second, request, "path")
    assert pair.previous is not None
    rng = np.random.default_rng(3)
    weights = [rng.uniform(0.5, 1.5, pair.images.shape) for _ in range(2)]
    found = session.adjoint_pair(first, second, pair.paths, *weights)
    for state, images, gradient, weight in zip(
        (first, second), (pair.images, pair.previous), found, weights, strict=True
    ):
        single = session.image(state, request)
        np.testing.assert_allclose(images, single.images)
        expected = session.adjoint(state, single.paths, weight)
        for key in state:
            np.testing.assert_allclose(gradient[key], expected[key], rtol=1e-9)


def test_tangent_moments_are_exact_for_one_sample() -> None:
    renderer = RespondingRenderer(scene())
    state = {RESPONSE: GIVEN}
    session = renderer.prepare([RESPONSE], None)
    request = SampleRequest(1, 1, 6)
    rendering = session.image(state, request)
    tangent = np.array([[1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    ahead, behind = (session.image({RESPONSE: GIVEN + h * tangent}, request).images for h in (1e-5, -1e-5))
    found = session.tangent_moment(state, rendering.paths, {RESPONSE: tangent})
    np.testing.assert_allclose(found, (((ahead - behind) / 2e-5) ** 2)[0], rtol=1e-4, atol=1e-12)


def test_pictures_are_biased_by_half_the_curvature_times_the_variance() -> None:
    """To second order; within four standard errors of a tenth of it, and not without it."""
    renderer = RespondingRenderer(scene())
    state = {"map": renderer.values(["map"])["map"], RESPONSE: GIVEN}
    session, plain = renderer.prepare(list(state), None), renderer.inner.prepare(["map"], None)
    request = SampleRequest(1, 1 << 14, 5, 1 << 12)
    radiance = np.asarray(plain.image({"map": state["map"]}, request).images)
    shown = np.asarray(session.image(state, request).images)
    mean = radiance.mean(0)
    h = 1e-3
    bend = (values(GIVEN, mean + h) - 2 * values(GIVEN, mean) + values(GIVEN, mean - h)) / h**2
    bias = shown.mean(0) - values(GIVEN, mean)
    expected = bend / 2 * radiance.var(0)
    error = 4 * shown.std(0) / np.sqrt(len(shown))
    inside = mean < 0.8
    assert np.abs(bias - expected)[inside].max() < np.abs(expected).max() / 10 + error.max()
    assert np.abs(bias).max() > 3 * np.abs(bias - expected)[inside].max()


def test_with_unknown_exposures_it_is_refused() -> None:
    views = [ur.View(np.full((3, 4, 3), 0.5), sensor) for sensor in range(5)]
    with pytest.raises(InputError, match="undetermined up to a power") as raised:
        ur.Problem(scene(), [ur.Parameter(key) for key in ("map", "exposure", RESPONSE)], views, max_depth=1)
    assert "\n" not in str(raised.value)
    renderer = with_photographs(scene(), ["map", RESPONSE, "vignetting"], range(5))
    assert isinstance(renderer, RespondingRenderer)
    assert with_photographs(renderer, ["map", RESPONSE], [1]) is renderer
    assert RESPONSE in OF_PHOTOGRAPHS
    assert not scene_values(renderer, {RESPONSE: GIVEN})


@pytest.mark.parametrize("fault", [False, slow(True)])
def test_a_response_is_recovered_beside_what_the_scene_holds(fault: bool) -> None:
    """From pictures of several radiances, to 2 % of radiance; not where another curve, an offset, was planted."""
    rng = np.random.default_rng(4)
    truth = rng.uniform(0.05, 0.9, (2, 2, 1))
    renderer = RespondingRenderer(scene(0.0))
    session = renderer.prepare(["map", RESPONSE], None)
    views = []
    for sensor in range(5):
        picture = session.image({"map": truth, RESPONSE: GIVEN}, SampleRequest(sensor, 256, sensor)).images[0]
        views.append(ur.View(picture + 0.1 * fault, sensor))
    parameters = [ur.Parameter("map", initial=np.full((2, 2, 1), 0.5), bounds=(0, 1)), ur.Parameter(RESPONSE)]
    problem = ur.Problem(scene(), parameters, views, max_depth=1)
    result = ur.optimize(problem, ur.PathGradient(spp=64), ur.optimizers.Adam(0.02), steps=400)
    x = np.linspace(0.05, 1, 50)[:, None]
    error = np.abs(values(result.parameters[RESPONSE], x) - values(GIVEN, x)).max()
    print("error", error, result.parameters[RESPONSE])
    assert (error < 0.02) is not fault


def test_files_are_decoded_by_the_response_that_is_named(tmp_path: Path) -> None:
    levels = np.arange(256, dtype=np.uint8).reshape(16, 16)
    Image.fromarray(np.repeat(levels[..., None], 3, 2)).save(tmp_path / "a.png")
    share = levels / 255
    expected = {
        "srgb": np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4),
        "linear": share,
        "2.2": share**2.2,
    }
    expected["fit"] = expected["srgb"]
    for response, values_ in expected.items():
        assert pictures.check_response(response) == response
        found = pictures.read(tmp_path / "a.png", response=response).values[..., 1]
        np.testing.assert_allclose(found, values_, atol=1e-6)
    np.testing.assert_array_equal(
        pictures.read(tmp_path / "a.png").values, pictures.read(tmp_path / "a.png", response="srgb").values
    )


@pytest.mark.mitsuba
@pytest.mark.parametrize("given", ["", "gamma", "0.5", "5", "nan", "-2.2", "inf", "sRGB\n"])
def test_other_responses_are_one_line(given: str) -> None:
    with pytest.raises(InputError, match="--response") as raised:
        ur.app.ImportOptions(response=given)
    assert "\n" not in str(raised.value)


@pytest.mark.mitsuba
def test_a_fitted_response_is_an_unknown_and_not_beside_exposures() -> None:
    options = ur.app.ImportOptions(response="fit", unknowns=("light", "colour"))
    assert options.unknowns == ("colour", "light", "response")
    names = unknowns.stages(options.chosen(()), Path("problem.toml")).stages[0].unknowns
    assert RESPONSE in names
    assert RESPONSE in [table["key"] for table in unknowns.parameters(options.chosen(()), 1.0)]
    with pytest.raises(InputError, match="undetermined up to a power"):
        ur.app.ImportOptions(response="fit", unknowns=("colour", "exposure"))


@pytest.mark.mitsuba
def test_photographs_under_known_lights_choose_by_themselves(tmp_path: Path) -> None:
    (tmp_path / "lit").mkdir()
    (tmp_path / "lit" / "lights.txt").write_text("1\n0 0 1\n")
    with pytest.raises(InputError, match="--response: with one camera under known lights"):
        ur.app.import_capture(tmp_path / "lit", tmp_path / "out", ur.app.ImportOptions(response="linear"))
    ignored: dict[str, Any] = {"field": 16, "mesh": tmp_path / "a.ply", "world_to_camera": True, "turntable": False}
    for name, value in ignored.items():
        option = name.replace("_", "-")
        with pytest.raises(
            InputError, match=f"--{option}: does not apply to one camera under known lights; leave it out"
        ):
            ur.app.import_capture(tmp_path / "lit", tmp_path / "out", ur.app.ImportOptions(**{name: value}))
    assert not (tmp_path / "out").exists()
