"""Kind and size of an image file, read from its header before a decoder runs.

A file of a few hundred bytes can declare a hundred thousand pixels per side. Mitsuba recognises the kind of a file by its first bytes,
regardless of its extension, and so does this module. Each decoder has an allow-list of kinds, so it never gets a file of another kind.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO

from unrender.core.errors import InputError
from unrender.io import bounded_files, tiff_header

MOST_VALUES = 1 << 28
"""Largest image that is decoded, in pixels times channels: one gigabyte in single precision."""

LONGEST_SIDE = 1 << 17
"""Largest side in pixels, because decoders allocate tables of rows."""

_HEADER = 1 << 20
_EXR_PARTS = 0x1000
_MOST_ATTRIBUTES = 4096
_MOST_CHUNKS = 1 << 18
_MOST_SCANS = 100
_MOST_SCANNED = 1 << 30
"""Largest product of pixels and scans of a JPEG file: each scan covers the entire image, and may have a few bytes."""
_WEBP_ANIMATION = 0x02
_JPEG_MARKER, _JPEG_SCAN, _JPEG_END = re.compile(rb"\xff[^\x00\x01\xd0-\xd7\xff]"), 0xDA, 0xD9
_JPEG_FRAMES = {*range(0xC0, 0xD0)} - {0xC4, 0xC8, 0xCC}
_FARTHEST = 1 << 30


@dataclass(frozen=True)
class Header:
    """Header of a picture file: its kind, such as "PNG", and width, height and channels of each part. Bits per channel are 0 for others
    than PNG and TIFF, and the orientation is 1 for others than TIFF."""

    kind: str
    sizes: Sizes
    bits: int = 0
    orientation: int = 1

    @property
    def values(self) -> int:
        """Number of pixels times channels of all parts."""
        return sum(width * height * max(channels, 1) for width, height, channels in self.sizes)


def check(path: Path) -> int:
    """Return the number of values of an image that Mitsuba decodes: pixels times channels of all parts.

    Raises `InputError` without the file's name, for a file of an unknown kind or a malformed header. A header that declares more than
    `MOST_VALUES` values, or more than the file's bytes can contain, is an error too.
    """
    return _read_header(path, _MITSUBA).values


def read_photograph_header(path: Path) -> Header:
    """Return the header of a photograph: the kinds that Mitsuba decodes, TIFF, WebP and PNM. Raises `InputError` as `check` does."""
    return _read_header(path, _PHOTOGRAPHS)


def _read_header(path: Path, readers: Sequence[_Kind]) -> Header:
    try:
        with bounded_files.open_regular(path) as file:
            data = file.read(_HEADER)
            size = file.seek(0, 2)
            kind, reader = _reader(data, file, path, readers)
            file.seek(0)
            contents = reader(data, file)
    except InputError as error:
        raise InputError(str(error).removeprefix(f"{path}: ")) from error
    except MemoryError:
        raise
    except Exception as error:  # readers of malformed headers raise many types of exceptions
        raise InputError(f"cannot be read as a picture: its header is malformed ({type(error).__name__})") from error
    header = (
        Header(kind, contents)
        if isinstance(contents, list)
        else Header(kind, [contents.size], contents.bits, contents.orientation)
    )
    for width, height, channels in header.sizes:
        values, what = width * height * max(channels, 1), f"{width}x{height} pixels of {channels} channels"
        if width < 1 or height < 1 or values > MOST_VALUES or max(width, height) > LONGEST_SIDE:
            limits = f"at most {MOST_VALUES} values in all and {LONGEST_SIDE} pixels a side"
            raise InputError(f"declares {what}, expected at least one and {limits}")
        # Constant images compress a thousandfold, and could fill the memory; photographs have up to 30 values per byte, masks 500.
        if values > max(1 << 25, min(512 * size, 1 << 26), 32 * size):
            raise InputError(f"declares {what} in {size} bytes; if that is right, save it without compression")
    return header


Sizes = list[tuple[int, int, int]]
_Reader = Callable[[bytes, IO[bytes]], Sizes | tiff_header.TiffHeader]
_Kind = tuple[bytes, str, _Reader]


def _reader(data: bytes, file: IO[bytes], path: Path, readers: Sequence[_Kind]) -> tuple[str, _Reader]:
    """Return the kind and reader of a file by its first bytes (the last bytes for TGA), in Mitsuba's order."""
    for magic, kind, reader in readers:
        if magic and data.startswith(magic):
            return kind, reader
    for magic, kind, reader in readers:
        if not magic and (_has_tga_footer(file) or (readers is _PHOTOGRAPHS and path.suffix.lower() == ".tga")):
            return kind, reader
    kinds = ", ".join(dict.fromkeys(kind for _, kind, _ in readers))
    raise InputError(
        f"cannot be read as a picture: its header is malformed or of another kind; expected one of {kinds}"
    )


def _has_tga_footer(file: IO[bytes]) -> bool:
    if file.seek(0, 2) < 18:
        return False
    file.seek(-18, 2)
    return file.read() == b"TRUEVISION-XFILE.\0"


def _exr(data: bytes, _: IO[bytes]) -> Sizes:
    """Return width and height of the data window, and the number of channels, of each part."""
    many = struct.unpack_from("<I", data, 4)[0] & _EXR_PARTS
    at, sizes = 8, []
    while data[at] or not sizes:
        size, at = _exr_part(data, at)
        sizes.append(size)
        if not many:
            break
    return sizes


def _exr_part(data: bytes, at: int) -> tuple[tuple[int, int, int], int]:
    window, channels = None, 0
    for _ in range(_MOST_ATTRIBUTES):
        if not data[at]:
            if window is None or not channels:
                raise ValueError("no data window or no channels")
            low_x, low_y, high_x, high_y = window
            width, height = high_x - low_x + 1, high_y - low_y + 1
            if width > 0 and height > 0 and not 0 <= low_x + low_y * width < _FARTHEST:
                # Mitsuba computes this offset in unsigned 32 bits, and then writes to a wrong address.
                raise InputError(
                    f"its data window begins at ({low_x}, {low_y}), which Mitsuba cannot read: expected (0, 0)"
                )
            return (width, height, channels), at + 1
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


def _hdr(data: bytes, file: IO[bytes]) -> Sizes:
    """Return the size from the first line with a resolution, in the only form that Mitsuba reads."""
    line = re.search(rb"^[^\n]*(?:-Y|\+X)[^\n]*$", data, re.MULTILINE)
    match = line and re.fullmatch(rb"-Y +(\d{1,9}) +\+X +(\d{1,9}) *", line[0].replace(b"\r", b""))
    if not line or not match:
        raise ValueError("no resolution")
    width, height = int(match[2]), int(match[1])
    if 0 < 3 * width * height <= MOST_VALUES:
        file.seek(line.end() + 1)
        _check_scanlines(file.read(), width, height)
    return [(width, height, 3)]


def _check_scanlines(data: bytes, width: int, height: int) -> None:
    """Raise unless the encoded rows of an HDR file end with the image: Mitsuba would write beyond it."""
    if not (8 <= width < 1 << 15 and data[:2] == b"\2\2" and len(data) > 2 and data[2] < 0x80):
        return  # not run-length encoded
    marker, at = b"\2\2" + width.to_bytes(2, "big"), 0
    for _ in range(height):
        if data[at : at + 4] != marker:
            raise ValueError("a row without runs among those with runs")
        at += 4
        for _ in range(4):
            left = width
            while left > 0:
                count = data[at]
                run = count > 128
                count -= 128 if run else 0
                at += 2 if run else 1 + count
                if not 0 < count <= left or at > len(data):
                    raise ValueError("runs that do not fill a row")
                left -= count


def _netpbm(pattern: bytes, coloured: bytes) -> _Reader:
    """Return the reader of a text header: type, width, height and, if Mitsuba decodes it, the largest value; `coloured` types have three
    channels."""

    def read(data: bytes, _: IO[bytes]) -> Sizes:
        if (match := re.match(pattern, data)) is None:
            raise ValueError("no resolution")
        if any(largest != b"255" for largest in match.groups()[3:]):
            what = (
                f"the largest value of a .ppm is {int(match[4])}, which Mitsuba ignores or reads in another byte order"
            )
            raise InputError(f"cannot be read as a picture: {what}; save it as .png")
        return [(int(match[2]), int(match[3]), 3 if match[1] in coloured else 1)]

    return read


_pfm = _netpbm(rb"P([Ff])\s+(\d{1,9})\s+(\d{1,9})\s", b"F")
_ppm = _netpbm(rb"P(6)\s+(\d{1,9})\s+(\d{1,9})\s+(\d{1,5})\s", b"6")
_pnm = _netpbm(rb"P([1-6])(?:\s|#[^\n]*\n)+(\d{1,9})(?:\s|#[^\n]*\n)+(\d{1,9})\s", b"36")
"""Readers of what Mitsuba accepts, and of what Pillow does: P1 to P6, with comments between the numbers."""


def _webp(data: bytes, _: IO[bytes]) -> Sizes:
    """Return the canvas of a still image, which Pillow allocates before it reports the size."""
    if data[8:12] != b"WEBP":
        raise ValueError("no WebP")
    chunk = data[12:16]
    if chunk == b"VP8X":
        if data[20] & _WEBP_ANIMATION:
            raise InputError("an animation, expected a still image")
        sides = (int.from_bytes(data[at : at + 3], "little") + 1 for at in (24, 27))
    elif chunk == b"VP8L" and data[20] == 0x2F:
        bits = int.from_bytes(data[21:25], "little")
        sides = ((bits >> shift & 0x3FFF) + 1 for shift in (0, 14))
    elif chunk == b"VP8 " and data[23:26] == b"\x9d\x01\x2a":
        sides = (side & 0x3FFF for side in struct.unpack_from("<HH", data, 26))
    else:
        raise ValueError("no frame")
    width, height = sides
    return [(width, height, 4)]


def _bmp(data: bytes, _: IO[bytes]) -> Sizes:
    width, height, *_rest, bits = struct.unpack_from("<iiHH", data, 18)
    return [(width, abs(height), max(bits // 8, 1))]


def _refused(what: str) -> InputError:
    return InputError(f"cannot be read as a picture: {what}, which Mitsuba does not decode; save it as .png in RGB")


def _mitsubas_bmp(data: bytes, file: IO[bytes]) -> Sizes:
    """Return the size. Raise `InputError` for indexed colours, since Mitsuba takes the indices for grey, and 16 bits for alpha."""
    head, bits, used = (struct.unpack_from(form, data, at)[0] for form, at in (("<I", 14), ("<H", 28), ("<I", 46)))
    if bits not in (8, 24, 32):
        raise _refused(f"its bit depth is {bits}")
    table = data[14 + head : 14 + head + 4 * (used or 256)] if bits == 8 else b""
    if any(table[at : at + 3] != bytes([at // 4]) * 3 for at in range(0, len(table) - 3, 4)):
        raise _refused("its colours are indexed")
    return _bmp(data, file)


def _tga(data: bytes, _: IO[bytes]) -> Sizes:
    """Return the size from a header that Pillow accepts."""
    width, height, bits = struct.unpack_from("<HHB", data, 12)
    return [(width, height, max(bits // 8, 3))]


def _mitsubas_tga(data: bytes, file: IO[bytes]) -> Sizes:
    skipped, _, kind = struct.unpack_from("<3B", data)
    width, height, bits = struct.unpack_from("<hhB", data, 12)  # signed, as in Mitsuba
    depth = max(bits // 8, 1)
    if (kind & 7, bits) not in ((2, 24), (2, 32), (3, 8)):
        raise _refused("its colours are indexed" if kind & 7 == 1 else f"its bit depth is {bits}")
    if kind & 8 and min(width, height) > 0 and width * height * depth <= MOST_VALUES:
        file.seek(18 + skipped)
        _check_runs(file.read(), width * height, depth)
    return [(width, height, depth)]


def _check_runs(packets: bytes, pixels: int, depth: int) -> None:
    """Raise `ValueError` or `IndexError` unless the run-length encoded pixels end with the image: Mitsuba would write beyond it."""
    at = 0
    while pixels > 0:
        count = (packets[at] & 0x7F) + 1
        at += 1 + (depth if packets[at] & 0x80 else count * depth)
        pixels -= count
    if pixels or at > len(packets):
        raise ValueError("runs that do not fill the picture")


def _png(data: bytes, file: IO[bytes]) -> tiff_header.TiffHeader:
    """Return size and bits per channel; indexed colours count as four channels, to which they are converted."""
    if data[12:16] != b"IHDR":
        raise ValueError("no IHDR")
    _check_chunks(file)
    width, height, bits, kind = struct.unpack_from(">IIBB", data, 16)
    return tiff_header.TiffHeader((width, height, {0: 1, 2: 3, 4: 2}.get(kind, 4)), bits)


def _check_chunks(file: IO[bytes]) -> None:
    """Raise `InputError` where a PNG file ends within a chunk: OpenCV allocates the length that a chunk declares."""
    size = file.seek(0, 2)
    at = file.seek(8)
    for _ in range(_MOST_CHUNKS):
        head = file.read(8)
        if len(head) < 8 or head[4:] == b"IEND":
            return
        (length,) = struct.unpack_from(">I", head)
        at += 12 + length
        if at > size:
            raise InputError(
                f"cannot be read as a picture: a chunk of {length} bytes extends beyond the end of the file"
            )
        file.seek(at)
    raise InputError(f"cannot be read as a picture: more than {_MOST_CHUNKS} chunks")


def _jpeg(_: bytes, file: IO[bytes]) -> Sizes:
    """Return the size. Raise `InputError` for too many scans, and for a file without end marker: libjpeg fills what is missing with grey.

    Thumbnails before the picture and videos after it do not count.
    """
    file.seek(0)
    # A picture within the limits has at most about a byte per value, and the file may be of any size.
    data, sizes, scans, at = file.read(2 * MOST_VALUES), list[tuple[int, int, int]](), 0, 2
    while scans <= _MOST_SCANS and (marker := _JPEG_MARKER.search(data, at)):
        kind, start = marker[0][1], marker.end()
        if kind == _JPEG_END:
            break
        if kind in _JPEG_FRAMES:
            height, width, channels = struct.unpack_from(">HHB", data, start + 3)
            sizes.append((width, height, channels))
        scans += kind == _JPEG_SCAN
        at = start + max(int.from_bytes(data[start : start + 2], "big"), 2)
    else:
        fault = "it has no end marker, so a part may be missing; copy the file again, or save the picture again if it is complete"
        fault = f"more than {_MOST_SCANS} scans" if scans > _MOST_SCANS else fault
        raise InputError(f"cannot be read as a picture: {fault}")
    if len(sizes) != 1:
        raise ValueError("no frame, or several")
    width, height = sizes[0][:2]
    if scans * width * height > _MOST_SCANNED:
        raise InputError(f"cannot be read as a picture: {scans} scans of {width}x{height} pixels")
    return sizes


def _mitsubas_jpeg(data: bytes, file: IO[bytes]) -> Sizes:
    ((width, height, channels),) = _jpeg(data, file)
    if channels not in (1, 3):
        raise _refused("its colours are CMYK" if channels == 4 else f"it has {channels} channels")
    return [(width, height, channels)]


_MITSUBA: tuple[_Kind, ...] = (
    (b"BM", "BMP", _mitsubas_bmp),
    (b"#?", "HDR", _hdr),
    (b"PF", "PFM", _pfm),
    (b"Pf", "PFM", _pfm),
    (b"P6", "PPM", _ppm),
    (b"\xff\xd8", "JPEG", _mitsubas_jpeg),
    (b"\x89PNG\r\n\x1a\n", "PNG", _png),
    (b"\x76\x2f\x31\x01", "EXR", _exr),
    (b"", "TGA", _mitsubas_tga),
)
"""Kinds of files that Mitsuba's `Bitmap` may decode."""

_PHOTOGRAPHS: tuple[_Kind, ...] = (
    *(each for each in _MITSUBA if each[1] not in ("BMP", "JPEG", "PPM", "TGA")),
    (b"\xff\xd8", "JPEG", _jpeg),
    (b"BM", "BMP", _bmp),
    *((magic, "TIFF", tiff_header.read) for magic in tiff_header.MAGICS),
    (b"RIFF", "WEBP", _webp),
    *((b"P%d" % number, "PPM", _pnm) for number in range(1, 7)),
    (b"", "TGA", _tga),
)
"""Kinds of files of photographs and masks."""
