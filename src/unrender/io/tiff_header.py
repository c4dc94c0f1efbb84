"""Header of a TIFF file: size, bits and orientation of the first image, read without a decoder.

Format: TIFF 6.0 and BigTIFF. The header points to a directory of tags; each has a number, a type, a count and its values or their offset.
"""

from __future__ import annotations

import io
import struct
from dataclasses import dataclass
from typing import IO

from unrender.core.errors import InputError

MAGICS = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")
"""First bytes of a file."""

_WIDTH, _HEIGHT, _BITS, _COMPRESSION, _ORIENTATION, _CHANNELS, _ROWS = 256, 257, 258, 259, 274, 277, 278
_TILE_WIDTH, _TILE_HEIGHT, _FORMAT = 322, 323, 339
_TYPES = {1: "B", 3: "H", 4: "I", 16: "Q"}
_MOST_TAGS = 1000
_LONGEST_TILE = 4096
_COMPRESSIONS = {1: "none", 5: "LZW", 7: "JPEG", 8: "deflate", 32773: "PackBits", 32946: "deflate"}
_DEPTHS = (1, 8, 16)
_NO_ROWS = (1 << 32) - 1


@dataclass(frozen=True)
class TiffHeader:
    """Header of a file with one image: width, height and channels, bits per channel, and the orientation tag, 1 to 8."""

    size: tuple[int, int, int]
    bits: int
    orientation: int = 1


def read(data: bytes, file: IO[bytes]) -> TiffHeader:
    """Return the header of the first image.

    Raises:
        InputError: the compression or the type of its numbers is not on the allow-list, or its tiles are too large.
        ValueError, struct.error: the header is malformed.
    """
    tags, _ = _first_tags(data, file)
    width, height = tags[_WIDTH], tags[_HEIGHT]
    compression = tags.get(_COMPRESSION, 1)
    if compression not in _COMPRESSIONS:
        known = ", ".join(dict.fromkeys(_COMPRESSIONS.values()))
        raise InputError(f"cannot be read as a picture: TIFF compression {compression}, expected one of {known}")
    bits = tags.get(_BITS, 1)
    if bits not in _DEPTHS or tags.get(_FORMAT, 1) != 1:
        raise InputError("cannot be read as a picture; save floating-point values as .exr, not as .tif")
    tile = max(tags.get(_TILE_WIDTH, 1), tags.get(_TILE_HEIGHT, 1))
    rows = tags.get(_ROWS, _NO_ROWS)
    if tile > _LONGEST_TILE or (rows > max(height, _LONGEST_TILE) and rows != _NO_ROWS):
        raise InputError(f"cannot be read as a picture: its tiles are larger than {_LONGEST_TILE} pixels a side")
    return TiffHeader((width, height, tags.get(_CHANNELS, 1)), bits, tags.get(_ORIENTATION, 1))


def without_orientation(data: bytes) -> bytearray:
    """Return a file's bytes with orientation 1. OpenCV applies the tag even if it is set to ignore it."""
    patched = bytearray(data)
    _, places = _first_tags(data, io.BytesIO(data))
    if place := places.get(_ORIENTATION):
        order = "<" if data[:2] == b"II" else ">"
        value = struct.pack(order + "H", 1).ljust(place.stop - place.start - (12 if _is_big(data) else 8), b"\0")
        count = struct.pack(order + ("Q" if _is_big(data) else "I"), 1)
        patched[place] = struct.pack(order + "HH", _ORIENTATION, 3) + count + value
    return patched


def _is_big(data: bytes) -> bool:
    """Return whether a file is a BigTIFF, with offsets of 64 bits."""
    return 43 in (data[2], data[3])


def _first_tags(data: bytes, file: IO[bytes]) -> tuple[dict[int, int], dict[int, slice]]:
    """Return the first value of each tag of an integer type, and its entry's position. Raises `ValueError` without width or height."""
    order = "<" if data[:2] == b"II" else ">"
    big = _is_big(data)
    (start,) = struct.unpack_from(order + ("Q" if big else "I"), data, 8 if big else 4)
    file.seek(min(start, 1 << 62))
    (count,) = struct.unpack(order + ("Q" if big else "H"), file.read(8 if big else 2))
    if count > _MOST_TAGS:
        raise ValueError("too many tags")
    entry = "HHQ8s" if big else "HHI4s"
    length = struct.calcsize(order + entry)
    table = file.read(count * length)
    begin = start + (8 if big else 2)
    values: dict[int, int] = {}
    places: dict[int, slice] = {}
    for index, (number, kind, many, value) in enumerate(struct.iter_unpack(order + entry, table)):
        if kind not in _TYPES or not many:
            continue
        size = struct.calcsize(order + _TYPES[kind])
        if many * size > len(value):  # the values are stored elsewhere
            file.seek(min(struct.unpack(order + ("Q" if big else "I"), value)[0], 1 << 62))
            value = file.read(size)
        values.setdefault(number, struct.unpack_from(order + _TYPES[kind], value)[0])
        places.setdefault(number, slice(begin + index * length, begin + (index + 1) * length))
    if not {_WIDTH, _HEIGHT} <= set(values):
        raise ValueError("no width or height")
    return values, places
