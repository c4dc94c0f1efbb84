"""Spectral variants: images, derivatives, colours as RGB, and what is refused."""

# Dr.Jit's stubs know less than its functions return.
# pyright: reportArgumentType=false, reportAttributeAccessIssue=false

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

import unrender as ur
from scripts.coverage.plugins import PLUGINS
from spectral_scenes import COLOUR, DEPTH, KEYS, ROUGHNESS, SIZE, SPECTRUM, TEXTURE, scene, spectrum
from statistical.zscores import agree
from unrender.rendering.mitsuba import film_response, spectral_colours
from unrender.rendering.mitsuba.renderer import MitsubaRenderer
from unrender.rendering.renderer import SampleRequest

pytestmark = pytest.mark.usefixtures("spectral_variant")

RUNS, SPP = 12, 128


@pytest.fixture(scope="module")
def renderer(spectral_variant: str) -> MitsubaRenderer:
    return MitsubaRenderer(scene, DEPTH)


@pytest.fixture(scope="module")
def stock(renderer: MitsubaRenderer) -> np.ndarray:
    path = mi.load_dict({"type": "path", "max_depth": DEPTH})
    loaded = mi.load_dict(scene())
    return np.stack([np.array(mi.render(loaded, integrator=path, spp=SPP, seed=n)) for n in range(RUNS)])


def images(renderer: MitsubaRenderer) -> np.ndarray:
    session, values = renderer.prepare([], None), {}
    return np.stack([np.array(session.image(values, SampleRequest(0, SPP, 100 + n)).images[0]) for n in range(RUNS)])


def test_the_image_is_that_of_mitsuba(renderer: MitsubaRenderer, stock: np.ndarray):
    ours = images(renderer)
    assert agree(ours, stock, 2)
    assert ours.std(axis=0).mean() < 1.3 * stock.std(axis=0).mean()
    assert not agree(1.02 * ours, stock, 2)


def _camera(**changes: Any) -> dict[str, Any]:
    given = scene()["camera"]
    return {"camera": {**given, **changes, "film": {**given["film"], **changes.get("film", {})}}}


@pytest.mark.slow
@pytest.mark.parametrize(
    "others",
    [
        lambda: _camera(type="thinlens", aperture_radius=0.1, focus_distance=3.0),
        lambda: {"camera": {key: x for key, x in scene()["camera"].items() if key != "fov"} | {"type": "orthographic"}},
        lambda: _camera(film={"rfilter": {"type": "gaussian"}}),
        lambda: _camera(film={"rfilter": {"type": "mitchell"}}),
        lambda: _camera(film={"pixel_format": "luminance"}),
        lambda: {"integrator": {"type": "path", "max_depth": DEPTH, "hide_emitters": True}},
        lambda: {"sky": {"type": "envmap", "bitmap": mi.Bitmap(np.full((4, 8, 3), [1.5, 0.5, 0.1], np.float32))}},
        lambda: {"sky": {"type": "sunsky", "sun_direction": [0.3, 0.8, 0.5]}},
        lambda: {"sky": {"type": "point", "position": [1, 1, 3], "intensity": spectrum(0.01, 0.05, 0.02)}},
        lambda: {"ball": {**scene()["ball"], "bsdf": {"type": "roughconductor", "material": "Au", "alpha": 0.3}}},
        lambda: {"ball": {**scene()["ball"], "bsdf": {"type": "dielectric"}}},
        lambda: {"ball": {**scene()["ball"], "bsdf": {"type": "plastic", "diffuse_reflectance": spectrum(0.1, 0.8)}}},
    ],
    ids=[
        "thinlens", "orthographic", "gaussian", "mitchell", "luminance", "hidden", "envmap", "sunsky", "point", "gold", "glass",
        "plastic",
    ],
)  # fmt: skip
def test_images_of_other_sensors_lights_and_materials(others: Callable[[], dict[str, Any]]):
    renderer = MitsubaRenderer(lambda: scene(**others()), DEPTH)
    hidden = renderer.light_paths.hide_emitters
    path = mi.load_dict({"type": "path", "max_depth": DEPTH, "hide_emitters": hidden})
    loaded = mi.load_dict(scene(**others()))
    stock = np.stack([np.array(mi.render(loaded, integrator=path, spp=SPP, seed=n)) for n in range(RUNS)])
    assert agree(images(renderer), stock * np.ones(3), 2)


@pytest.mark.slow
def test_images_of_moved_shapes(stock: np.ndarray):
    """Perturbed renders of poses: at the identity they are the scene's image, and a moved ball changes it."""
    renderer = MitsubaRenderer(scene, DEPTH)
    session = renderer.prepare(["ball.translation"], None, derivatives=False)
    at = np.zeros((2, 3), np.float32)
    at[1, 0] = 0.3
    found = [session.image_batch({"ball.translation": at}, SampleRequest(0, SPP, 70 + n)) for n in range(RUNS)]
    both = np.stack([np.array(images) for images in found])
    assert agree(both[:, 0], stock, 2)
    assert not agree(both[:, 1], stock, 2)


def test_pixels_of_several_sensors_in_one_launch():
    description = {**scene(), "other": {**scene()["camera"], "fov": 30}}
    renderer = MitsubaRenderer(description, DEPTH)
    session, pixels = renderer.prepare([], None), np.arange(SIZE * SIZE)
    request = SampleRequest(0, SPP, 3, pixels=mi.UInt32(pixels), sensors=mi.UInt32(pixels % 2))
    together = np.stack(
        [np.array(session.image({}, replace(request, seed=n)).images[0]).reshape(SIZE, SIZE, 3) for n in range(RUNS)]
    )
    alone = [
        np.stack([np.array(session.image({}, SampleRequest(s, SPP, 50 + n)).images[0]) for n in range(RUNS)])
        for s in (0, 1)
    ]
    chosen = np.where((pixels % 2).reshape(SIZE, SIZE, 1) == 0, *alone)
    assert agree(together, chosen, 2)


@functools.cache
def slopes(key: str, step: float) -> tuple[np.ndarray, np.ndarray]:
    """Differences of a weighted image along one direction of a parameter, on the paths of the adjoint, and the adjoint's."""
    renderer = MitsubaRenderer(scene, DEPTH)
    session, current = renderer.prepare(list(KEYS), "path"), renderer.values(list(KEYS))
    numbers, request = np.random.default_rng(2), SampleRequest(0, 64, 7)
    weight = numbers.uniform(0.5, 1.5, (SIZE, SIZE, 3))
    paths = session.image(current, request).paths
    gradient = np.array(session.adjoint(current, paths, renderer.array(weight[None]))[key], float)
    value = np.array(current[key])
    found, expected = [], []
    for element in range(min(4, value.size)):
        direction = np.zeros(value.size, np.float32)
        direction[element] = 1
        direction = direction.reshape(value.shape)
        sides = [
            session.image_pair(current, {**current, key: renderer.array(value + side * direction)}, request, "path")
            for side in (step, -step)
        ]
        ends = [np.array(side.previous, float)[0] for side in sides]
        expected.append(((ends[0] - ends[1]) * weight).sum() / (2 * step))
        found.append((gradient * direction).sum())
    return np.array(found), np.array(expected)


@pytest.mark.parametrize(("key", "step"), [(TEXTURE, 5e-4), (SPECTRUM, 4e-3), (COLOUR, 5e-4), (ROUGHNESS, 1e-3)])
def test_the_adjoint_is_the_derivative_on_the_same_paths(key: str, step: float):
    found, expected = slopes(key, step)
    np.testing.assert_allclose(found, expected, rtol=0.01, atol=0.003 * np.abs(expected).max())


def test_an_adjoint_without_the_weight_of_the_wavelengths_is_found_out(monkeypatch: pytest.MonkeyPatch):
    """The planted fault: the adjoint takes wavelengths as if they were uniform from 360 to 830 nm."""
    right = film_response.FilmResponse.pull_back

    def uniform(self: Any, δ: Any) -> Any:
        return right(self, δ) / self.weight * 470.0

    monkeypatch.setattr(film_response.FilmResponse, "pull_back", uniform)
    slopes.cache_clear()
    found, expected = slopes(SPECTRUM, 4e-3)
    slopes.cache_clear()
    assert np.abs(found - expected).max() > 0.05 * np.abs(expected).max()


@pytest.mark.slow
def test_differential_sampling_of_roughness_agrees_with_the_standard_adjoint():
    bsdf = {"type": "roughconductor", "alpha": 0.2}
    plain = MitsubaRenderer(lambda: scene(shiny={**scene()["shiny"], "bsdf": bsdf}), DEPTH)
    key = next(name for name in plain.parameters() if name.endswith("alpha.value"))
    weight = plain.array(np.full((1, SIZE, SIZE, 3), 1 / SIZE**2))
    slopes = []
    for renderer in (plain, plain.with_differential_bsdf()):
        session, values = renderer.prepare([key], None), renderer.values([key])
        slopes.append([])
        for number in range(16):
            paths = session.image(values, SampleRequest(0, 256, number)).paths
            slopes[-1].append(float(session.adjoint(values, paths, weight)[key].array[0]))
    means, errors = np.mean(slopes, axis=1), np.std(slopes, axis=1, ddof=1) / 4
    assert abs(means[0] - means[1]) < 4 * np.hypot(*errors)
    assert errors[1] < errors[0]


def test_the_response_of_the_film_is_that_of_mitsuba():
    λ = np.random.default_rng(3).uniform(360, 830, (4, 32)).astype(np.float32)
    L, weight = (np.random.default_rng(n).uniform(0.2, 2, (4, 32)).astype(np.float32) for n in (4, 5))
    response = film_response.FilmResponse(mi.Spectrum(weight), mi.Spectrum(λ), film_response.response_table())
    expected = mi.spectrum_to_srgb(mi.Spectrum(L) * mi.Spectrum(weight), mi.Spectrum(λ))
    found = response.film(mi.Spectrum(L))
    np.testing.assert_allclose(np.array(found), np.array(expected), rtol=1e-3, atol=1e-6)
    δ = np.random.default_rng(6).normal(size=(3, 32)).astype(np.float32)
    pulled = np.array(response.pull_back(mi.Color3f(δ)))
    np.testing.assert_allclose((pulled * L).sum(), (δ * np.array(found)).sum(), rtol=1e-4)


# ---------------------------------------------------------------------- colours


@pytest.fixture(scope="module")
def colours(renderer: MitsubaRenderer) -> spectral_colours.SpectralColours:
    return renderer.pair.loaded().colours


def tensor(values: np.ndarray) -> mi.TensorXf:
    return mi.TensorXf(np.asarray(values, np.float32))


def test_coefficients_are_those_of_mitsuba(colours: spectral_colours.SpectralColours):
    rgb = np.random.default_rng(7).uniform(0.02, 0.98, (200, 3)).astype(np.float32)
    rgb[:6] = [[0.9, 0, 0.1], [0.1, 1, 0.1], [0.1, 0.1, 0.9], [0.2, 0.2, 0.2], [0.9, 0.9, 0.1], [1, 0.2, 0]]
    found = np.array(colours.native(TEXTURE, tensor(rgb)))
    expected = np.array([mi.srgb_model_fetch(mi.ScalarColor3f(*map(float, row))) for row in rgb])
    np.testing.assert_allclose(found, expected, rtol=2e-3, atol=1e-6)


def test_colours_come_back_from_their_coefficients(colours: spectral_colours.SpectralColours):
    rgb = np.random.default_rng(8).uniform(0.02, 0.98, (50, 3))
    rgb = np.concatenate([rgb, np.linspace(0, 1, 9)[:, None] * np.ones(3)])
    back = np.array(colours.value(TEXTURE, colours.native(TEXTURE, tensor(rgb))))
    np.testing.assert_allclose(back, rgb, atol=2e-3)


def test_derivatives_of_coefficients(colours: spectral_colours.SpectralColours):
    numbers = np.random.default_rng(9)
    rgb = numbers.uniform(0.1, 0.9, (300, 3))
    tangent, weight = numbers.normal(size=rgb.shape), numbers.normal(size=rgb.shape)
    ends = [np.array(colours.native(TEXTURE, tensor(rgb + side * 1e-4 * tangent)), float) for side in (1, -1)]
    expected = (ends[0] - ends[1]) / 2e-4
    found = np.array(colours.push_forward(TEXTURE, tensor(rgb), tensor(tangent)), float)
    error = np.abs(found - expected) / np.abs(expected).max(axis=0)
    assert np.quantile(error, 0.95) < 2e-3  # a few colours lie on an edge of a cell
    pulled = np.array(colours.pull_back(TEXTURE, tensor(rgb), tensor(weight)), float)
    np.testing.assert_allclose((pulled * tangent).sum(1), (weight * found).sum(1), rtol=1e-3, atol=1e-2)


def test_black_and_white_have_finite_coefficients_and_slopes(colours: spectral_colours.SpectralColours):
    rgb = tensor(np.array([[0, 0, 0], [1, 1, 1], [1, 0, 0], [0, 0, 1], [1.5, -0.5, 0.2]]))
    ones = tensor(np.ones((5, 3)))
    for result in (
        colours.native(TEXTURE, rgb),
        *(f(TEXTURE, rgb, ones) for f in (colours.pull_back, colours.push_forward)),
    ):
        assert np.isfinite(np.array(result)).all()
    assert np.array(colours.pull_back(TEXTURE, rgb, ones)).any(axis=1).all()


def test_parameters_are_linear_srgb_in_their_range(renderer: MitsubaRenderer):
    from spectral_scenes import texels

    info, values = renderer.parameters(), renderer.values([TEXTURE, COLOUR])
    assert (info[TEXTURE].lowest, info[TEXTURE].highest) == (0, 1) == (info[SPECTRUM].lowest, info[SPECTRUM].highest)
    np.testing.assert_allclose(np.array(values[TEXTURE]), texels(), atol=1e-3)
    np.testing.assert_allclose(np.array(values[COLOUR]), [0.71, 0.31, 0.12], atol=1e-3)


# ---------------------------------------------------------------------- refusals


def _raw_wall() -> dict[str, Any]:
    picture = {"type": "bitmap", "bitmap": mi.Bitmap(np.full((2, 2, 3), 0.5, np.float32)), "raw": True}
    return {"type": "rectangle", "bsdf": {"type": "diffuse", "reflectance": picture}}


def _picture_wall(name: str, picture: Any) -> dict[str, Any]:
    made = {"type": "bitmap", name: picture, "raw": False}
    return {"type": "rectangle", "bsdf": {"type": "diffuse", "reflectance": made}}


def _overwritten() -> mi.Bitmap:
    """Return a bitmap that an earlier load has overwritten with coefficients."""
    picture = mi.Bitmap(np.full((2, 2, 3), [0.8, 0.3, 0.1], np.float32))
    mi.load_dict({"type": "bitmap", "bitmap": picture, "raw": False})
    return picture


def test_a_bitmap_object_keeps_its_colours_for_the_next_load() -> None:
    """Mitsuba overwrites it with coefficients; a second load, such as that of the previous state, would then read another picture."""
    picture = mi.Bitmap(np.full((2, 2, 3), [0.8, 0.3, 0.1], np.float32))
    description = scene(wall=_picture_wall("bitmap", picture))
    for _ in range(2):
        renderer = MitsubaRenderer(description, DEPTH)
        values = renderer.values(["wall.bsdf.reflectance.data"])["wall.bsdf.reflectance.data"]
        np.testing.assert_allclose(np.array(values)[0, 0], [0.8, 0.3, 0.1], atol=2e-3)
    np.testing.assert_allclose(np.array(picture)[0, 0], [0.8, 0.3, 0.1], atol=1e-6)


def _fog() -> dict[str, Any]:
    return {"type": "sphere", "bsdf": {"type": "null"}, "interior": {"type": "homogeneous"}}


@pytest.mark.parametrize(
    ("others", "message"),
    [
        (lambda: {"wall": _raw_wall()}, "the bitmap of reflectance is raw.*set raw to false"),
        (
            lambda: {"wall": _picture_wall("data", mi.TensorXf(np.full((2, 2, 3), [0.01, 0.5, 0.3], np.float32)))},
            "bitmap: spectral variants take data for coefficients.*give bitmap = ",
        ),
        (lambda: {"wall": _picture_wall("bitmap", _overwritten())}, "colours below 0.*make a new mitsuba.Bitmap"),
        (lambda: {"fog": _fog()}, "do not support participating media; use the variant (llvm|cuda)_ad_rgb"),
        (
            lambda: {"camera": {"type": "perspective", "film": {"type": "specfilm", "b": spectrum(1, 1)}}},
            "support an hdrfilm without srf only",
        ),
    ],
)
def test_a_scene_that_is_not_supported_is_one_line(others: Callable[[], dict[str, Any]], message: str):
    with pytest.raises(ur.InputError, match=message) as error:
        MitsubaRenderer(lambda: scene(**others()), DEPTH)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("key", "message"),
    [
        ("metal.bsdf.k.value", "coefficients of a spectrum"),
        ("lamp.emitter.radiance.value", "coefficients of a spectrum"),
        ("sky.radiance.value", "coefficients of a spectrum"),
        ("mesh.vertex_color", "attributes of meshes"),
        ("mesh.vertex_positions", "moving shapes do not support spectral variants"),
        ("mesh.translation", "moving shapes do not support spectral variants"),
        ("camera.rotation", "moving sensors do not support spectral variants"),
    ],
)
def test_a_parameter_that_is_not_supported_is_one_line(key: str, message: str):
    def described() -> dict[str, Any]:
        mesh = mi.Mesh("mesh", 3, 1)
        values = mi.traverse(mesh)
        values["vertex_positions"] = mi.Float([0, 0, 0, 1, 0, 0, 0, 1, 0])
        values["faces"] = mi.UInt32([0, 1, 2])
        values.update()
        mesh.add_attribute("vertex_color", 3, [0.5] * 9)
        bsdf = {"type": "conductor", "eta": 1.5, "k": {"type": "rgb", "value": [0.2, 0.3, 0.4]}}
        return scene(mesh=mesh, metal={"type": "cube", "bsdf": bsdf})

    renderer = MitsubaRenderer(described, DEPTH)
    with pytest.raises(ur.InputError, match=message) as error:
        renderer.prepare([key], None)
    assert "\n" not in str(error.value)


def test_a_colour_in_half_precision_is_not_recovered() -> None:
    """Colours were off by .03 and changed in such steps."""
    wall = _picture_wall("bitmap", mi.Bitmap(np.full((2, 2, 3), [0.8, 0.3, 0.1], np.float32)))
    wall["bsdf"]["reflectance"]["format"] = "fp16"
    info = MitsubaRenderer(lambda: scene(wall=wall), DEPTH).parameters()["wall.bsdf.reflectance.data"]
    assert not info.perturbable
    assert "set its format to variant" in info.reason


def test_aovs_are_refused(renderer: MitsubaRenderer):
    with pytest.raises(ur.InputError, match="depth: spectral variants render radiance only"):
        renderer.with_aov("depth")


def test_the_scenes_of_another_variant_do_not_enter_kernels(renderer: MitsubaRenderer, mitsuba_variant: str):
    from unrender.rendering.mitsuba.loaded_scene import loaded_scenes

    assert renderer.pair.loaded() in loaded_scenes()
    ur.use(mitsuba_variant)
    try:
        assert renderer.pair.loaded() not in loaded_scenes()
        assert not film_response.is_spectral()
        assert film_response.response_table() == {}
    finally:
        ur.use(mitsuba_variant.replace("rgb", "spectral"))
    assert dr.isfinite(renderer.values([SPECTRUM])[SPECTRUM].array[0])


def _refused(name: str, folder: Path) -> str:
    """The line that refuses a plugin's scene, "" if it renders with finite pixels."""
    description = PLUGINS[name].build(folder)
    for part in description.values():
        holder = part.get("bsdf", part) if isinstance(part, dict) else {}
        for slot in ("reflectance", "base_color", "irradiance"):
            if isinstance(found := holder.get(slot), dict) and found.get("raw"):
                found["raw"] = False
    try:
        session = MitsubaRenderer(description, 3).prepare([], None, False)
    except ur.InputError as error:
        return str(error)
    assert np.isfinite(np.array(session.image({}, SampleRequest(0, 4, 1)).images)).all(), name
    return ""


QUICK = ("timed_sunsky", "sunsky", "rawconstant", "blackbody", "projector", "measured")


@pytest.mark.parametrize(
    "names",
    [
        pytest.param(QUICK, id="some"),
        pytest.param(sorted(PLUGINS.keys() - set(QUICK)), id="others", marks=pytest.mark.slow),
    ],
)
def test_every_plugin_of_the_wheel_renders_or_is_refused_in_one_line(names: Sequence[str], tmp_path: Path) -> None:
    """As in RGB variants. timed_sunsky, sunsky and rawconstant ended in tracebacks."""
    lines = {name: _refused(name, tmp_path) for name in names}
    known = {
        "timed_sunsky": "give a sunsky in its place",
        "rawconstant": "rawconstant of",
        "sunsky": "",
        "blackbody": "",
    }
    assert {name: line for name, line in known.items() if line not in lines.get(name, line)} == {}
    assert [name for name in ("sunsky", "blackbody", "projector", "bitmap", "perspective") if lines.get(name)] == []
