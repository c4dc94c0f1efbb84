"""Writing files so that none is ever seen half-written, and reading ones that may be malformed or worse."""

from __future__ import annotations

import io
import json
import math
import os
import re
import zipfile
import zlib
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from unrender.core.errors import InputError

MOST_TEXT = 1 << 28
"""Bytes of the longest text that is read: hours of history."""

MOST_ARRAYS = 1 << 32
"""Bytes of all arrays of an archive together, unpacked."""

_MAGIC = b"\x93NUMPY"
_LONGEST_HEADER = 1 << 12  # far more than the name of a type and a shape take
_HEADER = re.compile(
    rb"\s*\{\s*'descr':\s*'([<>=|]?[a-zA-Z?]\d{0,2})',\s*'fortran_order':\s*(True|False),"
    rb"\s*'shape':\s*\((\s*(?:\d{1,18}L?(?:\s*,\s*\d{1,18}L?)*\s*,?)?\s*)\),?\s*\}\s*"
)


def write(path: Path, data: bytes, durable: bool = False) -> Path:
    """Write `data` beside `path` and rename it into place, making the folder where it is missing. Returns `path`.

    With `durable`, it is on the disk before this returns.

    Raises `InputError` where the place cannot be written to; what stood there before is then untouched.
    """
    pair_request = path.with_name(f"{path.name}.{os.getpid()}.part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            with pair_request.open("wb") as file:
                file.write(data)
                if durable:
                    file.flush()
                    os.fsync(file.fileno())
            pair_request.replace(path)
            if durable:
                sync_folder(path.parent)
        finally:
            pair_request.unlink(missing_ok=True)
    except OSError as error:
        raise InputError(f"{path}: cannot be written: {error.strerror or error}") from error
    return path


def sync_folder(folder: Path) -> None:
    """Have the names in a folder on the disk before this returns. Raises `OSError`."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def read_bytes(path: Path, most: int) -> bytes:
    """A file's bytes. Raises `InputError` where it is no file that can be read, or longer than `most` bytes."""
    try:
        with path.open("rb") as file:
            data = file.read(most + 1)
    except FileNotFoundError as error:
        raise InputError(f"{path}: no such file") from error
    except IsADirectoryError as error:
        raise InputError(f"{path}: a folder, expected a file") from error
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from error
    if len(data) > most:
        raise InputError(f"{path}: longer than {most} bytes, which no such file is")
    return data


def read_text(path: Path, most: int = MOST_TEXT) -> str:
    """The text of a UTF-8 file, without a byte order mark. Raises `InputError` where there is none that can be read."""
    try:
        return read_bytes(path, most).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: not UTF-8 text ({error.reason} at byte {error.start})") from error


def parse_json(text: str | bytes, where: str) -> Any:
    """What JSON text says. Raises `InputError` for what is none, is nested too deeply, or gives a name twice in one object."""
    try:
        return json.loads(text, object_pairs_hook=_unrepeated)
    except json.JSONDecodeError as error:
        line = f":{error.lineno}" if error.lineno > 1 else ""
        raise InputError(f"{where}{line}: not JSON: {error.msg} at column {error.colno}") from error
    except RecursionError as error:
        raise InputError(f"{where}: not JSON that can be read: nested too deeply") from error
    except ValueError as error:
        raise InputError(f"{where}: not JSON that can be read: {str(error)[:200]}") from error


def _unrepeated(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) != len(pairs):
        names = [name for name, _ in pairs]
        raise ValueError(f"{next(name for name in names if names.count(name) > 1)!r} is given twice")
    return found


def write_arrays(path: Path, arrays: Mapping[str, np.ndarray], compress: bool = True) -> Path:
    """Write an .npz archive of float32 arrays. Raises `InputError` as `write`."""
    buffer = io.BytesIO()
    save = np.savez_compressed if compress else np.savez
    save(buffer, allow_pickle=False, **{k: np.asarray(v, np.float32) for k, v in arrays.items()})
    return write(path, buffer.getvalue())


def read_arrays(
    path: Path,
    most_bytes: int = MOST_ARRAYS,
    check: Callable[[tuple[int, ...]], None] | None = None,
    one: bool = False,
) -> dict[str, np.ndarray]:
    """The arrays of an .npz archive: real numbers of any kind, as stored.

    Sizes are checked before memory is taken for them, pickled objects are never loaded, and nothing is unpacked to a file.

    Args:
        path: the archive.
        most_bytes: of all arrays together.
        check: shown each array's shape before memory is taken for it; raises `InputError` for one that does not suit.
        one: whether there must be exactly one array.

    Raises:
        InputError: there is none that can be read, an array is not of real numbers or does not have the size that its header
            declares, a name is given twice, or all are larger than `most_bytes`.
    """
    if not path.exists():
        raise InputError(f"{path}: the file is missing")
    name = ""
    try:
        with zipfile.ZipFile(path) as archive:
            members = archive.infolist()
            names = [member.filename for member in members]
            if len(set(names)) != len(names):
                raise InputError(f"{path}: {_repeated(names)} is there twice")
            if one and len(members) != 1:
                raise InputError(f"{path}: expected an archive of one array, got {len(members)}")
            if sum(member.file_size for member in members) > most_bytes:
                raise InputError(f"{path}: its arrays are larger than {most_bytes} bytes together")
            found = {}
            for member in members:
                name = member.filename.removesuffix(".npy")
                with archive.open(member) as file:
                    found[name] = _read_array(file, member.file_size, f"{path}: {name}", check)
            return found
    except (InputError, MemoryError):
        raise
    except (OSError, ValueError, EOFError, KeyError, NotImplementedError, RuntimeError, zlib.error) as error:
        raise _unreadable(path, name, error) from error
    except (zipfile.BadZipFile, zipfile.LargeZipFile) as error:
        raise _unreadable(path, name, error) from error


def read_array(
    path: Path, most_bytes: int = MOST_ARRAYS, check: Callable[[tuple[int, ...]], None] | None = None
) -> np.ndarray:
    """The array of real numbers in a .npy file; see `read_arrays`. Raises `InputError`."""
    try:
        with path.open("rb") as file:
            size = os.fstat(file.fileno()).st_size
            if size > most_bytes:
                raise InputError(f"{path}: larger than {most_bytes} bytes")
            return _read_array(file, size, str(path), check)
    except InputError:
        raise
    except (OSError, ValueError, EOFError) as error:
        raise InputError(f"{path}: not a readable NumPy array") from error


def _unreadable(path: Path, name: str, error: Exception) -> InputError:
    field = f" {name}:" if name else ""
    return InputError(f"{path}:{field} not an .npz archive that can be read ({type(error).__name__})")


def _repeated(names: Iterable[str]) -> str:
    seen: set[str] = set()
    return next(name for name in names if name in seen or seen.add(name))


def _read_array(
    file: BinaryIO | Any, size: int, where: str, check: Callable[[tuple[int, ...]], None] | None = None
) -> np.ndarray:
    """One array in NumPy's format, of `size` bytes with its header."""
    start = file.read(8)
    if start[:6] != _MAGIC or start[6:] not in (b"\1\0", b"\2\0", b"\3\0"):
        raise InputError(f"{where}: not a readable NumPy array")
    length = int.from_bytes(file.read(2 if start[6] == 1 else 4), "little")
    # By a pattern, not by NumPy's own reader: that takes a header for Python, and a hostile one for long.
    match = _HEADER.fullmatch(file.read(length)) if length <= _LONGEST_HEADER else None
    if match is None:
        raise InputError(f"{where}: not a readable NumPy array: its header is malformed, or not of plain numbers")
    dtype, transposed = np.dtype(match[1].decode()), match[2] == b"True"
    shape = tuple(int(part) for part in match[3].replace(b"L", b"").split(b",") if part.strip())
    if dtype.kind not in "fiub":
        raise InputError(f"{where}: expected real numbers, got {dtype}")
    if len(shape) > 32:
        raise InputError(f"{where}: no array has {len(shape)} axes")
    expected = math.prod(shape) * dtype.itemsize
    if expected != size - file.tell():
        raise InputError(f"{where}: its header declares {expected} bytes of numbers, there are {size - file.tell()}")
    if check is not None:
        check(shape)
    array = np.frombuffer(file.read(expected), dtype)
    return array.reshape(shape[::-1]).T.copy() if transposed else array.reshape(shape).copy()
