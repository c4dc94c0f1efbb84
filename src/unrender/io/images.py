"""Reading of images: files and arrays become linear float32 arrays, or a one-line error. Writing of pictures."""

from __future__ import annotations

import contextlib
import io
import re
import warnings
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from unrender.backend import variant
from unrender.core import checks
from unrender.core.errors import InputError
from unrender.core.text import reason_of
from unrender.io import bounded_files, image_size

READABLE = (".exr", ".hdr", ".rgbe", ".pfm", ".png", ".jpg", ".jpeg", ".bmp", ".tga", ".ppm", ".npy")
"""File name extensions that `read` supports."""

_ORIENTATION, _INTEROPERABILITY = 0x0112, 0xA005
_GAMMA = 2.2
_MOST_LEVELS = 8
"""Largest difference from sRGB of a colour profile that counts as sRGB, of 255 levels: 3 for an exponent of 2.2, 19 for 1.8."""
OPAQUE = 0.999
"""Least alpha that counts as 1."""
_COUNTED = "only its opaque pixels count"


@dataclass(frozen=True)
class Picture:
    """An image.

    Attributes:
        values: (H, W, C) float32, C in {1, 3}; linear unless read with `linearise=False`.
        notice: one line about the conversion of the values, "" for none.
        alpha: (H, W) float32 in [0, 1]; None if it is 1 everywhere, or if it was not requested for integer values.
        labelled_xyz: whether the file names its channels X, Y and Z. The values are RGB in any case.
        premultiplied: whether the values are multiplied with `alpha`, as in floating-point files.
    """

    values: np.ndarray
    notice: str = ""
    alpha: np.ndarray | None = None
    labelled_xyz: bool = False
    premultiplied: bool = False


def read(source: Any, linearise: bool = True, alpha: bool = False, channels: tuple[int, ...] = (1, 3, 4)) -> Picture:
    """Read an image from a file or an array.

    Args:
        source: a file (`READABLE`), a `mitsuba.Bitmap`, or an array (H, W), (H, W, 1), (H, W, 3) or (H, W, 4). Floating-point values are
            linear. Unsigned integers of 8 and 16 bits are sRGB, and their range is mapped to [0, 1]. Other integers and booleans must be 0
            or 1, as in masks.
        linearise: whether to convert 8- and 16-bit values from sRGB; False for masks.
        alpha: whether to return the alpha of 8- and 16-bit values.
        channels: numbers of channels that arrays may have; the second of 2 channels is alpha.

    Raises:
        InputError: the file is missing or unreadable, or the values have an unsupported type or shape, or are not finite.
    """
    if isinstance(source, (str, Path)):
        path = Path(source)
        if bounded_files.kind(path) != "file":
            raise InputError(f"{path}: {bounded_files.no_file(path)}")
        if path.suffix.lower() not in READABLE:
            raise InputError(f"{path}: unknown kind of picture, expected one of {', '.join(READABLE)}")
        try:
            numpy_file = path.suffix.lower() == ".npy"
            if numpy_file:
                picture = _from_array(bounded_files.read_array(path), linearise, alpha, channels)
            else:
                picture = _read(path, linearise, alpha)
            refuse_pixels(~np.isfinite(picture.values), "NaN or infinite")
        except InputError as error:
            raise InputError(f"{path}: {str(error).removeprefix(f'{path}: ')}") from error
        return replace(picture, notice=f"{path.name}: {picture.notice}" if picture.notice else "")
    source = checks.array_like(source, "fill it, and give mask = ~numpy.ma.getmaskarray(image)[..., 0] to the view")
    array = checks.as_array(source, "", "a file or an array of numbers")
    if is_bitmap(source) and array.dtype in (np.uint8, np.uint16, np.float16, np.float32, np.float64):
        picture = _of_bitmap(type(source)(source), linearise, alpha)
    else:
        picture = _from_array(array, linearise, alpha, channels)
    refuse_pixels(~np.isfinite(picture.values), "NaN or infinite")
    return picture


def is_bitmap(source: Any) -> bool:
    """Return whether a source is a `mitsuba.Bitmap`, which knows its colour space."""
    return type(source).__name__ == "Bitmap" and type(source).__module__.startswith("mitsuba")


def check_metadata(source: Any, linearised: bool = False) -> str:
    """Return one line about a JPEG or PNG file's colour profile if it is not sRGB; "" for none, and for other sources.

    Mitsuba ignores profiles and EXIF. `source` is one that `read` has read, so that its size is within the limits.

    Raises `InputError` for a file whose EXIF orientation turns or mirrors its pixels, and for one that was `linearised` from sRGB but
    declares another gamma.
    """
    faults, profile = metadata(source, linearised)
    if faults:
        raise InputError(f"{source}: {faults[0]}")
    return f"{Path(source).name}: {profile}" if profile else ""


def metadata(source: Any, linearised: bool) -> tuple[list[str], str]:
    """Return what `check_metadata` refuses, and its line about the colour profile, both without the file's name."""
    if not isinstance(source, (str, Path)) or Path(source).suffix.lower() not in (".jpg", ".jpeg", ".png"):
        return [], ""
    path = Path(source)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            with bounded_files.open_regular(path) as file, Image.open(file, formats=["JPEG", "PNG"]) as picture:
                # Pillow decodes the pixels of a PNG file before it looks for EXIF, which may follow them.
                exif = exif_of(picture) if picture.format != "PNG" or _has_exif(path) else Image.Exif()
                srgb, turned = is_srgb(picture.info.get("icc_profile"), exif), orientation(exif)
                gamma = other_gamma(picture)
    except Exception:  # Pillow raises many types of exceptions, and Mitsuba has read the pixels
        return [], ""
    faults = list[str]()
    if turned != 1:
        faults.append(
            f"its EXIF orientation is {turned}, which viewers apply and Mitsuba ignores; save the pixels upright, without it"
        )
    if linearised and gamma:
        faults.append(
            f"it declares a gamma of {gamma:.3g}, that of sRGB is 0.455; convert it to sRGB, or to floating-point .exr"
        )
    return faults, "" if srgb else "its colour profile is not sRGB and is ignored; convert the file to sRGB"


def other_gamma(picture: Image.Image) -> float:
    """Return the gamma that a PNG file declares without a colour profile, 0 for none and for that of sRGB within 5 %."""
    gamma = 0.0 if {"srgb", "icc_profile"} & picture.info.keys() else picture.info.get("gamma", 0.0)
    return gamma if abs(_GAMMA * gamma - 1) > 0.05 else 0.0


def is_srgb(profile: bytes | None, exif: Image.Exif) -> bool:
    """Return whether the colours of a file are sRGB by its profile, or else by EXIF, where R03 is Adobe RGB.

    Names of profiles do not tell: some of sRGB have others, and "sRGB" is also in those of linear values and of other primaries.
    """
    if profile:
        with contextlib.suppress(Exception):  # a malformed profile, or one of printers
            return _is_srgb_profile(profile)
        return False
    with contextlib.suppress(Exception):  # EXIF data is often malformed, and Pillow raises many types of exceptions
        return exif.get_ifd(_INTEROPERABILITY).get(1) != "R03"
    return True


def exif_of(picture: Image.Image) -> Image.Exif:
    """Return EXIF data, empty if they are malformed: Pillow raises many types of exceptions."""
    with contextlib.suppress(Exception):
        return picture.getexif()
    return Image.Exif()


def _is_srgb_profile(profile: bytes) -> bool:
    from PIL import ImageCms

    own: Any = ImageCms.ImageCmsProfile(io.BytesIO(profile))
    levels = np.stack(np.meshgrid(*3 * [np.linspace(0, 255, 6, dtype=np.uint8)]), -1).reshape(36, 6, 3)
    colours = Image.fromarray(levels).convert({"RGB": "RGB", "GRAY": "L"}[own.profile.xcolor_space.strip()])
    intent = ImageCms.Intent.RELATIVE_COLORIMETRIC
    shown: Any = ImageCms.profileToProfile(colours, own, ImageCms.createProfile("sRGB"), intent, "RGB")
    return np.abs(np.array(shown, np.int16) - np.array(colours.convert("RGB"))).max() <= _MOST_LEVELS


def _has_exif(path: Path) -> bool:
    """Return whether a PNG file may have what Pillow's `getexif` reads."""
    with bounded_files.open_regular(path) as file:
        return re.search(rb"eXIf|Raw profile type|adobe\.xmp", file.read()) is not None


def orientation(exif: Image.Exif) -> int:
    """Return EXIF's orientation, 1 if it is absent or unreadable."""
    value = exif.get(_ORIENTATION, 1)
    return value if isinstance(value, int) else 1


def write(picture: Any, path: Path, half: bool = False) -> None:
    """Write a picture in the format of the file name extension.

    Args:
        picture: linear (H, W) or (H, W, C) with C of 1, 3 or 4, written as float32; or a `mitsuba.Bitmap`, written as it is.
        half: whether to write 16 bits, for OpenEXR.

    Raises:
        InputError: an array has another number of channels.
    """
    import mitsuba as mi

    if not isinstance(picture, mi.Bitmap):
        values = np.ascontiguousarray(picture if picture.ndim == 3 else picture[..., None], np.float32)
        if values.ndim != 3 or values.shape[2] not in (1, 3, 4):
            raise InputError(f"no picture has {picture.shape[-1]} channels; expected 1, 3 or 4")
        picture = mi.Bitmap(values)
    with variant.two_threads(path):
        if half:
            picture = picture.convert(picture.pixel_format(), mi.Struct.Type.Float16, False)
        picture.write(str(path))


def resize(values: np.ndarray, height: int, width: int, around: bool = False) -> np.ndarray:
    """Resize an image (H, W, C) to (height, width, C), with smoothing before reduction and linear interpolation for enlargement; `around`
    an environment map, whose left and right borders are neighbours."""
    if values.shape[:2] == (height, width):
        return values
    if around:
        return np.ascontiguousarray(resize(np.tile(values, (1, 3, 1)), height, 3 * width)[:, width : 2 * width])
    from skimage import transform

    scaled = transform.resize(values, (height, width, values.shape[2]), order=1, anti_aliasing=True, mode="edge")
    return np.asarray(scaled, np.float32)


def srgb_to_linear(values: np.ndarray) -> np.ndarray:
    """Apply the inverse sRGB transfer function (IEC 61966-2-1) to values in [0, 1]."""
    return np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)


def luminance(values: np.ndarray) -> np.ndarray:
    """Convert linear sRGB (..., 3) to luminance (..., 1), by the weights of ITU-R BT.709."""
    return (values @ np.array([0.212671, 0.715160, 0.072169], np.float32))[..., None]


def xyz_to_rgb(values: np.ndarray) -> np.ndarray:
    """Convert CIE XYZ (..., 3) to linear sRGB, by Mitsuba's matrix."""
    matrix = [[3.240479, -1.537150, -0.498535], [-0.969256, 1.875991, 0.041556], [0.055648, -0.204043, 1.057311]]
    return values @ np.array(matrix, np.float32).T


def _read(path: Path, linearise: bool, alpha: bool) -> Picture:
    image_size.check(path)
    variant.ensure()
    import mitsuba as mi

    try:
        with variant.two_threads(path):
            bitmap = mi.Bitmap(str(path))
        return _of_bitmap(bitmap, linearise, alpha)
    except InputError:
        raise
    except Exception as error:  # Mitsuba's image libraries may raise anything
        raise InputError(f"cannot be read as a picture: {reason_of(error, 300)}") from error


def _of_bitmap(bitmap: Any, linearise: bool, alpha: bool) -> Picture:
    """Return the picture of a `mitsuba.Bitmap`, whose gamma is changed."""
    import mitsuba as mi

    names = [field.name for field in bitmap.struct_()]
    if bitmap.pixel_format() == mi.Bitmap.PixelFormat.MultiChannel or not {*names} <= {*"RGBAXYZ"}:
        return _colour_channels(np.array(bitmap), names)
    encoded = bool(bitmap.srgb_gamma())
    stored = np.array(bitmap)
    bits = 8 * stored.itemsize
    linearised = encoded and linearise
    opaqueness = _coverage(stored[..., -1]) if bitmap.has_alpha() else np.ones(1, np.float32)
    transparent = encoded and opaqueness.min() < 1
    single = bitmap.pixel_format() in (mi.Bitmap.PixelFormat.Y, mi.Bitmap.PixelFormat.YA)
    kind = mi.Bitmap.PixelFormat.Y if single else mi.Bitmap.PixelFormat.RGB
    if encoded and not linearise:
        bitmap.set_srgb_gamma(False)
    values = np.array(bitmap.convert(kind, mi.Struct.Type.Float32, False))
    values = values.reshape(*values.shape[:2], -1)
    coverage = opaqueness if transparent and alpha else None
    if not linearised:
        labelled = bitmap.pixel_format() in (mi.Bitmap.PixelFormat.XYZ, mi.Bitmap.PixelFormat.XYZA)
        opacity = None if encoded else _opacity(opaqueness)
        return Picture(values, "", coverage if encoded else opacity, labelled, opacity is not None)
    note = f", {'its alpha left out' if coverage is None else _COUNTED}" if transparent else ""
    return Picture(values, f"{bits}-bit sRGB, linearised{note}", coverage)


def _coverage(stored: np.ndarray) -> np.ndarray:
    return (stored / np.float32(np.iinfo(stored.dtype).max if stored.dtype in (np.uint8, np.uint16) else 1)).astype(
        np.float32
    )


def _opacity(alpha: np.ndarray) -> np.ndarray | None:
    """Return floating-point alpha in [0, 1]; None if it is 1 everywhere up to the rounding of a film's filter."""
    values = np.clip(np.nan_to_num(alpha.astype(np.float32)), 0, 1)
    return values if values.min() < OPAQUE else None


def _colour_channels(stored: np.ndarray, names: list[str]) -> Picture:
    """Return R, G, B and A of an EXR file of named channels, such as those of Mitsuba's `aov` integrator."""
    if not {"R", "G", "B"} <= set(names):
        raise InputError(
            f"has the channels {', '.join(names)[:200]}, but not R, G and B; save colour alone, such as mi.Bitmap(image[:, :, :3])"
        )
    opacity = _opacity(stored[..., names.index("A")]) if "A" in names else None
    values = stored[..., [names.index(name) for name in "RGB"]].astype(np.float32)
    return Picture(values, alpha=opacity, premultiplied=opacity is not None)


def _from_array(array: np.ndarray, linearise: bool, alpha: bool, channels: tuple[int, ...]) -> Picture:
    if array.dtype == object or not (np.issubdtype(array.dtype, np.number) or array.dtype == bool):
        raise InputError(f"expected an array of numbers, got {array.dtype}")
    if np.iscomplexobj(array):
        raise InputError("expected an array of real numbers, got complex ones")
    if array.ndim == 2:
        array = array[..., None]
    if array.ndim != 3 or array.shape[2] not in channels or 0 in array.shape:
        kind = "(H, W) or (H, W, 1)" if 3 not in channels else "(H, W, 3)"
        if {1, 3} <= {*channels}:
            kind += " with red, green and blue, or (H, W) with one value per pixel"
        raise InputError(f"expected an array of shape {kind}, got {array.shape}")
    values = array[..., : 1 if array.shape[2] == 2 else 3]
    if array.dtype in (np.uint8, np.uint16):
        bits = 8 * array.dtype.itemsize
        values = values.astype(np.float64) / (2**bits - 1)
        transparent = array.shape[2] in (2, 4) and bool((array[..., -1] < 2**bits - 1).any())
        coverage = _coverage(array[..., -1]) if alpha and transparent else None
        if not linearise:
            return Picture(values.astype(np.float32), alpha=coverage)
        note = f", {_COUNTED}" if coverage is not None else ""
        return Picture(srgb_to_linear(values).astype(np.float32), f"{bits}-bit sRGB, linearised{note}", coverage)
    if array.dtype.kind in "iu" and not ((values == 0) | (values == 1)).all():
        raise InputError(
            f"expected uint8 or uint16 (sRGB) or floating-point numbers (linear), got {array.dtype} beyond 0 and 1"
        )
    opacity = _opacity(array[..., -1]) if array.shape[2] in (2, 4) else None
    with np.errstate(over="ignore"):
        values = np.ascontiguousarray(values, dtype=np.float32)
    return Picture(values, alpha=opacity, premultiplied=opacity is not None)


def refuse_pixels(bad: np.ndarray, fault: str, advice: str = "") -> None:
    """Raise `InputError` if channels of some pixels are bad, (H, W, C): their number, the fault, the first of them, and advice."""
    if bad.any():
        pixels = np.argwhere(bad.any(axis=-1))
        (row, column), count = pixels[0], len(pixels)
        which = f"{count} {'pixels are' if count > 1 else 'pixel is'}"
        raise InputError(f"{which} {fault}, the first in row {row}, column {column}{advice}")
