"""How large a picture file says it is, from its header alone: before a decoder takes memory for it.

A file of some hundred bytes can declare a hundred thousand pixels a side.
"""

from __future__ import annotations

import re
import struct
import warnings
from collections.abc import Callable
from pathlib import Path

from PIL import Image, UnidentifiedImageError

from unrender.core.errors import InputError

__all__ = ["MOST_VALUES", "Sizes", "check"]

MOST_VALUES = 1 << 28
"""Pixels times channels of the largest picture that is decoded: one gigabyte in single precision."""

_HEADER = 1 << 20
_EXR_MAGIC, _EXR_PARTS = b"\x76\x2f\x31\x01", 0x1000
_MOST_ATTRIBUTES = 4096


def check(path: Path) -> None:
    """Raise `InputError` where a picture declares more than `MOST_VALUES`, or its header cannot be read."""
    reader = _READERS.get(path.suffix.lower(), _by_pillow)
    try:
        sizes = reader(path)
    except InputError:
        raise
    except (struct.error, ValueError, IndexError, OSError, UnidentifiedImageError, SyntaxError) as error:
        raise InputError(f"cannot be read as a picture: its header is malformed ({type(error).__name__})") from error
    for width, height, channels in sizes:
        if width < 1 or height < 1 or width * height * max(channels, 1) > MOST_VALUES:
            what = f"{width}x{height} pixels of {channels} channels"
            raise InputError(f"declares {what}, expected at least one and at most {MOST_VALUES} values in all")


Sizes = list[tuple[int, int, int]]


def _exr(path: Path) -> Sizes:
    """Of each part: the data window's width and height, and the channels."""
    data = _start(path)
    if data[:4] != _EXR_MAGIC:
        raise InputError("cannot be read as a picture: not an OpenEXR file")
    many = struct.unpack_from("<I", data, 4)[0] & _EXR_PARTS
    at, found = 8, []
    while data[at] or not found:
        size, at = _exr_part(data, at)
        found.append(size)
        if not many:
            break
    return found


def _exr_part(data: bytes, at: int) -> tuple[tuple[int, int, int], int]:
    window, channels = None, 0
    for _ in range(_MOST_ATTRIBUTES):
        if not data[at]:
            if window is None or not channels:
                raise ValueError("no data window or no channels")
            low_x, low_y, high_x, high_y = window
            return (high_x - low_x + 1, high_y - low_y + 1, channels), at + 1
        name, at = _word(data, at)
        _, at = _word(data, at)
        (length,) = struct.unpack_from("<i", data, at)
        value, at = data[at + 4 : at + 4 + length], at + 4 + length
        if length < 0 or len(value) < length:
            raise ValueError("an attribute that is longer than the header")
        if name == b"dataWindow":
            window = struct.unpack("<4i", value)
        elif name == b"channels":
            channels = _exr_channels(value)
    raise ValueError("too many attributes")


def _exr_channels(value: bytes) -> int:
    count, at = 0, 0
    while value[at]:
        _, at = _word(value, at)
        count, at = count + 1, at + 16
    return count


def _word(data: bytes, at: int) -> tuple[bytes, int]:
    end = data.index(b"\0", at, at + 257)
    return data[at:end], end + 1


def _hdr(path: Path) -> Sizes:
    match = re.search(rb"\n\s*\n[-+][XY] +(\d{1,9}) +[-+][XY] +(\d{1,9})", _start(path))
    if match is None:
        raise ValueError("no resolution")
    return [(int(match[2]), int(match[1]), 3)]


def _pfm(path: Path) -> Sizes:
    match = re.match(rb"P([Ff])\s+(\d{1,9})\s+(\d{1,9})\s", _start(path))
    if match is None:
        raise ValueError("no resolution")
    return [(int(match[2]), int(match[3]), 3 if match[1] == b"F" else 1)]


def _by_pillow(path: Path) -> Sizes:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of sizes, which are judged here
        limit, Image.MAX_IMAGE_PIXELS = Image.MAX_IMAGE_PIXELS, None
        try:
            with Image.open(path) as image:
                return [(*image.size, len(image.getbands()))]
        finally:
            Image.MAX_IMAGE_PIXELS = limit


def _start(path: Path) -> bytes:
    with path.open("rb") as file:
        return file.read(_HEADER)


_READERS: dict[str, Callable[[Path], Sizes]] = {".exr": _exr, ".hdr": _hdr, ".rgbe": _hdr, ".pfm": _pfm}
