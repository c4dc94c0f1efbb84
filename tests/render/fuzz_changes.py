"""Random damage of files: to their bytes, and to the values of formats whose checksums or grammars few damaged bytes pass."""

from __future__ import annotations

import contextlib
import io
import json
import random
import re
import struct
import warnings
import zipfile
import zlib
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import tomli_w

from unrender.io import toml_lines

__all__ = ["damaged"]

_WHOLE = (
    0,
    1,
    2,
    3,
    127,
    128,
    255,
    256,
    32767,
    32768,
    65535,
    65536,
    2**31 - 1,
    2**31,
    2**32 - 1,
    2**62,
    2**63 - 1,
    2**64 - 1,
)
_WORDS = (
    *(b"-1", b"0", b"1e999", b"nan", b"-inf", b"99999999999999999999", b"1e-320", b"true", b"null", b"[]", b"{}", b'""', b"' '"),
    *(b"../../../etc/passwd", b"/dev/zero", b"\0", b"\xff\xfe", b"\xed\xa0\x80", b"[" * 300, b"{" * 300, b"#", b'"', b"\n", b"<", b"&a;"),
)  # fmt: skip


def damaged(name: str, data: bytes, draw: random.Random) -> bytes:
    """Return the file after one to eight random changes: of its bytes, or of its values where its format is known."""
    if (change := _FORMATS.get(name.rpartition(".")[2])) and draw.random() < 0.6:
        with contextlib.suppress(Exception):  # what an earlier change made unreadable is damaged as bytes
            return change(data, draw)
    return _damaged_bytes(data, draw)


def _damaged_bytes(data: bytes, draw: random.Random) -> bytes:
    found = bytearray(data)
    for _ in range(draw.choice((1, 1, 1, 2, 3, 8))):
        draw.choice(_CHANGES)(found, draw)
    return bytes(found)


def _flip(data: bytearray, draw: random.Random) -> None:
    if data:
        data[draw.randrange(len(data))] ^= 1 << draw.randrange(8)


def _byte(data: bytearray, draw: random.Random) -> None:
    if data:
        data[draw.randrange(len(data))] = draw.choice((0, 1, 0x7F, 0x80, 0xFF, draw.randrange(256)))


def _number(data: bytearray, draw: random.Random) -> None:
    kind, value = draw.choice("HIQ"), draw.choice(_WHOLE)
    packed = struct.pack(draw.choice("<>") + kind, value % (1 << 8 * struct.calcsize("<" + kind)))
    at = draw.randrange(max(min(len(data), draw.choice((64, 512, len(data) or 1))), 1))
    data[at : at + len(packed)] = packed


def _word(data: bytearray, draw: random.Random) -> None:
    """Put a word in place of a number or name of a text."""
    spans = [match.span() for match in re.finditer(rb"[\w.+-]+", bytes(data[:4096]))]
    start, end = draw.choice(spans) if spans else (0, 0)
    data[start:end] = draw.choice((*_WORDS, str(draw.choice(_WHOLE)).encode()))


def _cut(data: bytearray, draw: random.Random) -> None:
    start = draw.randrange(len(data) + 1)
    del data[start : draw.choice((len(data), start + 1, start + draw.randrange(1, 64)))]


def _repeat(data: bytearray, draw: random.Random) -> None:
    start = draw.randrange(len(data) + 1)
    part = bytes(data[start : start + draw.randrange(1, 200)])
    data[start:start] = part * draw.choice((1, 1, 2, 1000))


def _swap(data: bytearray, draw: random.Random) -> None:
    length = draw.randrange(1, 40)
    first, second = (draw.randrange(len(data) + 1) for _ in range(2))
    data[first : first + length], data[second : second + length] = (
        bytes(data[second : second + length]),
        bytes(data[first : first + length]),
    )


_CHANGES = (_flip, _byte, _number, _number, _word, _word, _cut, _repeat, _swap)


# ---------------------------------------------------------------------- values of texts

_VALUES: tuple[Any, ...] = (
    *(0, 1, -1, 2**31, 2**63 - 1, -(2**63), 10**30, 0.5, 1e308, 1e-320, float("nan"), float("inf"), -float("inf"), True, False),
    *("", " ", "a", "nan", "1e999", "../../../etc/passwd", "/dev/zero", "a\x1b]0;b\x07", "\u202e", "a" * 10_000, "%s%n", "{0}"),
    *([], {}, [[]], [None], [1, "a"], [[1, 2], [3]], [0.5] * 10_000, {"": 1}, {"a": {"b": []}}, None),
)  # fmt: skip


def _places(value: Any) -> Iterator[tuple[Any, Any]]:
    """Yield each container of a tree with each of its keys."""
    for key in list(value) if isinstance(value, dict) else range(len(value)) if isinstance(value, list) else ():
        yield value, key
        yield from _places(value[key])


def _change_tree(tree: Any, draw: random.Random) -> None:
    """Change a value, remove or copy an entry, or move it elsewhere."""
    if not (places := list(_places(tree))):
        return
    within, key = draw.choice(places)
    value = within[key]
    match draw.randrange(8):
        case 0:
            del within[key]
        case 1:
            other, at = draw.choice(places)
            within[key] = json.loads(json.dumps(other[at])) if at in other or isinstance(other, list) else None
        case 2 if isinstance(within, list):
            within.extend([value] * draw.choice((1, 1, 2, 1000)))
        case 2 | 3 if isinstance(within, dict):
            within[draw.choice((*(k for _, k in places if isinstance(k, str)), "a", "", "__class__"))] = value
        case 4 if isinstance(value, (int, float)):
            within[key] = draw.choice((-value, value * 1e6, value * 1e-6, value + 1, value - 1, int(value), str(value)))
        case 5:
            within[key] = [value]
        case _:
            within[key] = json.loads(json.dumps(draw.choice(_VALUES)))


def _text(read: Callable[[str], Any], write: Callable[[Any], str]) -> Callable[[bytes, random.Random], bytes]:
    def change(data: bytes, draw: random.Random) -> bytes:
        tree = read(data.decode())
        for _ in range(draw.choice((1, 1, 1, 2, 4))):
            try:
                _change_tree(tree, draw)
            except (IndexError, KeyError):
                continue
        return write(tree).encode("utf-8", "surrogatepass")

    return change


# ---------------------------------------------------------------------- arrays

_TYPES = (
    "<f4",
    "<f8",
    "<f2",
    "|u1",
    "<u2",
    "<i8",
    "|b1",
    "<c16",
    "|O",
    "<U5",
    "|S3",
    "<M8[s]",
    "|V4",
    ">f4",
    "[('a','<f4')]",
    "<f400",
)
_SIDES = (0, 1, 2, 3, 4, 7, 1000, 2**20, 2**31, 2**40, 2**62, -1)


def _array(data: bytes, draw: random.Random) -> bytes:
    """Change the type, the shape or the values of an array."""
    array = np.load(io.BytesIO(data), allow_pickle=False)
    shape, kind = list(array.shape), array.dtype.str
    match draw.randrange(6):
        case 0:
            kind = draw.choice(_TYPES)
        case 1 if shape:
            shape[draw.randrange(len(shape))] = draw.choice(_SIDES)
        case 2:
            shape = [draw.choice(_SIDES) for _ in range(draw.choice((0, 1, 2, 3, 4, 5, 40)))]
        case 3 if array.size:
            array = array[tuple(slice(0, draw.randrange(side + 1)) for side in shape)]
            shape = list(array.shape)
        case 4 if array.size and array.dtype.kind in "fiu":
            with np.errstate(all="ignore"):
                array = array.copy()
                value = draw.choice((np.nan, np.inf, -np.inf, 1e38, -1.0, 0.0, 1e-40))
                array.reshape(-1)[draw.randrange(array.size) :: draw.choice((1, 2, array.size))] = np.float64(
                    value
                ).astype(array.dtype)
        case _:
            return _damaged_bytes(data, draw)
    order = draw.choice(("False", "False", "False", "True", "2"))
    header = f"{{'descr': {kind if kind.startswith('[') else repr(kind)}, 'fortran_order': {order}, 'shape': {tuple(shape)}, }}\n".encode()
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header + array.tobytes()


def _archive(data: bytes, draw: random.Random) -> bytes:
    """Change, remove, rename or repeat members of an archive."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        members = [(name, archive.read(name)) for name in archive.namelist()]
    for _ in range(draw.choice((1, 1, 2, 4))):
        if not members:
            break
        at = draw.randrange(len(members))
        name, content = members[at]
        match draw.randrange(6):
            case 0:
                del members[at]
            case 1:
                members[at] = (
                    draw.choice((draw.choice(members)[0], "a.npy", "../a.npy", ".", name[:-4], "\u202e.npy")),
                    content,
                )
            case 2:
                members[at] = name, draw.choice(members)[1]
            case 3:
                members.append((draw.choice((name, "x" + name)), content))
            case _:
                members[at] = (
                    name,
                    _array(content, draw) if content.startswith(b"\x93NUMPY") else _damaged_bytes(content, draw),
                )
    buffer = io.BytesIO()
    with (
        warnings.catch_warnings(),
        zipfile.ZipFile(buffer, "w", draw.choice((zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED))) as archive,
    ):
        warnings.simplefilter("ignore")
        for name, content in members:
            archive.writestr(name, content)
    return buffer.getvalue()


def _tensors(data: bytes, draw: random.Random) -> bytes:
    """Change the header of a safetensors file, or its data."""
    end = 8 + int.from_bytes(data[:8], "little")
    if draw.random() < 0.2:
        return data[:end] + _damaged_bytes(data[end:], draw)
    header = _FORMATS["json"](data[8:end], draw)
    return len(header).to_bytes(8, "little") + header + data[end:]


# ---------------------------------------------------------------------- chunks


def _chunks(data: bytes, draw: random.Random) -> bytes:
    """Damage chunks of a PNG, remove, repeat or exchange them, with checksums that fit."""
    found, at = [], 8
    while at + 8 <= len(data):
        length = int.from_bytes(data[at : at + 4], "big")
        found.append((data[at + 4 : at + 8], data[at + 8 : at + 8 + length]))
        at += 12 + length
    for _ in range(draw.choice((1, 1, 2))):
        index = draw.randrange(len(found))
        kind, content = found[index]
        match draw.randrange(7):
            case 0 if len(found) > 1:
                del found[index]
            case 1:
                found.insert(index, found[draw.randrange(len(found))])
            case 2:
                found[index] = (
                    draw.choice((b"PLTE", b"tRNS", b"gAMA", b"iCCP", b"tEXt", b"zTXt", b"acTL", b"eXIf", b"IDAT")),
                    content,
                )
            case 3 if kind == b"IDAT":
                found[index] = kind, zlib.compress(_damaged_bytes(zlib.decompress(content), draw))
            case _:
                found[index] = kind, _damaged_bytes(content, draw)
    return data[:8] + b"".join(
        struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))
        for kind, content in found
    )


def _serialized(data: bytes, draw: random.Random) -> bytes:
    """Damage a mesh of Mitsuba's serialized format within its compression."""
    content = zlib.decompressobj().decompress(data[4:])
    return data[:4] + zlib.compress(_damaged_bytes(content, draw)) + struct.pack("<QI", 0, 1)


_FORMATS: dict[str, Callable[[bytes, random.Random], bytes]] = {
    "json": _text(json.loads, json.dumps),
    "toml": _text(lambda text: toml_lines.parse(text, ""), tomli_w.dumps),
    "npy": _array,
    "npz": _archive,
    "png": _chunks,
    "safetensors": _tensors,
    "serialized": _serialized,
}
