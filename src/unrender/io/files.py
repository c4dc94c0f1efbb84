"""Writing files and folders so that none is ever seen half-written, and none is lost once it was written.

After a power cut only that remains whose bytes, and whose name in its folder, were flushed to the disk (`fsync`): a file that was written
and renamed without it may be empty. So whatever is to last goes through `write`, `make_folder` and `replace_folder`. Reading is in
`bounded_files`.
"""

from __future__ import annotations

import contextlib
import ctypes
import errno
import fcntl
import io
import os
import re
import shutil
import sys
import zipfile
from collections.abc import Callable, Collection, Mapping
from pathlib import Path
from typing import TypeVar

import numpy as np

from unrender.core.checks import encode_text
from unrender.core.errors import InputError
from unrender.core.text import printable

_T = TypeVar("_T")

PARTIAL, RETIRED = "part", "old"
"""Ends of the names of what is being written, and of what is being removed."""
_TEMPORARY = re.compile(rf"\.?(.+)\.(\d{{1,10}})\.({PARTIAL}|{RETIRED})")
_NO_FOLDER_SYNC = (errno.EINVAL, errno.ENOTSUP, errno.EBADF, errno.EROFS)
_AT_FDCWD, _EXCHANGE, _SWAP = -100, 2, 2
_NO_EXCHANGE = (errno.ENOSYS, errno.EINVAL, errno.ENOTSUP, errno.EPERM)

COMPRESSED_BYTES = 1 << 26
"""Arrays of more bytes together are stored as they are: readers refuse a small file that unpacks to a large one."""
_HEADERS = 1 << 20


# ---------------------------------------------------------------------- files


def write(path: Path, data: bytes, durable: bool = True, name_too: bool = True) -> Path:
    """Write `data` beside `path` and rename it into place, making the folder where it is missing. Returns `path`.

    What processes that died while they wrote it have left is removed where the file is `durable`.

    Args:
        path: where.
        data: what the file is to hold.
        durable: whether its bytes are on the disk before it gets its name. False is for what nobody misses after a power cut.
        name_too: whether its name is on the disk, too, when this returns. False is for several files of one folder, which `sync_folder`
            then does for all; until then a power cut may leave what stood there before.

    Raises:
        InputError: the place cannot be written to; what stood there before is then untouched.
    """
    partial = temporary(path)
    try:
        make_folder(path.parent, durable)
        if durable:
            remove_leftovers(path.parent, (path.name,))
        try:
            with partial.open("wb") as file:
                file.write(data)
                if durable:
                    file.flush()
                    flush(file.fileno())
            partial.replace(path)
            if durable and name_too:
                sync_folder(path.parent)
        finally:
            partial.unlink(missing_ok=True)
    except OSError as error:
        raise InputError(f"{path}: cannot be written: {error.strerror or error}") from error
    return path


def check_member(name: str, where: str) -> None:
    """Raise `InputError` for the name of an array that no archive can hold, or that readers refuse: one that leads out of it."""
    if member_leads_out(name):
        raise InputError(f"{where} {printable(name)}: a name that leads out of an archive; rename the object")
    encode_text(name, f"{where} {printable(name)}")


def member_leads_out(name: str) -> bool:
    """Whether the name of an array in an archive could be that of a file elsewhere."""
    return name.startswith(("/", "\\")) or ".." in name.replace("\\", "/").split("/") or "\0" in name


def write_arrays(
    path: Path, arrays: Mapping[str, np.ndarray], compress: bool = True, durable: bool = True, name_too: bool = True
) -> Path:
    """Write an .npz archive of float32 arrays; see `write`.

    With `compress`, archives of at most `COMPRESSED_BYTES` are compressed.
    """
    buffer = io.BytesIO()
    values = {k: np.asarray(v, np.float32) for k, v in arrays.items()}
    small = sum(value.nbytes for value in values.values()) < COMPRESSED_BYTES - _HEADERS
    # Not by `numpy.savez`, which takes the name "file" for an argument of its own.
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED if compress and small else zipfile.ZIP_STORED) as archive:
        for key, value in values.items():
            with archive.open(f"{key}.npy", "w", force_zip64=True) as member:
                np.lib.format.write_array(member, value, allow_pickle=False)
    return write(path, buffer.getvalue(), durable, name_too)


def temporary(path: Path, end: str = PARTIAL) -> Path:
    """The name beside `path` under which this process writes it; see `remove_leftovers`."""
    return path.with_name(f"{path.name}.{os.getpid()}.{end}")


def flush(descriptor: int) -> None:
    """Have a file's bytes on the disk before this returns. Raises `OSError`."""
    full = getattr(fcntl, "F_FULLFSYNC", None)  # macOS: fsync alone leaves them in the drive's cache
    if full is not None:
        with contextlib.suppress(OSError):  # a file system without it
            fcntl.fcntl(descriptor, full)
            return
    os.fsync(descriptor)


# ---------------------------------------------------------------------- folders


def make_folder(folder: Path, durable: bool = True) -> None:
    """Make a folder, and those above it that are missing, on the disk unless `durable` is false. Raises `OSError`."""
    missing = [] if folder.is_dir() else [folder]
    while missing and not os.path.lexists(missing[-1].parent):
        missing.append(missing[-1].parent)
    for path in reversed(missing):
        path.mkdir(exist_ok=True)
        if durable:
            sync_folder(path.parent)


def sync_folder(folder: Path) -> None:
    """Have the names in a folder on the disk before this returns, where the file system can. Raises `OSError`."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        flush(descriptor)
    except OSError as error:
        if error.errno not in _NO_FOLDER_SYNC:
            raise
    finally:
        os.close(descriptor)


def sync_tree(folder: Path) -> None:
    """Have all files of a folder, and of those in it, on the disk before this returns. Raises `OSError`."""
    for place, _, names in os.walk(folder, topdown=False):
        for name in names:
            descriptor = os.open(Path(place, name), os.O_RDONLY | os.O_NOFOLLOW)
            try:
                flush(descriptor)
            finally:
                os.close(descriptor)
        sync_folder(Path(place))


def replace_folder(new: Path, place: Path) -> None:
    """Put the folder `new`, which lies beside `place`, there, in place of a folder that is there now. Raises `OSError`.

    At every instant one of the two is at `place`, where the system can exchange two names. Where it cannot, there is an instant
    without; `remove_leftovers`, by the next process that writes there, then puts the old one back.
    """
    sync_tree(new)
    old = place.with_name(f".{place.name}.{os.getpid()}.{RETIRED}")
    if not place.is_dir():
        new.rename(place)
    elif _exchange(new, place):
        old = new
    else:
        place.rename(old)
        sync_folder(place.parent)
        new.rename(place)
    sync_folder(place.parent)
    remove(old)


def _exchange(one: Path, other: Path) -> bool:
    """Exchange the names of two folders in one instant; False where this system cannot. Raises `OSError`."""
    names = os.fsencode(one), os.fsencode(other)
    try:
        library = ctypes.CDLL(None, use_errno=True)
        if sys.platform == "darwin":
            status = library.renamex_np(*names, _SWAP)
        else:
            status = library.renameat2(_AT_FDCWD, names[0], _AT_FDCWD, names[1], _EXCHANGE)
    except (OSError, AttributeError):
        return False
    if status == 0:
        return True
    number = ctypes.get_errno()
    if number in _NO_EXCHANGE:
        return False
    raise OSError(number, os.strerror(number), str(one))


# ---------------------------------------------------------------------- what processes left that died


def check_replaceable(place: Path, own: Collection[str], record: str, overwrite: bool, label: str, what: str) -> None:
    """Raise `InputError` where a folder to be written by `write_folder` would replace what is not its own.

    Leftovers of a process that died while it wrote there are removed first.

    Args:
        place: where the folder is to stand; it need not exist.
        own: names that such a folder may hold.
        record: that of `own` which tells such a folder from others.
        overwrite: whether an earlier one may be replaced.
        label: before the colon of the message, e.g. "--out judge".
        what: such a folder, e.g. "an earlier judgement".
    """
    remove_leftovers(place.parent, (place.name,))
    try:
        if place.exists() and not place.is_dir():
            raise InputError(f"{label}: a file, expected a folder")
        found = {path.name for path in place.iterdir()} if place.is_dir() else set()
    except OSError as error:
        raise InputError(f"{label}: {error.strerror or error}") from error
    if found and (record not in found or not found <= set(own)):
        raise InputError(f"{label}: the folder holds other things; give a new one")
    if found and not overwrite:
        raise InputError(f"{label}: holds {what}; give --overwrite (overwrite=True) to replace it")


def write_folder(place: Path, fill: Callable[[Path], _T]) -> _T:
    """Put a folder at `place`, in place of one that is there now, as `replace_folder` does; nothing is left of one that was not filled.

    Args:
        place: where it comes to stand; what is above it is made.
        fill: given an empty folder, writes what belongs there.

    Returns what `fill` does. Raises `OSError`, and what `fill` raises.
    """
    partial = place.with_name(f".{place.name}.{os.getpid()}.{PARTIAL}")
    try:
        make_folder(partial)
        found = fill(partial)
        replace_folder(partial, place)
        return found
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def remove_leftovers(folder: Path, names: Collection[str] | None = None) -> None:
    """Remove what processes that died left half-written or half-removed in a folder; not what lies in folders within.

    A folder that was moved away to be replaced, and was not, is put back. What belongs to another process that lives is left alone.

    Args:
        folder: where; nothing is done where it is none, or a link.
        names: only what was to become one of these; None for all.
    """
    if folder.is_symlink():
        return
    with contextlib.suppress(OSError):
        for path in sorted(folder.iterdir()):
            match = _TEMPORARY.fullmatch(path.name)
            if match is None or (names is not None and match[1] not in names) or _is_another_that_lives(int(match[2])):
                continue
            place = path.with_name(match[1])
            if match[3] == PARTIAL:
                remove(path)
            elif path.name.startswith(".") and path.is_dir():
                if os.path.lexists(place):
                    remove(path)
                else:
                    path.rename(place)
                    sync_folder(folder)


def remove(path: Path) -> None:
    """Remove a file, a link, or a folder with all that is in it; harmless where there is nothing."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        with contextlib.suppress(OSError):
            path.unlink()


def _is_another_that_lives(pid: int) -> bool:
    if pid in (0, os.getpid()):
        return False
    try:
        os.kill(pid, 0)  # signal 0 asks, and does nothing
    except (ProcessLookupError, OverflowError):
        return False
    except OSError:
        return True
    return True
