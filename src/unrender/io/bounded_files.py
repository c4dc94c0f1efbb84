"""Reading files that anybody may have made: bounded in size and nesting, or refused in one line.

A run folder travels: it is mailed, unpacked, served. So do problem files and arrays. What is read here is held to be hostile until it is
shown to be plain: regular files (within their folder, where one is given), text and JSON of bounded size and depth, archives of numbers
whose headers agree with their length. Nothing is executed, unpickled or unpacked to a file. All functions raise `InputError`, one line
that begins with the path.
"""

from __future__ import annotations

import json
import math
import os
import re
import stat
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import IO, Any

import numpy as np

from unrender.core.errors import InputError

__all__ = [
    "LARGEST_ARRAY",
    "LARGEST_JSON",
    "LARGEST_TEXT",
    "exists",
    "open_regular",
    "parse_json",
    "parse_object",
    "printable",
    "read_array",
    "read_arrays",
    "read_bytes",
    "read_float_arrays",
    "read_object",
    "read_text",
]

LARGEST_TEXT = 1 << 28
"""Of a text file, in bytes."""
LARGEST_JSON = 16 << 20
"""Of a JSON file of a run folder, in bytes."""
LARGEST_ARRAY = 1 << 30
"""Of one array of a run folder as it lies in memory, in bytes."""
LARGEST_ARCHIVE = 8 << 30
"""Of all arrays of an archive of a run folder together, unpacked, in bytes."""
LARGEST_GIVEN = 1 << 32
"""Of arrays that a user gives as the input of a problem, in bytes."""
DEEPEST = 32
"""Nesting of JSON."""

Shape = tuple[int, ...]

_MEMBERS = 10_000
_AXES = 32
_UNREADABLE = (
    OSError,
    ValueError,
    EOFError,
    KeyError,
    RuntimeError,
    NotImplementedError,
    zipfile.BadZipFile,
    zipfile.LargeZipFile,
    zlib.error,
)
_COMPRESSIONS = (
    zipfile.ZIP_STORED,
    zipfile.ZIP_DEFLATED,
)  # what NumPy writes; others may take more memory than they say
_MAGIC = b"\x93NUMPY"
_LONGEST_HEADER = 1 << 12  # far more than the name of a type and a shape take
_INTEGER = rb"-?\d{1,40}L?"
_HEADER = re.compile(
    rb"\s*\{\s*'descr':\s*(?:'([^'\[\]]{1,16})'|\[[^\[\]]{0,1000}\]),\s*'fortran_order':\s*(True|False),"
    rb"\s*'shape':\s*\((\s*(?:" + _INTEGER + rb"(?:\s*,\s*" + _INTEGER + rb")*\s*,?)?\s*)\),?\s*\}\s*"
)


def exists(path: Path) -> bool:
    """Whether there is anything of this name, be it a link that leads nowhere."""
    return os.path.lexists(path)


# ---------------------------------------------------------------------- bytes and text


def open_regular(path: Path, folder: Path | None = None) -> IO[bytes]:
    """Open a regular file, links followed.

    Args:
        path: the file.
        folder: where the file must lie; None for anywhere.

    Raises:
        InputError: it is missing, lies outside `folder` (a link out of it), or is no regular file (a pipe would wait for ever).
    """
    try:
        real = path.resolve(strict=True)
        if folder is not None and not real.is_relative_to(folder.resolve(strict=True)):
            raise InputError(f"{path}: leads out of the folder, expected a file within it")
        # Without waiting for a pipe's other end, and without following a link that took the file's place meanwhile.
        descriptor = os.open(real, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_NOFOLLOW", 0))
    except FileNotFoundError as error:
        raise InputError(f"{path}: no such file") from error
    except (OSError, RuntimeError) as error:  # a loop of links is a RuntimeError before Python 3.13
        raise InputError(f"{path}: cannot be read: {getattr(error, 'strerror', None) or error}") from error
    mode = os.fstat(descriptor).st_mode
    if not stat.S_ISREG(mode):
        os.close(descriptor)
        raise InputError(f"{path}: {'a folder, expected a file' if stat.S_ISDIR(mode) else 'not a regular file'}")
    return os.fdopen(descriptor, "rb")


def read_bytes(path: Path, largest: int, folder: Path | None = None) -> bytes:
    """The bytes of a regular file of at most `largest` bytes; see `open_regular`."""
    try:
        with open_regular(path, folder) as file:
            data = file.read(largest + 1)
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from error
    if len(data) > largest:
        size = f"{largest >> 20} MiB" if largest >= 1 << 20 else f"{largest} bytes"
        raise InputError(f"{path}: larger than {size}, which no such file is")
    return data


def read_text(path: Path, largest: int = LARGEST_TEXT, folder: Path | None = None) -> str:
    """The text of a UTF-8 file of at most `largest` bytes, without a byte order mark; see `open_regular`."""
    try:
        return read_bytes(path, largest, folder).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: not UTF-8 text ({error.reason} at byte {error.start})") from error


def printable(value: Any) -> str:
    """Untrusted text on one line: 60 characters at most, what does not print escaped."""
    text = value if isinstance(value, str) and value.isprintable() else "nothing" if value is None else repr(value)
    return text if len(text) <= 60 else text[:57] + "..."


# ---------------------------------------------------------------------- JSON


def parse_json(source: str | bytes, where: str) -> Any:
    """The value of JSON text. Raises `InputError` for malformed text, too deep nesting, or a name given twice in one object."""
    try:
        return json.loads(source, object_pairs_hook=_without_duplicates)
    except json.JSONDecodeError as error:
        line = f":{error.lineno}" if error.lineno > 1 else ""
        raise InputError(f"{where}{line}: not JSON: {error.msg} at column {error.colno}") from error
    except RecursionError as error:
        raise InputError(f"{where}: not JSON that can be read: nested too deeply") from error
    except ValueError as error:
        raise InputError(f"{where}: not JSON that can be read: {str(error)[:200]}") from error


def parse_object(source: str | bytes, where: str) -> dict[str, Any]:
    """A JSON object of valid Unicode, nested at most `DEEPEST` deep. Raises `InputError` that begins with `where`."""
    found = parse_json(source, where)
    if not isinstance(found, dict):
        raise InputError(f"{where}: expected an object {{...}}, got {type(found).__name__}")
    _check_plain(found, where)
    return found


def read_object(path: Path, folder: Path) -> dict[str, Any]:
    """The JSON object in a file of a run folder, of at most `LARGEST_JSON` bytes."""
    return parse_object(read_text(path, LARGEST_JSON, folder), str(path))


def _without_duplicates(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) != len(pairs):
        names = [name for name, _ in pairs]
        raise ValueError(f"{next(name for name in names if names.count(name) > 1)!r} is given twice")
    return found


def _check_plain(value: Any, where: str, depth: int = 0) -> None:
    if depth > DEEPEST:
        raise InputError(f"{where}: nested more than {DEEPEST} deep")
    if isinstance(value, str):
        try:
            value.encode()
        except UnicodeEncodeError as error:
            raise InputError(f"{where}: holds text that is no Unicode ({printable(value)})") from error
    elif isinstance(value, dict):
        for key, inner in value.items():
            _check_plain(key, where, depth + 1)
            _check_plain(inner, where, depth + 1)
    elif isinstance(value, list):
        for inner in value:
            _check_plain(inner, where, depth + 1)


# ---------------------------------------------------------------------- arrays


def read_float_arrays(path: Path, folder: Path) -> dict[str, np.ndarray]:
    """The arrays of an .npz file of a run folder, as float32 where they are stored so or in less, else as float64."""
    found = read_arrays(path, LARGEST_ARCHIVE, folder=folder, largest=LARGEST_ARRAY)
    with np.errstate(over="ignore"):
        return {name: array.astype(_float_type(array.dtype)) for name, array in found.items()}


def read_arrays(
    path: Path,
    most_bytes: int = LARGEST_GIVEN,
    check: Callable[[Shape], None] | None = None,
    one: bool = False,
    folder: Path | None = None,
    largest: int | None = None,
) -> dict[str, np.ndarray]:
    """The arrays of an .npz archive: real numbers of any type, as stored.

    Sizes are checked before memory is taken for them.

    Args:
        path: the archive.
        most_bytes: of all arrays together.
        check: called with each array's shape before memory is taken for it; raises `InputError` for one that does not suit.
        one: whether there must be exactly one array.
        folder: where the file must lie; None for anywhere.
        largest: bytes of one array; None for `most_bytes`.

    Raises:
        InputError: there is none that can be read, an array is not of real numbers or does not have the size that its header
            declares, a name is given twice or leads out of the archive, or the arrays are too large.
    """
    if not exists(path):
        raise InputError(f"{path}: the file is missing")
    name = ""
    try:
        with open_regular(path, folder) as file, zipfile.ZipFile(file) as archive:
            members = archive.infolist()
            if len(members) > _MEMBERS:
                raise InputError(f"{path}: {len(members)} arrays, expected at most {_MEMBERS}")
            if one and len(members) != 1:
                raise InputError(f"{path}: expected an archive of one array, got {len(members)}")
            if sum(member.file_size for member in members) > most_bytes:
                raise InputError(f"{path}: its arrays are larger than {most_bytes} bytes together")
            _check_members(members, path)
            found: dict[str, np.ndarray] = {}
            for member in members:
                key = member.filename.removesuffix(".npy")
                name = printable(key)
                with archive.open(member) as packed:
                    where = f"{path}: {name}"
                    found[key] = _read_array(packed, member.file_size, where, check, largest or most_bytes)
            return found
    except InputError:
        raise
    except MemoryError as error:
        raise InputError(f"{path}: {name}: more than this machine's memory holds") from error
    except _UNREADABLE as error:
        field = f" {name}:" if name else ""
        raise InputError(f"{path}:{field} not an .npz archive that can be read ({_reason(error)})") from error


def read_array(path: Path, most_bytes: int = LARGEST_GIVEN, check: Callable[[Shape], None] | None = None) -> np.ndarray:
    """The array of real numbers in an .npy file; see `read_arrays`."""
    try:
        with open_regular(path) as file:
            size = os.fstat(file.fileno()).st_size
            if size > most_bytes:
                raise InputError(f"{path}: larger than {most_bytes} bytes")
            return _read_array(file, size, str(path), check, most_bytes)
    except InputError:
        raise
    except (OSError, ValueError, EOFError) as error:
        raise InputError(f"{path}: not a readable NumPy array ({_reason(error)})") from error


class _MalformedHeader(ValueError):
    """An array whose header does not describe plain numbers."""


def _reason(error: Exception) -> str:
    return "its header is malformed" if isinstance(error, _MalformedHeader) else type(error).__name__


def _read_array(
    file: IO[bytes], size: int, where: str, check: Callable[[Shape], None] | None, largest: int
) -> np.ndarray:
    """One array in NumPy's format, of `size` bytes with its header. Raises `InputError` or `_MalformedHeader`."""
    kind, columns_first, shape = _read_header(file, where)
    if any(side < 0 for side in shape) or len(shape) > _AXES:
        raise InputError(f"{where}: an array cannot have the shape {printable(str(shape))}")
    declared, there = math.prod(shape) * kind.itemsize, size - file.tell()
    if declared > largest or declared != there:
        raise InputError(f"{where}: declares the shape {printable(str(shape))}, {declared} bytes; {there} follow")
    if check is not None:
        check(shape)
    data = file.read(declared)
    if len(data) != declared or file.read(1):
        raise InputError(f"{where}: the array is cut short")
    return np.frombuffer(data, kind).reshape(shape, order="F" if columns_first else "C").copy()


def _read_header(file: IO[bytes], where: str) -> tuple[np.dtype, bool, Shape]:
    """Type, whether columns come first, and shape; the type is one of real numbers.

    By a pattern, not by NumPy's own reader: that takes a header for Python, and a hostile one for long.
    """
    start = file.read(8)
    if start[:6] != _MAGIC or len(start) < 8:
        raise _MalformedHeader
    if start[6:] not in (b"\1\0", b"\2\0"):
        raise InputError(f"{where}: not an .npy array of version 1 or 2")
    length = int.from_bytes(file.read(2 if start[6] == 1 else 4), "little")
    match = _HEADER.fullmatch(file.read(length)) if length <= _LONGEST_HEADER else None
    if match is None:
        raise _MalformedHeader
    if match[1] is None:
        raise InputError(f"{where}: expected real numbers, got records")
    try:
        kind = np.dtype(match[1].decode("ascii"))
    except (TypeError, ValueError, SyntaxError) as error:
        raise _MalformedHeader from error
    if kind.kind not in "fiub" or kind.hasobject:
        raise InputError(f"{where}: expected real numbers, got {printable(str(kind))}")
    shape = tuple(int(part) for part in match[3].replace(b"L", b"").split(b",") if part.strip())
    return kind, match[2] == b"True", shape


def _check_members(members: list[zipfile.ZipInfo], path: Path) -> None:
    """Refuse names that lead out of the archive or are given twice, and compressions that NumPy does not write."""
    seen: set[str] = set()
    for member in members:
        name, key = member.filename, member.filename.removesuffix(".npy")
        if name.startswith(("/", "\\")) or ".." in name.replace("\\", "/").split("/") or "\0" in name:
            raise InputError(f"{path}: {printable(name)}: a name that leads out of the archive")
        if key in seen:
            raise InputError(f"{path}: {printable(key)}: given twice")
        if member.compress_type not in _COMPRESSIONS:
            method = f"compression {member.compress_type}"
            raise InputError(f"{path}: {printable(key)}: not an .npz archive that can be read ({method})")
        seen.add(key)


def _float_type(kind: np.dtype) -> type:
    small = kind.kind == "b" or (kind.itemsize <= 4 and kind.kind == "f")
    return np.float32 if small else np.float64
