# Dr.Jit's stubs know less than its functions return.
# pyright: reportArgumentType=false, reportAttributeAccessIssue=false

"""References as films store them: every pixel format of Mitsuba's, alpha, and what is refused."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest
from PIL import Image

import unrender as ur
from tiers import quick
from unrender.io import images

KEY = "wall.bsdf.reflectance.value"
TRUTH = [0.7, 0.4, 0.2]
FORMATS = ("rgb", "rgba", "xyz", "xyza", "luminance", "luminance_alpha")


def scene(pixel_format: str, rfilter: str = "gaussian") -> dict[str, Any]:
    film = {"type": "hdrfilm", "width": 6, "height": 6, "pixel_format": pixel_format, "rfilter": {"type": rfilter}}
    place = mi.ScalarTransform4f().look_at(origin=[0, 0, 3], target=[0, 0, 0], up=[0, 1, 0])
    return {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 2},
        "sensor": {"type": "perspective", "to_world": place, "film": film},
        "sky": {"type": "constant"},
        "wall": {"type": "rectangle", "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": TRUTH}}},
    }


def problem(pixel_format: str, reference: Any, rfilter: str = "gaussian", **view: Any) -> ur.Problem:
    start = ur.Parameter(KEY, initial=TRUTH)
    return ur.Problem(lambda: scene(pixel_format, rfilter), [start], [ur.View(reference, **view)])


def rendered(pixel_format: str) -> np.ndarray:
    return np.array(mi.render(mi.load_dict(scene(pixel_format)), spp=2048))


@pytest.mark.parametrize("pixel_format", FORMATS)
@pytest.mark.parametrize("kind", quick(["array", "exr", "npy"], "exr"))
def test_the_truth_s_image_is_the_reference(pixel_format: str, kind: str, tmp_path: Path) -> None:
    given: Any = rendered(pixel_format)
    if kind == "exr":
        image = mi.load_dict(scene(pixel_format))
        mi.render(image, spp=2048)
        image.sensors()[0].film().bitmap().write(str(tmp_path / "reference.exr"))
        given = tmp_path / "reference.exr"
    elif kind == "npy":
        np.save(tmp_path / "reference.npy", given)
        given = tmp_path / "reference.npy"
    made = problem(pixel_format, given)
    reference = np.asarray(made.views[0].reference)
    assert made.views[0].mask is None
    np.testing.assert_allclose(ur.render(made, spp=2048), reference, atol=0.02)
    if pixel_format.startswith("luminance"):
        assert np.ptp(reference, axis=2).max() == 0
    else:
        np.testing.assert_allclose(reference, rendered("rgb"), atol=0.01)


@pytest.mark.parametrize("pixel_format", ["xyz", "xyza"])
def test_a_file_that_calls_values_of_an_xyz_film_rgb_is_refused(pixel_format: str, tmp_path: Path) -> None:
    """As `mi.util.write_bitmap` does with an array of `mi.render`: taken as RGB, colours would be off by up to 9 %."""
    mi.Bitmap(rendered(pixel_format)).write(str(tmp_path / "reference.exr"))
    with pytest.raises(ur.InputError, match=r"the file names its channels R, G and B.*pixel_format is xyz"):
        problem(pixel_format, tmp_path / "reference.exr")


@pytest.mark.parametrize("of", ["array", "PIL", "torch", "npy"])
def test_bytes_are_srgb_for_an_xyz_film_too(of: str, tmp_path: Path) -> None:
    """Pictures of PIL and PyTorch, whose kind of number is not told as NumPy's, and .npy files were converted as if they were XYZ."""
    given: Any = np.tile(np.array([200, 120, 60], np.uint8), (6, 6, 1))
    expected = np.asarray(problem("rgb", given).views[0].reference)
    if of == "PIL":
        given = Image.fromarray(given)
    elif of == "torch":
        given = pytest.importorskip("torch").tensor(given)
    elif of == "npy":
        np.save(tmp_path / "a.npy", given)
        given = tmp_path / "a.npy"
    np.testing.assert_allclose(np.asarray(problem("xyz", given).views[0].reference), expected, atol=1e-6)


@pytest.mark.parametrize("file", [io.BytesIO(b"x"), io.StringIO("x")])
def test_an_open_file_is_refused_in_one_line(file: Any) -> None:
    """It has a method `detach`, as a tensor of PyTorch has."""
    with pytest.raises(ur.InputError, match="view 0: reference: "):
        problem("rgb", file)


def test_gradients_of_luminance_are_those_of_the_weighted_channels() -> None:
    numbers = np.random.default_rng(0)
    grey, colour = problem("luminance", np.zeros((6, 6))), problem("rgb", np.zeros((6, 6, 3)))
    weights = numbers.uniform(0.5, 1.5, (1, 6, 6, 3)).astype(np.float32)
    of_rgb = weights.sum(axis=3, keepdims=True) * np.array([0.212671, 0.715160, 0.072169])
    request = ur.protocols.SampleRequest(0, 16, 3)
    found = []
    for made, weight in ((grey, weights), (colour, of_rgb)):
        session, values = made.renderer.prepare([KEY], "path"), made.initial()
        paths = session.image(values, request).paths
        one = session.adjoint(values, paths, made.renderer.array(weight))[KEY]
        pair = session.image_pair(values, values, request, "path")
        array = made.renderer.array(weight)
        both = session.adjoint_pair(values, values, pair.paths, array, array)
        tangents = {KEY: made.renderer.array(np.ones(3))}
        found.append([np.array(x) for x in (one, both[0][KEY], both[1][KEY])])
        moment = np.array(session.tangent_moment(values, paths, tangents))
        assert moment.shape == (6, 6, 3)
        assert np.isfinite(moment).all()
        if made is grey:
            assert np.ptp(moment, axis=2).max() == 0
            assert moment.max() > 0
    for one, other in zip(*found, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-4)


@pytest.mark.parametrize(
    ("pixel_format", "shape", "words"),
    [
        (
            "rgb",
            (6, 6, 2),
            r"shape \(H, W, 3\) with red, green and blue, or \(H, W\) with one value per pixel, got \(6, 6, 2\)",
        ),
        ("rgb", (6, 6, 5), r"got \(6, 6, 5\)"),
        ("rgba", (6, 6, 7), r"got \(6, 6, 7\)"),
        ("xyz", (6, 6, 1), r"expected an array of shape \(H, W, 3\), got \(6, 6, 1\): the film's pixel_format is xyz"),
        ("luminance", (6, 6, 3), r"expected an array of shape \(H, W\) or \(H, W, 1\).*pixel_format is luminance"),
        ("luminance_alpha", (6, 6, 4), r"pixel_format is luminance"),
        ("luminance", (5, 6, 1), r"6x5 pixels .* but the sensor's film is 6x6"),
    ],
)
def test_other_channels_and_sizes_are_refused_in_one_line(
    pixel_format: str, shape: tuple[int, ...], words: str
) -> None:
    with pytest.raises(ur.InputError, match=words) as caught:
        problem(pixel_format, np.zeros(shape))
    assert "\n" not in str(caught.value)
    assert str(caught.value).startswith("view 0: reference")


def test_values_that_are_no_radiance_are_refused_in_one_line() -> None:
    for pixel_format, shape in (("rgb", (6, 6, 3)), ("xyz", (6, 6, 3)), ("luminance", (6, 6))):
        for bad, words in (
            (np.nan, "1 pixel is NaN or infinite"),
            (-0.5, "1 pixel is negative, the first in row 2"),
        ):
            reference = np.ones(shape)
            reference[2, 3] = bad
            with pytest.raises(ur.InputError, match=words):
                problem(pixel_format, reference)
            if bad < 0:
                problem(pixel_format, reference, "lanczos")


def test_a_colour_picture_is_no_reference_of_luminance(tmp_path: Path) -> None:
    mi.Bitmap(np.ones((6, 6, 3), np.float32)).write(str(tmp_path / "colour.exr"))
    with pytest.raises(ur.InputError, match="three channels and the film's pixel_format is luminance"):
        problem("luminance", tmp_path / "colour.exr")


def test_alpha_of_eight_bits_is_a_mask_and_that_of_floats_is_left_out(tmp_path: Path) -> None:
    picture = np.full((6, 6, 4), 200, np.uint8)
    picture[:, :3, 3] = 0
    picture[:, 3, 3] = 200
    picture[:, 4:, 3] = 255
    mi.Bitmap(picture).write(str(tmp_path / "cut.png"))
    own = np.ones((6, 6), np.float32)
    own[0] = 0
    for given in (picture, tmp_path / "cut.png"):
        made = problem("rgb", given)
        mask = np.asarray(made.views[0].mask)
        np.testing.assert_array_equal(mask[2], [0, 0, 0, 0, 1, 1])
        assert "only its opaque pixels count" in made.notices[0]
        both = np.asarray(problem("rgb", given, mask=own).views[0].mask)
        np.testing.assert_allclose(both, mask * own)
    assert problem("rgb", picture.astype(np.float32)).views[0].mask is None
    picture[..., 3] = 0
    with pytest.raises(ur.InputError, match="alpha is below 1 wherever the mask is above 0"):
        problem("rgb", picture)


def test_the_colour_of_a_cut_out_is_not_that_of_its_edges() -> None:
    """Edges of straight alpha counted with their alpha, though a rendered edge is darker: 0.7 became 0.75."""
    film = {"type": "hdrfilm", "width": 16, "height": 16, "pixel_format": "rgba"}
    described = {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 3, "hide_emitters": True},
        "sensor": {
            "type": "perspective",
            "to_world": mi.ScalarTransform4f().look_at([0, 0, 4], [0, 0, 0], [0, 1, 0]),
            "film": film,
        },
        "sky": {"type": "constant", "radiance": {"type": "rgb", "value": 0.6}},
        "ball": {
            "type": "sphere",
            "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.7, 0.3, 0.1]}},
        },
    }
    image = np.array(mi.render(mi.load_dict(described), spp=1024))
    straight = np.clip(image[..., :3] / np.maximum(image[..., 3:], 1e-4), 0.0, 1.0)
    encoded = np.where(straight < 0.0031308, 12.92 * straight, 1.055 * straight ** (1 / 2.4) - 0.055)
    cut = (65535 * np.concatenate([encoded, np.clip(image[..., 3:], 0, 1)], axis=2) + 0.5).astype(np.uint16)
    key = "ball.bsdf.reflectance.value"
    made = ur.Problem(described, [ur.Parameter(key, initial=0.5)], [ur.View(cut)])
    result = ur.optimize(made, ur.PathGradient(spp=16), ur.optimizers.Adam(0.03), steps=60, progress=False)
    np.testing.assert_allclose(result.parameters[key], [0.7, 0.3, 0.1], atol=0.015)


def test_films_of_luminance_and_colour_in_one_scene_are_refused() -> None:
    described = scene("rgb") | {"other": scene("luminance")["sensor"]}
    with pytest.raises(ur.InputError, match="some films have the pixel_format luminance"):
        ur.Problem(described, [ur.Parameter(KEY)], [ur.View(np.zeros((6, 6, 3)))])


def test_the_matrix_is_mitsuba_s() -> None:
    values = np.random.default_rng(0).random((5, 3)).astype(np.float32)
    expected = np.array(mi.xyz_to_srgb(mi.Color3f(values.T))).T
    np.testing.assert_allclose(images.xyz_to_rgb(values), expected, atol=1e-4)


def test_a_loop_of_one_s_own_renders_luminance() -> None:
    renderer = ur.Renderer(lambda: scene("luminance"), [KEY], spp=4)
    image = np.array(renderer.render({KEY: np.array(TRUTH, np.float32)}))
    assert np.ptp(image, axis=2).max() == 0


@pytest.mark.parametrize("pixel_format", ["luminance", "xyz", "rgb"])
def test_an_exported_scene_is_compared_with_references_as_the_problem_is(pixel_format: str, tmp_path: Path) -> None:
    """Later stages have exported scenes: an RGB film would compare every channel with a luminance, and XYZ with RGB."""
    reference = rendered(pixel_format)
    made = problem(pixel_format, reference)
    scene_file = ur.app.export((made, made.initial_values()), tmp_path / "scene").scene
    assert scene_file is not None
    again = ur.Problem(scene_file, [ur.Parameter(KEY)], [ur.View(reference)])
    for own in (made, again):
        np.testing.assert_allclose(
            ur.render(own, spp=1024), np.asarray(own.views[0].reference), atol=0.03, err_msg=pixel_format
        )
    np.testing.assert_array_equal(again.views[0].reference, made.views[0].reference)
