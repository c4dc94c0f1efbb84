"""Reading pictures: every format as linear values, and one clear line for those that cannot be read."""

from __future__ import annotations

import contextlib
import struct
import zlib
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import mitsuba as mi
import numpy as np
import pytest
from PIL import Image, ImageCms

from unrender.core.errors import InputError
from unrender.io import images
from unrender.io import parameter_values as values
from unrender.losses import L2
from unrender.rendering.mitsuba.pixel_format import formats
from unrender.scene.references import View
from unrender.scene.view_checks import check_views, read_reference

COLOURS = np.random.default_rng(0).random((6, 8, 3)).astype(np.float32)


def bitmap(array: np.ndarray, path: Path) -> Path:
    mi.Bitmap(array).write(str(path))
    return path


@pytest.mark.parametrize(("name", "tolerance"), [("a.exr", 1e-6), ("a.hdr", 1e-2), ("a.pfm", 1e-6)])
def test_reads_linear_files_as_they_are(tmp_path: Path, name: str, tolerance: float):
    picture = images.read(bitmap(COLOURS, tmp_path / name))
    assert picture.notice == ""
    assert picture.values.dtype == np.float32
    np.testing.assert_allclose(picture.values, COLOURS, atol=tolerance)


def test_reads_npy(tmp_path: Path):
    np.save(tmp_path / "a.npy", COLOURS.astype(np.float64))
    np.testing.assert_array_equal(images.read(tmp_path / "a.npy").values, COLOURS)


@pytest.mark.parametrize("bits", [8, 16])
def test_linearises_png(tmp_path: Path, bits: int):
    levels = np.linspace(0, 2**bits - 1, 6 * 8 * 3).reshape(6, 8, 3).astype(f"uint{bits}")
    picture = images.read(bitmap(levels, tmp_path / "a.png"))
    assert picture.notice == f"a.png: {bits}-bit sRGB, linearised"
    encoded = levels / (2**bits - 1)
    np.testing.assert_allclose(picture.values, images.srgb_to_linear(encoded), atol=2e-6)
    np.testing.assert_allclose(images.read(tmp_path / "a.png", linearise=False).values, encoded, atol=1e-6)


def test_srgb_is_linearised_by_the_standard_curve():
    values = images.srgb_to_linear(np.array([0, 0.04, 0.5, 1.0]))
    np.testing.assert_allclose(values, [0, 0.0030959752, 0.2140411, 1], rtol=1e-6)


def test_reads_jpeg_and_upper_case_endings(tmp_path: Path):
    Image.fromarray(np.full((6, 8, 3), 188, np.uint8)).save(tmp_path / "A.JPG")
    picture = images.read(str(tmp_path / "A.JPG"))
    assert picture.notice == "A.JPG: 8-bit sRGB, linearised"
    np.testing.assert_allclose(picture.values, 0.5029, atol=5e-3)


@pytest.mark.parametrize("name", ["a.jpg", "a.png"])
def test_a_picture_that_viewers_turn_is_refused_as_reference_and_mask(tmp_path: Path, name: str):
    exif = Image.Exif()
    exif[0x0112] = 6
    picture = Image.fromarray(np.full((8, 8, 3), 188, np.uint8))
    picture.save(tmp_path / name, exif=exif)
    picture.save(tmp_path / f"upright-{name}")
    films: Any = SimpleNamespace(resolutions=lambda: [(8, 8)])
    for view in (View(tmp_path / name), View(np.ones((8, 8, 3)), mask=tmp_path / name)):
        with pytest.raises(InputError, match=r"EXIF orientation is 6.*save the pixels upright"):
            check_views([view], films, L2())
    assert images.check_metadata(tmp_path / f"upright-{name}") == ""
    # A value is what Mitsuba makes of the file, as in a scene.
    said = "its EXIF orientation is 6, which viewers apply and Mitsuba ignores; save the pixels upright, without it"
    assert said in values.fill(tmp_path / name, (8, 8, 3))[1]
    assert values.fill(tmp_path / f"upright-{name}", (8, 8, 3))[1] == f"upright-{name}: 8-bit sRGB, linearised"


def test_a_colour_profile_other_than_srgb_is_reported(tmp_path: Path):
    picture = Image.fromarray(np.full((6, 8, 3), 188, np.uint8))
    for name in ("sRGB", "LAB"):
        profile = ImageCms.ImageCmsProfile(ImageCms.createProfile(name)).tobytes()
        picture.save(tmp_path / f"{name}.png", icc_profile=profile)
    assert images.check_metadata(tmp_path / "sRGB.png") == ""
    assert "LAB.png: its colour profile is not sRGB" in images.check_metadata(tmp_path / "LAB.png")
    assert "its colour profile is not sRGB" in values.fill(tmp_path / "LAB.png", (6, 8, 3))[1]
    assert values.fill(tmp_path / "LAB.png", (6, 8, 3), values.FileConversion(raw=True))[1] == ""
    # Neither the name decides, nor the kind of the pixels.
    named = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    swapped = named.replace(b"rXYZ", b"----").replace(b"gXYZ", b"rXYZ").replace(b"----", b"gXYZ")
    for profile, srgb in ((named.replace("sRGB".encode("utf-16-be"), bytes(8)), True), (swapped, False)):
        for mode in ("RGB", "L"):
            picture.convert(mode).save(tmp_path / "a.png", icc_profile=profile)
            assert (images.check_metadata(tmp_path / "a.png") == "") is srgb


def test_a_gamma_other_than_that_of_srgb_is_refused_in_a_reference_and_not_in_a_mask(tmp_path: Path):
    Image.fromarray(np.full((8, 8, 3), 188, np.uint8)).save(tmp_path / "plain.png")
    data = (tmp_path / "plain.png").read_bytes()
    films: Any = SimpleNamespace(resolutions=lambda: [(8, 8)])
    for gamma, refused in ((100_000, True), (55_556, True), (45_455, False)):
        chunk = b"gAMA" + struct.pack(">I", gamma)
        body = struct.pack(">I", 4) + chunk + struct.pack(">I", zlib.crc32(chunk))
        (tmp_path / "a.png").write_bytes(data[:33] + body + data[33:])
        check_views([View(np.ones((8, 8, 3)), mask=tmp_path / "a.png")], films, L2())
        with pytest.raises(InputError, match="declares a gamma of") if refused else contextlib.nullcontext():
            check_views([View(tmp_path / "a.png")], films, L2())
        assert ("declares a gamma of" in values.fill(tmp_path / "a.png", (8, 8, 3))[1]) is refused
        assert values.fill(tmp_path / "a.png", (8, 8, 3), values.FileConversion(raw=True))[1] == ""


def test_colours_of_adobe_rgb_without_a_profile_are_reported(tmp_path: Path):
    exif = Image.Exif()
    exif.get_ifd(0x8769)[0xA005] = {1: "R03"}
    Image.fromarray(np.full((8, 8, 3), 188, np.uint8)).save(tmp_path / "a.jpg", exif=exif)
    assert "a.jpg: its colour profile is not sRGB" in images.check_metadata(tmp_path / "a.jpg")


def test_a_bitmap_is_read_as_its_file(tmp_path: Path):
    """In its own colour space, and left as it is."""
    rgb, kinds, form = mi.Bitmap(COLOURS), mi.Struct.Type, mi.Bitmap.PixelFormat
    linear = rgb.convert(form.RGB, kinds.UInt8, False)
    xyz: Any = rgb.convert(form.XYZ, kinds.Float32, False)
    double = mi.Bitmap(np.array(xyz, np.float64), form.XYZ)
    for bitmap_of in (xyz, double, rgb.convert(form.RGB, kinds.UInt8, True), linear):
        np.testing.assert_allclose(images.read(bitmap_of).values, COLOURS, atol=0.01)
    assert images.read(linear).notice == ""
    mask = rgb.convert(form.RGB, kinds.UInt8, True)
    np.testing.assert_allclose(images.read(mask, linearise=False).values, np.array(mask) / 255, atol=1e-6)
    assert mask.srgb_gamma()
    films: Any = SimpleNamespace(resolutions=lambda: [(6, 8)])
    view = check_views([View(xyz)], films, L2())[0][0]
    np.testing.assert_allclose(np.asarray(view.reference), COLOURS, atol=1e-5)


def test_drops_alpha_and_keeps_grey_as_one_channel(tmp_path: Path):
    rgba = np.concatenate([COLOURS, np.full((6, 8, 1), 0.25, np.float32)], axis=2)
    picture = images.read(bitmap(rgba, tmp_path / "a.exr"))
    np.testing.assert_array_equal(picture.values, COLOURS)
    np.testing.assert_array_equal(np.asarray(picture.alpha), rgba[..., 3])
    rgba[..., 3] = 1
    assert images.read(bitmap(rgba, tmp_path / "opaque.exr")).alpha is None
    assert images.read(bitmap(COLOURS[..., :1], tmp_path / "g.exr")).values.shape == (6, 8, 1)


def test_takes_the_colours_of_a_file_of_many_layers(tmp_path: Path):
    layers = np.concatenate([COLOURS, np.full((6, 8, 1), 9, np.float32), COLOURS[..., :1]], axis=2)
    names = ["R", "G", "B", "depth.T", "A"]
    mi.Bitmap(layers, mi.Bitmap.PixelFormat.MultiChannel, names).write(str(tmp_path / "a.exr"))
    picture = images.read(tmp_path / "a.exr")
    np.testing.assert_array_equal(picture.values, COLOURS)
    np.testing.assert_array_equal(np.asarray(picture.alpha), COLOURS[..., 0])
    assert picture.premultiplied


@pytest.mark.parametrize(("pixel_format", "stores"), [("rgb", False), ("rgba", True), ("luminance_alpha", True)])
def test_alpha_has_no_notice_if_the_film_stores_it(pixel_format: str, stores: bool):
    (form,) = formats(
        [mi.load_dict({"type": "perspective", "film": {"type": "hdrfilm", "pixel_format": pixel_format}})]
    )
    assert form.stores_alpha is stores
    channels = 2 if form.colour == "luminance" else 4
    assert read_reference(np.full((6, 8, channels), 0.5, np.float32), form).loses_alpha is not stores


def test_says_which_channels_a_file_without_colours_has(tmp_path: Path):
    layers = np.zeros((6, 8, 4), np.float32)
    names = ["a.X", "a.Y", "b.Z", "b.W"]
    mi.Bitmap(layers, mi.Bitmap.PixelFormat.MultiChannel, names).write(str(tmp_path / "a.exr"))
    with pytest.raises(InputError, match=r"a\.exr: has the channels .*a\.X.*, but not R, G and B; save colour alone"):
        images.read(tmp_path / "a.exr")
    names = ["diffuse.R", "diffuse.G", "diffuse.B"]
    mi.Bitmap(COLOURS, mi.Bitmap.PixelFormat.MultiChannel, names).write(str(tmp_path / "b.exr"))
    with pytest.raises(InputError, match=r"b\.exr: has the channels diffuse\.R, diffuse\.G, diffuse\.B, but not"):
        images.read(tmp_path / "b.exr")


@pytest.mark.parametrize("largest", [100, 65535])
def test_refuses_a_ppm_file_that_mitsuba_misreads(tmp_path: Path, largest: int):
    """Its values were off by a factor, or their bytes were swapped."""
    values = np.full((6, 8, 3), 50, ">u2" if largest > 255 else "u1")
    (tmp_path / "a.ppm").write_bytes(b"P6\n8 6\n%d\n" % largest + values.tobytes())
    with pytest.raises(InputError, match=rf"a\.ppm: cannot be read as a picture: the largest value .* is {largest},"):
        images.read(tmp_path / "a.ppm")


def test_a_kind_of_pixels_that_mitsuba_does_not_decode_is_named(tmp_path: Path):
    """The line was Mitsuba's, as "read_jpeg(): Unsupported number of components!"; BMP files of 16 bits were taken for grey and alpha."""
    colours = Image.fromarray(np.full((6, 8, 3), 188, np.uint8))
    bmp = struct.pack("<2sIHHIIiiHHIIiiII", b"BM", 150, 0, 0, 54, 40, 8, 6, 1, 16, 0, 96, 0, 0, 0, 0) + bytes(96)
    (tmp_path / "words.bmp").write_bytes(bmp)
    for name, mode, what in (
        ("a.jpg", "CMYK", "its colours are CMYK"),
        ("a.bmp", "1", "its bit depth is 1"),
        ("words.bmp", "", "its bit depth is 16"),
        ("a.tga", "P", "its colours are indexed"),
        ("b.tga", "LA", "its bit depth is 16"),
    ):
        if mode:
            colours.convert(mode).save(tmp_path / name)
        with pytest.raises(InputError, match=f"{what}, which Mitsuba does not decode; save it as .png in RGB"):
            images.read(tmp_path / name)
    for name, mode in (("a.tga", "L"), ("b.tga", "RGBA"), ("a.bmp", "RGBA"), ("a.jpg", "L")):
        colours.convert(mode).save(tmp_path / name)
        np.testing.assert_allclose(images.read(tmp_path / name, linearise=False).values, 188 / 255, atol=0.01)


def test_refuses_indexed_colours_that_mitsuba_takes_for_grey(tmp_path: Path):
    colours = np.random.default_rng(0).integers(0, 256, (6, 8, 3)).astype(np.uint8)
    Image.fromarray(colours).quantize(16).save(tmp_path / "a.bmp")
    with pytest.raises(InputError, match=r"a\.bmp: cannot be read as a picture: its colours are indexed"):
        images.read(tmp_path / "a.bmp")
    Image.fromarray(colours[..., 0]).save(tmp_path / "grey.bmp")
    grey = images.read(tmp_path / "grey.bmp", linearise=False).values
    np.testing.assert_allclose(grey, colours[..., :1] / 255, atol=1e-6)


def test_refuses_what_is_no_picture(tmp_path: Path):
    for name in ("a.png", "a.jpg", "a.exr", "a.hdr", "a.npy"):
        (tmp_path / name).write_bytes(b"this is not a picture at all")
        with pytest.raises(InputError, match=rf"{name}: .*(cannot be read|not a readable)") as caught:
            images.read(tmp_path / name)
        assert "\n" not in str(caught.value)


def test_refuses_a_file_cut_short(tmp_path: Path):
    whole = bitmap(np.zeros((64, 64, 3), np.uint8), tmp_path / "whole.png").read_bytes()
    (tmp_path / "half.png").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(InputError, match=r"half\.png: cannot be read"):
        images.read(tmp_path / "half.png")


def test_never_unpickles(tmp_path: Path):
    np.save(tmp_path / "a.npy", np.array([{"x": 1}], dtype=object), allow_pickle=True)
    with pytest.raises(InputError, match=r"a\.npy: expected real numbers, got object"):
        images.read(tmp_path / "a.npy")


def test_refuses_folders_and_unknown_endings(tmp_path: Path):
    (tmp_path / "a.gif").write_bytes(b"GIF89a")
    with pytest.raises(InputError, match=r"a\.gif: unknown kind of picture, expected one of \.exr"):
        images.read(tmp_path / "a.gif")
    with pytest.raises(InputError, match="not a file"):
        images.read(tmp_path)


def test_names_the_first_pixel_that_is_not_finite(tmp_path: Path):
    broken = COLOURS.copy()
    broken[4, 5] = np.inf
    with pytest.raises(InputError, match=r"a\.exr: 1 pixel is NaN or infinite, the first in row 4, column 5"):
        images.read(bitmap(broken, tmp_path / "a.exr"))


# ------------------------------------------------------------------ pictures as initial values


def test_scales_a_picture_to_the_parameter(tmp_path: Path):
    ramp = np.broadcast_to(np.linspace(0, 1, 32, dtype=np.float32)[:, None, None], (32, 32, 3))
    filled, notice = values.fill(bitmap(np.array(ramp), tmp_path / "a.exr"), (8, 4, 3))
    assert notice == "a.exr: scaled from 32x32 to 4x8"
    assert filled.shape == (8, 4, 3)
    np.testing.assert_allclose(filled[1:-1, 0, 0], ((np.arange(8) + 0.5) / 8)[1:-1], atol=0.02)
    assert filled.mean() == pytest.approx(0.5, abs=1e-3)


def test_fits_channels(tmp_path: Path):
    path = bitmap(COLOURS, tmp_path / "a.exr")
    grey, notice = values.fill(path, (6, 8, 1))
    assert notice == "a.exr: reduced to its luminance"
    np.testing.assert_allclose(grey[..., 0], COLOURS @ [0.212671, 0.71516, 0.072169], rtol=1e-5)
    four, _ = values.fill(path, (6, 8, 4))
    np.testing.assert_array_equal(four[..., :3], COLOURS)
    np.testing.assert_array_equal(four[..., 3], 1)
    three, _ = values.fill(bitmap(COLOURS[..., :1], tmp_path / "g.exr"), (6, 8, 3))
    np.testing.assert_array_equal(three, np.repeat(COLOURS[..., :1], 3, axis=2))


def test_npy_fills_any_shape(tmp_path: Path):
    np.save(tmp_path / "a.npy", np.arange(24.0).reshape(2, 3, 4, 1))
    assert values.fill(tmp_path / "a.npy", (2, 3, 4, 1))[0].shape == (2, 3, 4, 1)
    with pytest.raises(InputError, match=r"a\.npy: expected .* got an array of shape \(2, 3, 4, 1\)"):
        values.fill(tmp_path / "a.npy", (2, 3, 5, 1))


def test_arrays_of_vertices_and_grey_arrays_fill_like_their_files(tmp_path: Path):
    points, grey = np.arange(12.0).reshape(4, 3), np.arange(6.0).reshape(2, 3)
    for array, shape in ((points, (12,)), (points[:1], (3,)), (grey, (2, 3, 1))):
        np.save(tmp_path / "a.npy", array)
        for given in (array, tmp_path / "a.npy"):
            np.testing.assert_array_equal(values.fill(given, shape)[0], array.reshape(shape))


def test_transposed_vertices_are_refused(tmp_path: Path):
    np.save(tmp_path / "a.npy", np.arange(12.0).reshape(3, 4))
    for given in (np.arange(12.0).reshape(3, 4), tmp_path / "a.npy"):
        with pytest.raises(InputError, match=r"got an array of shape \(3, 4\)"):
            values.fill(given, (12,))


@pytest.mark.parametrize("kind", [np.int64, np.int32, np.uint32, np.int8])
def test_integers_of_unknown_encoding_are_no_picture(kind: type):
    with pytest.raises(InputError, match=r"expected uint8 or uint16 \(sRGB\) or floating-point numbers"):
        images.read(np.full((2, 2, 3), 100, kind))
    np.testing.assert_array_equal(images.read(np.eye(3, dtype=kind)).values[..., 0], np.eye(3))


def test_rows_of_different_lengths_are_no_picture():
    with pytest.raises(InputError, match=r"^expected a file or an array of numbers, got rows of different lengths$"):
        images.read([[1, 2], [3]])


def test_a_picture_cannot_fill_a_volume(tmp_path: Path):
    with pytest.raises(InputError, match=r"a picture cannot fill a parameter of shape \(3,\)"):
        values.fill(bitmap(COLOURS, tmp_path / "a.exr"), (3,))


def test_alpha_that_is_left_out_is_told(tmp_path: Path):
    """Of files of integers, whose alpha is straight, so that what is under it counts; of an opaque one there is nothing to tell."""
    pixels = np.full((6, 8, 4), 188, np.uint8)
    Image.fromarray(pixels).save(tmp_path / "a.png")
    assert images.read(tmp_path / "a.png").notice == "a.png: 8-bit sRGB, linearised, its alpha left out"
    pixels[..., 3] = 255
    Image.fromarray(pixels).save(tmp_path / "a.png")
    assert images.read(tmp_path / "a.png").notice == "a.png: 8-bit sRGB, linearised"
