"""Reading files that may have been made by anybody: bounded, inside their folder, or refused in one line.

A run folder travels: it is mailed, unpacked, served. What is read here is held to be hostile until it is shown to be plain: regular
files within the folder, JSON of modest size and depth, archives of numbers whose headers agree with their length.
"""

from __future__ import annotations

import json
import math
import os
import stat
import zipfile
import zlib
from pathlib import Path
from typing import IO, Any

import numpy as np

from unrender.core.errors import InputError

LARGEST_JSON = 16 << 20
"""Of a JSON file, in bytes."""
LARGEST_ARRAY = 1 << 30
"""Of one array as it lies in memory, in bytes."""
LARGEST_ARCHIVE = 8 << 30
"""Of all arrays of an archive, in bytes."""
DEEPEST = 32
"""Nesting of JSON."""
_MEMBERS = 10_000
_HEADER = 10_000
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


def exists(path: Path) -> bool:
    """Whether there is anything of this name, be it a link that leads nowhere."""
    return os.path.lexists(path)


def opened(path: Path, folder: Path) -> IO[bytes]:
    """Open a regular file that lies within `folder`, links followed.

    Raises:
        InputError: it is missing, lies elsewhere (a link out of the folder), or is no regular file (a pipe would wait for ever).
    """
    try:
        real = path.resolve(strict=True)
        if not real.is_relative_to(folder.resolve(strict=True)):
            raise InputError(f"{path}: leads out of the folder, expected a file within it")
        # Without waiting for a pipe's other end, and without following a link that took the file's place meanwhile.
        descriptor = os.open(real, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_NOFOLLOW", 0))
    except FileNotFoundError as error:
        raise InputError(f"{path}: no such file") from error
    except (OSError, RuntimeError) as error:  # a loop of links is a RuntimeError before Python 3.13
        raise InputError(f"{path}: cannot be read: {getattr(error, 'strerror', None) or error}") from error
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        raise InputError(f"{path}: not a regular file")
    return os.fdopen(descriptor, "rb")


def text(path: Path, folder: Path, largest: int = LARGEST_JSON) -> str:
    """The text of a UTF-8 file of at most `largest` bytes, without a byte order mark. Raises `InputError`."""
    try:
        with opened(path, folder) as file:
            data = file.read(largest + 1)
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from error
    if len(data) > largest:
        raise InputError(f"{path}: larger than {largest >> 20} MiB, which no run writes")
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: not UTF-8 text ({error.reason} at byte {error.start})") from error


def parse(source: str, where: str) -> dict[str, Any]:
    """A JSON object, its text writable and its nesting bounded. Raises `InputError` that begins with `where`."""
    try:
        found = json.loads(source)
    except json.JSONDecodeError as error:
        line = f":{error.lineno}" if error.lineno > 1 else ""
        raise InputError(f"{where}{line}: not JSON: {error.msg} at column {error.colno}") from error
    except (ValueError, RecursionError) as error:
        raise InputError(f"{where}: not JSON that can be read: {error}") from error
    if not isinstance(found, dict):
        raise InputError(f"{where}: expected an object {{...}}, got {type(found).__name__}")
    _check_plain(found, where)
    return found


def arrays(path: Path, folder: Path) -> dict[str, np.ndarray]:
    """The arrays of an .npz file: real numbers only, as float32 or float64. Pickled objects are refused.

    Every header is compared with the length of what follows before anything is allocated.
    """
    if not exists(path):
        raise InputError(f"{path}: the file is missing")
    name = ""
    try:
        with opened(path, folder) as file, zipfile.ZipFile(file) as archive:
            members = archive.infolist()
            if len(members) > _MEMBERS:
                raise InputError(f"{path}: {len(members)} arrays, expected at most {_MEMBERS}")
            if sum(member.file_size for member in members) > LARGEST_ARCHIVE:
                raise InputError(f"{path}: unpacks to more than {LARGEST_ARCHIVE >> 30} GiB")
            found: dict[str, np.ndarray] = {}
            for member in members:
                name = shown(member.filename.removesuffix(".npy"))
                _check_name(member.filename, path)
                key = member.filename.removesuffix(".npy")
                if key in found:
                    raise InputError(f"{path}: {name}: given twice")
                found[key] = _array(archive, member, f"{path}: {name}")
            return found
    except InputError:
        raise
    except MemoryError as error:
        raise InputError(f"{path}: {name}: more than this machine's memory holds") from error
    except _UNREADABLE as error:
        field = f" {name}:" if name else ""
        raise InputError(f"{path}:{field} not an .npz archive that can be read ({type(error).__name__})") from error


def shown(value: Any) -> str:
    """Untrusted text on one line: 60 characters at most, what does not print escaped."""
    written = value if isinstance(value, str) and value.isprintable() else "nothing" if value is None else repr(value)
    return written if len(written) <= 60 else written[:57] + "..."


def _array(archive: zipfile.ZipFile, member: zipfile.ZipInfo, where: str) -> np.ndarray:
    if member.compress_type not in _COMPRESSIONS:
        raise InputError(f"{where}: not an .npz archive that can be read (compression {member.compress_type})")
    with archive.open(member) as packed:
        version = np.lib.format.read_magic(packed)
        header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        if version not in ((1, 0), (2, 0)):
            raise InputError(f"{where}: not an .npy array of version 1 or 2")
        try:
            shape, columns_first, kind = header(packed, max_header_size=_HEADER)
        except Exception as error:  # NumPy parses it as Python, and passes on what its tokenizer and parser raise
            raise InputError(f"{where}: not an .npz archive that can be read ({type(error).__name__})") from error
        if kind.kind not in "fiub" or kind.hasobject:
            raise InputError(f"{where}: expected real numbers, got {shown(str(kind))}")
        if any(side < 0 for side in shape) or len(shape) > 8:
            raise InputError(f"{where}: an array cannot have the shape {shown(str(shape))}")
        size = math.prod(shape) * kind.itemsize
        there = member.file_size - packed.tell()
        if size > LARGEST_ARRAY or size != there:
            raise InputError(f"{where}: declares the shape {shown(str(shape))}, {size} bytes; {there} follow")
        data = packed.read(size)
        if len(data) != size or packed.read(1):
            raise InputError(f"{where}: the array is cut short")
    array = np.frombuffer(data, kind).reshape(shape, order="F" if columns_first else "C")
    with np.errstate(over="ignore"):
        return array.astype(np.float32 if kind.kind == "b" or (kind.itemsize <= 4 and kind.kind == "f") else np.float64)


def _check_name(name: str, path: Path) -> None:
    parts = name.replace("\\", "/").split("/")
    if name.startswith(("/", "\\")) or ".." in parts or "\0" in name:
        raise InputError(f"{path}: {shown(name)}: a name that leads out of the archive")


def _check_plain(value: Any, where: str, depth: int = 0) -> None:
    if depth > DEEPEST:
        raise InputError(f"{where}: nested more than {DEEPEST} deep")
    if isinstance(value, str):
        try:
            value.encode()
        except UnicodeEncodeError as error:
            raise InputError(f"{where}: holds text that is no Unicode ({shown(value)})") from error
    elif isinstance(value, dict):
        for key, inner in value.items():
            _check_plain(key, where, depth + 1)
            _check_plain(inner, where, depth + 1)
    elif isinstance(value, list):
        for inner in value:
            _check_plain(inner, where, depth + 1)
