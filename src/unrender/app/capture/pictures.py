"""Reading of photographs as linear values, and of masks. Pixels are rotated only if the camera requires it."""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image

from unrender.app.capture.cameras import Lens, opencv
from unrender.core.errors import InputError, prefixed
from unrender.core.text import printable, reason_of
from unrender.io import bounded_files, image_size, images, tiff_header

SRGB, LINEAR, FIT = "srgb", "linear", "fit"

_PILLOW_KINDS = {
    "JPEG": ("JPEG", "MPO"),
    "PNG": ("PNG",),
    "WEBP": ("WEBP",),
    "BMP": ("BMP",),
    "PPM": ("PPM",),
    "TGA": ("TGA",),
}
"""{kind of file: Pillow's name of the format} for files that Pillow decodes. Other Pillow plugins are not used."""
_PILLOW_MODES = ("1", "L", "LA", "La", "P", "PA", "RGB", "RGBA", "RGBX", "RGBa", "CMYK", "YCbCr")
"""Pillow modes of at most 8 bits per channel. Pillow clips others."""
_QUARTER_TURNS = {6: 3, 8: 1, 5: 3, 7: 1}
_TURNS = {1: 0, 3: 2, **_QUARTER_TURNS}
"""{EXIF orientation: counter-clockwise quarter turns}; orientations 2, 4, 5 and 7 are also mirrored."""
_MIRRORED = (2, 4, 5, 7)
_PROFILE, _EXIF, _EXPOSURE = 0x8773, 0x8769, (0x829A, 0x829D, 0x8827)
"""TIFF's colour profile, EXIF's table of the camera's settings, and its exposure time, f-number and speed (ISO)."""
_LEAST_RATIO = 1.05
"""Least ratio of two exposures that is told: a twelfth of a stop."""
_LONGEST_SIDE = 1 << 15  # exclusive limit of a side in pixels, set by OpenCV's `remap`
_RAW = (".cr2", ".cr3", ".nef", ".arw", ".dng", ".raf", ".orf", ".rw2", ".heic", ".heif")


@dataclass(frozen=True)
class Pixels:
    """A photograph.

    Attributes:
        values: (H, W, 3) float32, linear.
        alpha: (H, W) float32 in [0, 1]; None if the file has none, or if it is 1 everywhere.
        premultiplied: whether `values` are multiplied with `alpha`.
    """

    values: np.ndarray
    alpha: np.ndarray | None
    premultiplied: bool = False


def _stored_size(path: Path) -> tuple[int, int, int]:
    """Return width, height and EXIF's orientation (1 if absent) from a file's header. Raises `InputError` for no picture or one that is too
    large."""
    if path.suffix.lower() in _RAW:
        raise InputError(f"{path}: camera raw files are not read; develop them to .exr (linear), .png or .tif (sRGB)")
    if bounded_files.kind(path) != "file":
        raise InputError(f"{path}: {bounded_files.no_file(path)}")
    header = _header(path)
    if header.kind in _PILLOW_KINDS:
        with _opened(path, header) as picture:
            if picture.format == "PNG":
                with _errors_of_pillow(path):
                    picture.load()  # EXIF may follow the pixels
            return picture.width, picture.height, images.orientation(images.exif_of(picture))
    if header.kind == "TIFF":
        width, height, _ = header.sizes[0]
        return width, height, header.orientation
    height, width = _by_mitsuba(path).values.shape[:2]
    return width, height, 1


def notices(files: Sequence[Path], exposed: bool, response: str = SRGB) -> list[str]:
    """Return a line if colours of some photographs are not sRGB, if some are decoded as sRGB and declare another gamma, and, unless their
    exposures are unknowns (`exposed`), if these differ by EXIF."""
    others, declared, gamma, exposures = list[str](), list[str](), 0.0, list[float]()
    for path in files:
        with _tags(path) as (exif, profile, of_file):
            others += [] if images.is_srgb(profile, exif) else [printable(path.name)]
            if response == SRGB and of_file:
                declared, gamma = [*declared, printable(path.name)], gamma or of_file
            with suppress(Exception):  # EXIF data is often missing or malformed
                settings = exif.get_ifd(_EXIF)
                time, aperture, speed = (float(settings[tag]) for tag in _EXPOSURE)
                exposures += [value] if 0 < (value := time * speed / aperture**2) < math.inf else []
    lines, ratio = list[str](), max(exposures, default=1.0) / min(exposures, default=1.0)
    for names, what in (
        (others, "a colour profile that is not sRGB is ignored; convert to sRGB"),
        (
            declared,
            f"a gamma of {gamma:.3g} is declared, that of sRGB is 0.455; give --response {1 / (gamma or 1):.3g}",
        ),
    ):
        if names:
            lines.append(f"{names[0]}{f' and {len(names) - 1} more' * (len(names) > 1)}: {what}")
    if ratio > _LEAST_RATIO and not exposed:
        lines.append(
            f"exposures differ by a factor of {ratio:.3g} by EXIF: list exposure among --unknowns to recover them"
        )
    return lines


@contextmanager
def _tags(path: Path) -> Iterator[tuple[Image.Exif, bytes | None, float]]:
    """Yield a file's EXIF data, its colour profile, and its gamma if that is not sRGB's. Pillow opens no TIFF files of 16 bits in RGB."""
    if (header := _header(path)).kind in _PILLOW_KINDS:
        with _opened(path, header) as picture:
            yield images.exif_of(picture), picture.info.get("icc_profile"), images.other_gamma(picture)
        return
    with bounded_files.open_regular(path) as file:
        exif = Image.Exif()
        with suppress(Exception):
            if header.kind == "TIFF":
                exif.load_from_fp(file)
        yield exif, exif.get(_PROFILE), 0.0


def read(path: Path, orientation: int = 1, response: str = SRGB) -> Pixels:
    """Read a photograph of an EXIF orientation. Integers of 8 and 16 bits are decoded by `response`, floating-point numbers are linear;
    CMYK becomes RGB. Raises `InputError` if the file cannot be read completely."""
    array = _decode(path)
    if array is None:
        picture = _by_mitsuba(path)
        alpha = None if picture.alpha is None else _turn(picture.alpha, orientation)
        return Pixels(_turn(picture.values, orientation), alpha, picture.premultiplied)
    array = _turn(array, orientation)
    largest = np.iinfo(array.dtype).max
    curve = decode(np.arange(largest + 1) / largest, response).astype(np.float32)
    alpha = array[..., 3].astype(np.float32) / largest if array.shape[2] == 4 else None
    return Pixels(curve[array[..., :3]], None if alpha is None or alpha.min() >= 1 else alpha)


def read_mask(path: Path, orientation: int = 1) -> np.ndarray:
    """Read a mask, (H, W) float32 in [0, 1]: alpha if it is present and not 1 everywhere, else the mean of the stored channels."""
    _stored_size(path)
    array = _decode(path)
    if array is not None:
        array = _turn(array, orientation)
        values = array.astype(np.float32) / np.iinfo(array.dtype).max
        if values.shape[2] == 4 and values[..., 3].min() < 1:
            return values[..., 3]
        return values[..., :3].mean(2)
    picture = images.read(path, linearise=False)
    return (
        np.clip(_turn(picture.values, orientation).mean(2), 0, 1)
        if picture.alpha is None
        else _turn(picture.alpha, orientation)
    )


def upright(path: Path, lens: Lens | None) -> tuple[int, int, int]:
    """Return width, height and orientation with which a photograph has the lens's aspect ratio.

    Some programs calibrate cameras on pixels as they are stored, others on those that EXIF's orientation turns. Raises `InputError` if
    neither has the lens's aspect ratio, or both.
    """
    width, height, orientation = _stored_size(path)
    sides = (height, width) if orientation in _QUARTER_TURNS else (width, height)
    stored, turned = (lens is None or _proportional(*of, lens) for of in ((width, height), sides))
    if 2 <= orientation <= 8 and turned:
        if not stored:
            return *sides, orientation
        raise InputError(
            f"{path}: its EXIF orientation is {orientation}, and nothing tells whether its camera was calibrated on the stored or the "
            "turned pixels; remove the orientation for the stored ones, or save the turned ones without it"
        )
    if stored or lens is None:
        return width, height, 1
    raise InputError(
        f"{path}: {width} x {height} pixels, but its camera has {lens.width} x {lens.height}: expected the same aspect ratio"
    )


def _proportional(width: int, height: int, lens: Lens) -> bool:
    """Return whether the aspect ratio equals the lens's within half a pixel along the shorter side."""
    x, y = width / lens.width, height / lens.height
    return abs(x - y) * min(lens.width, lens.height) <= 1.0 + 1e-6 and abs(x / y - 1) < 0.02


def _turn(values: np.ndarray, orientation: int) -> np.ndarray:
    turned = np.rot90(values, _TURNS.get(orientation, 2 if orientation == 4 else 0))
    return np.ascontiguousarray(turned[:, ::-1] if orientation in _MIRRORED else turned)


def _decode(path: Path) -> np.ndarray | None:
    """Return the pixels as stored, uint8 or uint16; None for kinds that Mitsuba reads."""
    header = _header(path)
    if header.kind == "TIFF" or (header.kind == "PNG" and header.bits == 16):  # Pillow would truncate 16 bits to 8
        return _decode_opencv(path, header)
    return _decode_pillow(path, header) if header.kind in _PILLOW_KINDS else None


def _header(path: Path) -> image_size.Header:
    with prefixed(path):
        header = image_size.read_photograph_header(path)
    width, height, _ = header.sizes[0]
    _check_size(path, width, height)
    return header


@contextmanager
def _opened(path: Path, header: image_size.Header) -> Iterator[Image.Image]:
    """Open a file by Pillow, by the plugin of the kind that its header has and by no other. Pillow's errors become `InputError`."""
    with warnings.catch_warnings(), ExitStack() as stack:
        warnings.simplefilter("ignore")  # Pillow's size limit equals ours, and malformed EXIF is handled
        with _errors_of_pillow(path):
            file = stack.enter_context(bounded_files.open_regular(path))
            picture = stack.enter_context(Image.open(file, formats=_PILLOW_KINDS[header.kind]))
        if (picture.width, picture.height) != header.sizes[0][:2]:
            raise InputError(f"{path}: cannot be read as a picture: its header declares two sizes")
        yield picture


@contextmanager
def _errors_of_pillow(path: Path) -> Iterator[None]:
    try:
        yield
    except (InputError, MemoryError):
        raise
    except Exception as error:  # Pillow raises many types of exceptions
        raise InputError(f"{path}: cannot be read as a picture: {reason_of(error, 200)}") from error


def _decode_pillow(path: Path, header: image_size.Header) -> np.ndarray:
    """Return (H, W, 3 or 4) uint8."""
    with _opened(path, header) as picture:
        if picture.mode not in _PILLOW_MODES:
            raise InputError(f"{path}: {picture.mode} pixels, expected 8 bits a channel; save it as .png, .tif or .exr")
        transparent = picture.mode in ("RGBA", "LA", "PA") or "transparency" in picture.info
        with _errors_of_pillow(path):
            return np.array(picture.convert("RGBA" if transparent else "RGB"))


def _decode_opencv(path: Path, header: image_size.Header) -> np.ndarray:
    """Return (H, W, 3 or 4) uint8 or uint16, RGB. The file must be TIFF or PNG: OpenCV chooses a decoder by the first bytes."""
    cv2 = opencv()
    data = bounded_files.read_bytes(path, 4 * image_size.MOST_VALUES)
    if header.kind == "TIFF":
        data = tiff_header.without_orientation(data)
    flags = cv2.IMREAD_UNCHANGED | cv2.IMREAD_IGNORE_ORIENTATION
    try:
        array = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except (cv2.error, MemoryError) as error:
        raise InputError(f"{path}: cannot be read as a picture: {reason_of(error, 200)}") from error
    if array is None or array.shape[:2] != (header.sizes[0][1], header.sizes[0][0]):
        raise InputError(f"{path}: cannot be read as a picture: its pixels are not as its header declares")
    if array.dtype not in (np.uint8, np.uint16):
        raise InputError(f"{path}: expected 8 or 16 bits a channel, got {array.dtype}")
    if array.ndim == 2 or array.shape[2] == 1:
        return np.repeat(array.reshape(*array.shape[:2], 1), 3, 2)
    if array.shape[2] > 4:
        raise InputError(f"{path}: {array.shape[2]} channels, expected at most 4")
    return array[..., [2, 1, 0, 3][: array.shape[2]]]


def _by_mitsuba(path: Path) -> Pixels:
    picture = images.read(path)
    values = picture.values
    _check_size(path, values.shape[1], values.shape[0])
    return Pixels(np.repeat(values, 3, 2) if values.shape[2] == 1 else values, picture.alpha, picture.premultiplied)


def _check_size(path: Path, width: int, height: int) -> None:
    if width * height * 3 > image_size.MOST_VALUES or max(width, height) >= _LONGEST_SIDE:
        most = image_size.MOST_VALUES // 3_000_000
        limits = f"at most {most} megapixels and less than {_LONGEST_SIDE} pixels a side"
        raise InputError(f"{path}: {width} x {height} pixels, expected {limits}")


_LEAST, _MOST = 1.0, 4.0  # Range of exponents. Those of cameras and screens are between 1 and 2.6.


def check_response(response: str) -> str:
    """Return a response unchanged. Raise `InputError` if it is neither a name nor an exponent from 1 to 4."""
    if not isinstance(response, str) or response not in (SRGB, LINEAR, FIT):
        _exponent(response)
    return response


def decode(levels: np.ndarray, response: str) -> np.ndarray:
    """Decode levels in [0, 1], of any shape, to linear values by a response. The curve is increasing and maps 0 and 1 to themselves.

    "srgb" and "fit" select the sRGB curve, a number γ the power levels ** γ, and "linear" the identity.
    """
    if response in (SRGB, FIT):
        return images.srgb_to_linear(levels)
    return levels if response == LINEAR else levels ** _exponent(response)


def _exponent(text: str) -> float:
    names = f"{SRGB}, {LINEAR}, {FIT} or an exponent from {_LEAST:g} to {_MOST:g}, such as 2.2"
    expected = f"--response {printable(text)}: expected {names}"
    if not isinstance(text, str):
        raise InputError(expected)
    try:
        exponent = float(text)
    except ValueError as error:
        raise InputError(expected) from error
    if not math.isfinite(exponent) or not _LEAST <= exponent <= _MOST:
        raise InputError(expected)
    return exponent
