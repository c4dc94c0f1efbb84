"""Reading of untrusted files within limits on size and nesting.

Run folders, problem files and arrays are mailed, unpacked and served, so this module treats them as hostile. It accepts regular files
(within a given folder), text and JSON of limited size and depth, and archives of numbers whose headers agree with their length. Nothing
is executed, unpickled or unpacked to a file. All functions raise `InputError` with a one-line message that begins with the path.
"""

from __future__ import annotations

import itertools
import json
import os
import stat
import zipfile
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np

from unrender.core.errors import InputError
from unrender.core.text import did_you_mean, printable, shorten, visible
from unrender.io import files
from unrender.io.npy_format import MalformedHeader, Shape, read_npy

LARGEST_TEXT = 1 << 28
"""Largest text file in bytes."""
LARGEST_JSON = 16 << 20
"""Largest JSON file of a run folder in bytes."""
LARGEST_ARRAY = 1 << 30
"""Largest array of a run folder in bytes, unpacked."""
LARGEST_ARCHIVE = 8 << 30
"""Largest total of the arrays of a run folder's archive in bytes, unpacked."""
LARGEST_INPUT = 1 << 32
"""Largest total of the arrays of a problem's input file in bytes."""
DEEPEST = 32
"""Largest nesting depth of JSON."""
MOST_VALUES = 200_000
"""Largest number of values of a JSON text: a million names take seconds to read."""

_MEMBERS = 10_000
_MOST_NEIGHBOURS = 1000  # names in a folder to which a missing name is compared
_BYTES_PER_BYTE = 100  # largest compression ratio; zeros reach a thousand
_LARGEST_DIRECTORY = 1 << 20  # largest directory of an archive in bytes, which contains its members' names
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
)  # the methods that NumPy writes; others may use more memory than they declare


def exists(path: Path) -> bool:
    """Return whether anything has this name, including a broken link."""
    return os.path.lexists(path)


def kind(path: Path) -> str:
    """Return the kind of `path`, links followed: "file", "folder", "other" (a pipe, a socket, a device), or "" if it does not exist. Raises
    `InputError` if the name is too long, or a parent folder cannot be entered."""
    try:
        mode = path.stat().st_mode
    except (FileNotFoundError, NotADirectoryError, ValueError):  # ValueError: a name with a zero byte
        return ""
    except OSError as error:
        raise InputError(f"{shorten(str(path), 300)}: cannot be read: {error.strerror or error}") from error
    return "file" if stat.S_ISREG(mode) else "folder" if stat.S_ISDIR(mode) else "other"


def no_file(path: Path) -> str:
    """Return why a path is not a regular file, as a phrase: what it is instead, or a similar name in the folder."""
    try:
        if path.exists():
            return "not a file"
        neighbours = [
            visible(entry.name)
            for entry in itertools.islice(path.parent.iterdir(), _MOST_NEIGHBOURS)
            if entry.is_file() and (path.suffix != ".toml" or entry.name.endswith(".toml"))
        ]
    except (OSError, ValueError):  # ValueError: a name with a zero byte
        neighbours = []
    # Equal endings make short names look alike, such as m.png and room.png.
    near = {name for name in neighbours if did_you_mean(path.stem, [Path(name).stem])}
    return f"no such file{did_you_mean(path.name, sorted(near))}"


# ---------------------------------------------------------------------- bytes and text


def open_regular(path: Path, folder: Path | None = None) -> IO[bytes]:
    """Open a regular file, links followed. Raises `InputError` if it is missing, outside of `folder` (None for any), or not a regular file,
    whose reading may block."""
    try:
        real = path.resolve(strict=True)
        if folder is not None and not real.is_relative_to(folder.resolve(strict=True)):
            raise InputError(f"{path}: leads out of the folder, expected a file within it")
        # Checked before opening, because opening may trigger a device.
        if not stat.S_ISREG(mode := real.stat().st_mode):
            raise InputError(f"{path}: {_not_regular(mode)}")
        # O_NONBLOCK avoids blocking on a pipe; O_NOFOLLOW rejects a link that has replaced the file since the check.
        descriptor = os.open(real, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_NOFOLLOW", 0))
    except FileNotFoundError as error:
        raise InputError(f"{path}: {no_file(path)}") from error
    except InputError:
        raise
    except (OSError, RuntimeError, ValueError) as error:  # a loop of links is a RuntimeError before Python 3.13
        raise InputError(f"{path}: cannot be read: {getattr(error, 'strerror', None) or error}") from error
    mode = os.fstat(descriptor).st_mode
    if not stat.S_ISREG(mode):
        os.close(descriptor)
        raise InputError(f"{path}: {_not_regular(mode)}")
    return os.fdopen(descriptor, "rb")


def _not_regular(mode: int) -> str:
    return "a folder, expected a file" if stat.S_ISDIR(mode) else "not a regular file"


def read_bytes(path: Path, largest: int, folder: Path | None = None) -> bytes:
    """Return the bytes of a regular file of at most `largest` bytes; see `open_regular`."""
    with files.input_errors(f"{path}: cannot be read"), open_regular(path, folder) as file:
        data = file.read(largest + 1)
    if len(data) > largest:
        units = ((20, "MiB"), (10, "KiB"), (0, "bytes"))
        size = next(f"{largest >> shift} {unit}" for shift, unit in units if largest >= 1 << shift or not shift)
        raise InputError(f"{path}: larger than {size}, which no such file is")
    return data


def read_text(path: Path, largest: int = LARGEST_TEXT, folder: Path | None = None) -> str:
    """Return the text of a UTF-8 file of at most `largest` bytes, without a byte order mark; see `open_regular`."""
    try:
        return read_bytes(path, largest, folder).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: not UTF-8 text ({error.reason} at byte {error.start})") from error


# ---------------------------------------------------------------------- JSON


def parse_json(source: str | bytes, where: str) -> Any:
    """Parse JSON. Raises `InputError` for malformed text, deep nesting, more than `MOST_VALUES` values, or a name given twice."""
    commas = source.count(b",") if isinstance(source, bytes) else source.count(",")
    if commas > MOST_VALUES:
        raise InputError(f"{where}: more than {MOST_VALUES} values, which no such file holds")
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
    """Parse a JSON object of valid Unicode with at most `DEEPEST` levels. Raises `InputError` that begins with `where`."""
    value = parse_json(source, where)
    if not isinstance(value, dict):
        raise InputError(f"{where}: expected an object {{...}}, got {type(value).__name__}")
    _check_plain(value, where)
    return value


def read_object(path: Path, folder: Path) -> dict[str, Any]:
    """Read the JSON object of a file in a run folder, of at most `LARGEST_JSON` bytes."""
    return parse_object(read_text(path, LARGEST_JSON, folder), str(path))


def _without_duplicates(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    value = dict(pairs)
    if len(value) != len(pairs):
        seen: set[str] = set()
        for name, _ in pairs:
            if name in seen:
                raise ValueError(f"{printable(name)!r} is given twice")
            seen.add(name)
    return value


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
    """Read an .npz file in a run folder. Booleans and floats of at most 32 bits become float32, all others float64."""
    arrays = read_arrays(path, LARGEST_ARCHIVE, folder=folder, largest=LARGEST_ARRAY)
    with np.errstate(over="ignore"):
        return {name: array.astype(_float_type(array.dtype)) for name, array in arrays.items()}


def read_arrays(
    path: Path,
    most_bytes: int = LARGEST_INPUT,
    check: Callable[[Shape], None] | None = None,
    one: bool = False,
    folder: Path | None = None,
    largest: int | None = None,
) -> dict[str, np.ndarray]:
    """Read the arrays of an .npz archive: real numbers of any type, as stored.

    Sizes are checked before memory is allocated.

    Args:
        most_bytes: largest total size of the arrays.
        check: function of each array's shape, called before memory is allocated; raises `InputError` for an unsuitable one.
        one: whether there must be exactly one array.
        folder: folder that must contain the file; None for any.
        largest: largest size of one array in bytes; None for `most_bytes`.

    Raises:
        InputError: the archive is missing or unreadable, an array is not real or its size differs from its header, a name is a duplicate
            or points outside of the archive, or the arrays are too large.
    """
    if not exists(path):
        raise InputError(f"{path}: the file is missing")
    name = ""
    try:
        with open_regular(path, folder) as file, _open_archive(file, path) as archive:
            members = archive.infolist()
            if len(members) > _MEMBERS:
                raise InputError(f"{path}: {len(members)} arrays, expected at most {_MEMBERS}")
            if one and len(members) != 1:
                raise InputError(f"{path}: expected an archive of one array, got {len(members)}")
            unpacked, packed = sum(member.file_size for member in members), os.fstat(file.fileno()).st_size
            if unpacked > most_bytes:
                raise InputError(f"{path}: its arrays are larger than {most_bytes} bytes together")
            if unpacked > max(files.COMPRESSED_BYTES, _BYTES_PER_BYTE * packed):
                what = f"its arrays have {unpacked} bytes in {packed}"
                raise InputError(f"{path}: {what}; if that is right, save them without compression")
            _check_members(members, path)
            arrays: dict[str, np.ndarray] = {}
            for member in members:
                key = member.filename.removesuffix(".npy")
                name = printable(key)
                with archive.open(member) as packed:
                    where = f"{path}: {name}"
                    arrays[key] = read_npy(packed, member.file_size, where, check, largest or most_bytes)
            return arrays
    except InputError:
        raise
    except MemoryError as error:
        raise InputError(f"{path}: {name}: more than this machine's memory holds") from error
    except _UNREADABLE as error:
        field = f" {name}:" if name else ""
        raise InputError(f"{path}:{field} not an .npz archive that can be read ({_reason(error)})") from error


def read_array(path: Path, most_bytes: int = LARGEST_INPUT, check: Callable[[Shape], None] | None = None) -> np.ndarray:
    """Read the array of real numbers of an .npy file; see `read_arrays`."""
    try:
        with open_regular(path) as file:
            size = os.fstat(file.fileno()).st_size
            if size > most_bytes:
                raise InputError(f"{path}: larger than {most_bytes} bytes")
            return read_npy(file, size, str(path), check, most_bytes)
    except InputError:
        raise
    except (OSError, ValueError, EOFError) as error:
        raise InputError(f"{path}: not a readable NumPy array ({_reason(error)})") from error


def _reason(error: Exception) -> str:
    return "its header is malformed" if isinstance(error, MalformedHeader) else type(error).__name__


@dataclass
class _BoundedReads:
    """A file that limits single reads, None for no limit: `zipfile` reads a whole directory before it reports the number of members."""

    file: IO[bytes]
    where: Path
    most: int | None = _LARGEST_DIRECTORY

    def read(self, size: int = -1) -> bytes:
        """Read at most `size` bytes. Raises `InputError` if more than the limit would be read."""
        if self.most is None or 0 <= size <= self.most:
            return self.file.read(size)
        data = self.file.read(self.most + 1)
        if len(data) > self.most:
            raise InputError(f"{self.where}: names more than {_MEMBERS} arrays")
        return data

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        return self.file.seek(offset, whence)

    def tell(self) -> int:
        return self.file.tell()

    def seekable(self) -> bool:
        return True


def _open_archive(file: IO[bytes], path: Path) -> zipfile.ZipFile:
    reads: Any = _BoundedReads(file, path)
    archive = zipfile.ZipFile(reads)
    reads.most = None
    return archive


def _check_members(members: list[zipfile.ZipInfo], path: Path) -> None:
    """Reject names that point outside of the archive or are duplicates, and compression methods that NumPy does not write."""
    seen: set[str] = set()
    for member in members:
        name, key = member.filename, member.filename.removesuffix(".npy")
        if files.member_leads_out(name):
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
