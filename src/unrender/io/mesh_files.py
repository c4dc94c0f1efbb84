"""Checks of the mesh files of a scene before Mitsuba reads them.

Mitsuba trusts the declared numbers of vertices and faces, and the vertex indices of faces. A PLY or serialized file with an index out of
range, or with counts that differ from its data, causes a segmentation fault or worse. Mitsuba checks OBJ files itself.
"""

from __future__ import annotations

import itertools
import os
import re
import struct
import zlib
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO

import numpy as np

from unrender.core.errors import InputError
from unrender.core.text import visible
from unrender.io import bounded_files

_LARGEST_HEADER = 1 << 16
_MOST_ELEMENTS = 1 << 30
_BLOCK = 1 << 20
_TYPES = {
    **{
        "char": "i1",
        "uchar": "u1",
        "short": "i2",
        "ushort": "u2",
        "int": "i4",
        "uint": "u4",
        "long": "i8",
        "ulong": "u8",
    },
    **{"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"},
    **{"half": "f2", "float": "f4", "double": "f8", "float16": "f2", "float32": "f4", "float64": "f8"},
}
_INDICES = ("vertex_index", "vertex_indices")
_SPLATS = ("x", "y", "z", "nx", "ny", "nz"), ("scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3")


# ---------------------------------------------------------------------- PLY


@dataclass
class _Element:
    """Element of a PLY file: rows with the same properties. A list consists of its count, named with ".count", and three numbers."""

    name: str
    count: int
    properties: list[tuple[str, str]] = field(default_factory=list)

    @property
    def names(self) -> list[str]:
        return [name for name, _ in self.properties]


@dataclass(frozen=True)
class _Header:
    """Header of a PLY file; `order` is "<" or ">", or "" for a text file."""

    order: str
    elements: list[_Element]
    length: int


def check_ply(path: Path, splats: bool = False) -> None:
    """Raise `InputError` unless a PLY file has the rows that it declares, and triangles of existing vertices or, as `splats`, ellipsoids,
    whose properties must be float32 and in Mitsuba's order."""
    with bounded_files.open_regular(path) as file:
        header = _header(file, path)
        vertices = [each for each in header.elements if each.name == "vertex"]
        faces = [each for each in header.elements if each.name == "face"]
        if splats:
            _check_splats(header, path)
        elif len(vertices) != 1 or len(faces) > 1:
            raise InputError(f"{path}: expected the elements vertex and face once each")
        elif header.elements.index(vertices[0]) > (header.elements.index(faces[0]) if faces else len(header.elements)):
            raise InputError(f"{path}: expected the element vertex before face")
        file.seek(header.length)
        check = _check_text if header.order == "" else _check_binary
        check(file, header, vertices[0].count if vertices else 0, path)


def _header(file: IO[bytes], path: Path) -> _Header:
    data = file.read(_LARGEST_HEADER)
    match = re.search(rb"^[ \t\r]*end_header[ \t\r]*(?:\n|\Z)", data, re.MULTILINE)
    if not data.startswith(b"ply") or match is None:
        raise InputError(f"{path}: not a PLY file: its header is malformed")
    order, elements = None, []
    for line in data[: match.start()].decode("latin-1").replace("\r", "").split("\n"):
        match line.split():
            case [] | ["comment", *_] | ["ply"]:
                pass
            case ["format", str(name), "1.0"] if order is None:
                order = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}.get(name)
            case ["element", str(name), str(count)] if re.fullmatch(r"[0-9]{1,10}", count):
                elements.append(_Element(name, int(count)))
            case ["property", "list", str(counts), str(kind), str(name)] if elements and {counts, kind} <= set(_TYPES):
                parts = [(f"i{corner}", _TYPES[kind]) for corner in range(3)]
                elements[-1].properties += [(f"{name}.count", _TYPES[counts]), *parts]
            case ["property", str(kind), str(name)] if elements and kind in _TYPES:
                elements[-1].properties.append((name, _TYPES[kind]))
            case _:
                raise InputError(f"{path}: not a PLY file that Mitsuba reads: {visible(line[:60])}")
    for element in elements:
        _check_element(element, path)
    if order is None:
        raise InputError(f"{path}: not a PLY file: its format is missing")
    return _Header(order, elements, match.end())


def _check_element(element: _Element, path: Path) -> None:
    """Check an element's names, which appear in Mitsuba's messages, and its properties, which determine the memory layout."""
    if not all(re.fullmatch(r"[\w.:-]{1,100}", name) for name in (element.name, *element.names)):
        raise InputError(f"{path}: element {visible(element.name[:60])}: expected names of letters, digits and '_'")
    twice = [name for name, count in Counter(element.names).items() if count > 1]
    if twice:
        raise InputError(f"{path}: element {element.name}: property {twice[0]} is given twice")
    if element.count > _MOST_ELEMENTS:
        raise InputError(f"{path}: declares {element.count} of {element.name}, expected at most {_MOST_ELEMENTS}")
    if element.name == "vertex" and not {"x", "y", "z"} <= set(element.names):
        raise InputError(f"{path}: element vertex: expected the properties x, y and z")
    if element.name == "face":
        lists = [name for name in element.names if name.endswith(".count")]
        kinds = dict(element.properties)
        if [name.removesuffix(".count") for name in lists] not in [[name] for name in _INDICES]:
            raise InputError(f"{path}: element face: expected one list, vertex_indices, got {lists or 'none'}")
        if any(kinds[name][0] == "f" for name in (*lists, "i0", "i1", "i2")):
            raise InputError(f"{path}: element face: expected whole numbers for vertex_indices")


def _check_splats(header: _Header, path: Path) -> None:
    first = header.elements[0] if header.elements else _Element("", 0)
    head, tail = _SPLATS
    if len(first.names) < len(head) + len(tail) or (tuple(first.names[:6]), tuple(first.names[-7:])) != _SPLATS:
        raise InputError(f"{path}: expected the properties {', '.join(head)}, others, {', '.join(tail)}")
    if any(kind != "f4" for _, kind in first.properties):
        raise InputError(f"{path}: expected properties of type float")


def _check_binary(file: IO[bytes], header: _Header, vertices: int, path: Path) -> None:
    rows = [np.dtype([(name, header.order + kind) for name, kind in each.properties]) for each in header.elements]
    declared = sum(each.count * row.itemsize for each, row in zip(header.elements, rows, strict=True))
    actual = os.fstat(file.fileno()).st_size - header.length
    if declared != actual:
        raise InputError(f"{path}: its header declares {declared} bytes of numbers, there are {actual}")
    for element, row in zip(header.elements, rows, strict=True):
        if element.name != "face":
            file.seek(element.count * row.itemsize, os.SEEK_CUR)
            continue
        for start in range(0, element.count, _BLOCK):
            faces = np.fromfile(file, row, min(_BLOCK, element.count - start))
            corners = np.stack([faces[f"i{corner}"] for corner in range(3)], -1)
            counts = next(faces[name] for name in element.names if name.endswith(".count"))
            _check_faces(counts, corners, vertices, start, path)


def _check_text(file: IO[bytes], header: _Header, vertices: int, path: Path) -> None:
    words = _words(file)
    for element in header.elements:
        width, left, row = max(len(element.names), 1), element.count * len(element.names), 0
        pending: list[bytes] = []
        while left > 0:
            if not (block := next(words, [])):
                raise InputError(f"{path}: cut short: element {element.name} has fewer than {element.count} rows")
            pending += block[:left]
            if len(block) > left:
                words = itertools.chain([block[left:]], words)
            left -= min(left, len(block))
            complete = len(pending) // width * width
            if element.name == "face":
                _check_words(pending[:complete], element, vertices, row, path)
            row += complete // width
            pending = pending[complete:]


def _words(file: IO[bytes]) -> Iterator[list[bytes]]:
    rest = b""
    while data := file.read(_BLOCK):
        data = rest + data
        end = max(data.rfind(b" "), data.rfind(b"\n")) + 1
        rest = data[end:]
        if len(rest) > _LARGEST_HEADER:
            return
        if words := data[:end].split():
            yield words
    if words := rest.split():
        yield words


def _check_words(words: list[bytes], element: _Element, vertices: int, start: int, path: Path) -> None:
    # Longer words are cut, and out of range either way.
    table = np.array(words, dtype="S12").reshape(-1, len(element.names))
    names = [name for name in element.names if name.endswith(".count")] + ["i0", "i1", "i2"]
    columns = table[:, [element.names.index(name) for name in names]]
    if not np.char.isdigit(columns).all():
        raise InputError(f"{path}: element face: expected whole numbers for vertex_indices")
    numbers = columns.astype(np.int64)
    _check_faces(numbers[:, 0], numbers[:, 1:], vertices, start, path)


def _check_faces(counts: np.ndarray, corners: np.ndarray, vertices: int, start: int, path: Path) -> None:
    """Raise `InputError` unless all faces have three corners among the vertices. `start` is the index of the first face."""
    if (counts != 3).any():
        face = int(np.argmax(counts != 3))
        raise InputError(f"{path}: face {start + face} has {int(counts[face])} corners, expected triangles")
    wrong = ((corners < 0) | (corners >= vertices)).any(axis=-1)
    if wrong.any():
        face = int(np.argmax(wrong))
        indices = ", ".join(str(int(corner)) for corner in corners[face])
        raise InputError(f"{path}: face {start + face} has the vertices {indices}, expected less than {vertices}")


# ---------------------------------------------------------------------- OBJ

_FREE_BYTES = 1 << 17
_MOST_VARIANTS = 1 << 12


def check_obj(path: Path) -> None:
    """Raise `InputError` if a vertex has so many combinations of attributes that Mitsuba, which searches them linearly, takes hours."""
    with bounded_files.open_regular(path) as file:
        if os.fstat(file.fileno()).st_size <= _FREE_BYTES:
            return
        variants: Counter[bytes] = Counter()
        rest = b""
        while data := file.read(_BLOCK):
            data = rest + data
            end = data.rfind(b"\n") + 1
            rest = data[end:] if len(data) - end < _BLOCK else b""
            corners = set(re.findall(rb"[ \t](\d+/[\d/]+)", data[:end]))
            variants.update(corner.partition(b"/")[0] for corner in corners)
        worst = variants.most_common(1)
        if worst and worst[0][1] > _MOST_VARIANTS:
            what = f"vertex {visible(worst[0][0][:20].decode('ascii'))} has {worst[0][1]} combinations of normals and texture coordinates"
            raise InputError(f"{path}: {what}, expected at most {_MOST_VARIANTS}")


# ---------------------------------------------------------------------- Mitsuba's serialized meshes

_MAGIC, _NORMALS, _TEXTURE, _COLOURS, _DOUBLE = 0x041C, 1, 2, 8, 0x2000
_LONGEST_NAME = 1 << 12


def check_serialized(path: Path, index: int = 0) -> None:
    """Raise `InputError` unless a mesh of a serialized file is complete, with finite positions and faces of existing vertices."""
    if index < 0:
        raise InputError(f"{path}: expected a shape_index of at least 0, got {index}")
    try:
        with bounded_files.open_regular(path) as file:
            version = _seek_mesh(file, index)
            _check_mesh(_Unpacked(file), version, path)
    except (struct.error, OSError, zlib.error, ValueError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{path}: not a serialized mesh that can be read ({type(error).__name__})") from error


def _seek_mesh(file: IO[bytes], index: int) -> int:
    """Seek the compressed data of a mesh. Returns the version of the format."""
    magic, version = struct.unpack("<HH", file.read(4))
    if magic != _MAGIC or version not in (3, 4):
        raise ValueError("no serialized mesh")
    if index:
        size = file.seek(-4, os.SEEK_END) + 4
        (count,) = struct.unpack("<I", file.read(4))
        width, kind = (8, "<Q") if version == 4 else (4, "<I")
        if index >= count or 4 + count * width > size:
            raise ValueError("no mesh of that index")
        file.seek(size - 4 - width * (count - index))
        (place,) = struct.unpack(kind, file.read(width))
        file.seek(place + 4)
    return version


@dataclass
class _Unpacked:
    """Reader of a zlib stream that unpacks no more than requested."""

    file: IO[bytes]
    _unpacker: zlib._Decompress = field(default_factory=zlib.decompressobj)

    def read(self, size: int) -> bytes:
        """Return exactly `size` bytes. Raises `ValueError` if there are fewer."""
        parts, left = [], size
        while left > 0:
            data = self._unpacker.unconsumed_tail or self.file.read(_LARGEST_HEADER)
            part = self._unpacker.decompress(data, left)
            if not part and (not data or self._unpacker.eof):
                raise ValueError("cut short")
            parts.append(part)
            left -= len(part)
        return b"".join(parts)

    def floats(self, count: int, kind: str) -> bool:
        finite = True
        for start in range(0, count, _BLOCK):
            size = min(_BLOCK, count - start)
            finite &= bool(np.isfinite(np.frombuffer(self.read(size * np.dtype(kind).itemsize), kind)).all())
        return finite


def _check_mesh(data: _Unpacked, version: int, path: Path) -> None:
    (flags,) = struct.unpack("<I", data.read(4))
    if version == 4:
        name = iter(lambda: data.read(1), b"\0")
        if sum(1 for _, _ in zip(name, range(_LONGEST_NAME + 1), strict=False)) > _LONGEST_NAME:
            raise ValueError("a name without end")
    vertices, faces = struct.unpack("<QQ", data.read(16))
    most = 1200 * os.fstat(data.file.fileno()).st_size  # upper bound of zlib's compression ratio
    if max(vertices, faces) > _MOST_ELEMENTS or 12 * (vertices + faces) > most:
        raise InputError(f"{path}: declares {vertices} vertices and {faces} faces, more than it has bytes for")
    kind = "<f8" if flags & _DOUBLE else "<f4"
    if not data.floats(3 * vertices, kind):
        raise InputError(f"{path}: a vertex is not finite")
    for flag, width in ((_NORMALS, 3), (_TEXTURE, 2), (_COLOURS, 3)):
        if flags & flag:
            data.floats(width * vertices, kind)
    for start in range(0, faces, _BLOCK):
        count = min(_BLOCK, faces - start)
        corners = np.frombuffer(data.read(12 * count), "<u4").reshape(-1, 3)
        _check_faces(np.full(count, 3), corners, vertices, start, path)


def ply(
    vertices: np.ndarray, faces: np.ndarray, normals: np.ndarray | None = None, uv: np.ndarray | None = None
) -> bytes:
    """Encode a mesh as binary little-endian PLY: float32 coordinates, with optional normals and s, t.

    Args:
        vertices: (V, 3).
        faces: vertex indices, (F, 3).
        normals: unit normals, (V, 3).
        uv: Mitsuba's texture coordinates, (V, 2); stored as (u, 1 - v), for `flip_tex_coords`.
    """
    columns: list[tuple[Sequence[str], np.ndarray]] = [("xyz", vertices)]
    columns += [] if normals is None else [(("nx", "ny", "nz"), normals)]
    columns += [] if uv is None else [(("s", "t"), upwards(uv))]
    return ply_of(columns, faces)


def ply_of(columns: Sequence[tuple[Sequence[str], np.ndarray]], faces: np.ndarray) -> bytes:
    """Encode properties of vertices, (their names, values (V, n)), and faces (F, 3) as binary little-endian PLY in float32."""
    names = [name for group, _ in columns for name in group]
    table = np.concatenate([values for _, values in columns], 1).astype("<f4")
    corners = np.empty(len(faces), [("count", "u1"), ("corners", "<i4", 3)])
    corners["count"], corners["corners"] = 3, faces
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {len(table)}"]
    lines += [f"property float {name}" for name in names]
    lines += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header", ""]
    return "\n".join(lines).encode() + table.tobytes() + corners.tobytes()


def obj(vertices: np.ndarray, faces: np.ndarray, uv: np.ndarray | None = None) -> bytes:
    """Encode a mesh as OBJ text that preserves every bit of float32. Arguments as in `ply`."""
    lines = ["# written by unrender", *rows("v", vertices)]
    lines += [] if uv is None else rows("vt", upwards(uv))
    corners = faces.astype(np.int64) + 1
    words = corners.astype(str)
    words = words if uv is None else np.char.add(np.char.add(words, "/"), words)
    lines += ["f " + " ".join(corner) for corner in words.tolist()]
    return ("\n".join(lines) + "\n").encode()


def rows(kind: str, values: np.ndarray) -> list[str]:
    """Return the rows of an array as lines of an OBJ file that begin with `kind`, such as "v"."""
    return [f"{kind} " + " ".join(f"{x:.9g}" for x in row) for row in values.tolist()]


def upwards(uv: np.ndarray) -> np.ndarray:
    """Return (u, 1 - v) for texture coordinates (u, v), (V, 2)."""
    return np.stack([uv[:, 0], 1 - uv[:, 1]], 1)
