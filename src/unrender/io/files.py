"""Atomic and durable writing of files and folders.

A power cut preserves only what was flushed to the disk (`fsync`): a file's bytes, and its name in the folder. A file that was written and
renamed without flushing may be empty afterwards. So everything that must last is written by `write`, `make_folder` and `replace_folder`.
Reading is in `bounded_files`.
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
from collections.abc import Callable, Collection, Iterator, Mapping
from pathlib import Path
from typing import TypeVar

import numpy as np

from unrender.core.checks import encode_text
from unrender.core.errors import InputError
from unrender.core.text import printable

_T = TypeVar("_T")

PARTIAL, RETIRED = "part", "old"
"""Suffixes of the names of files that are being written or removed."""
_TEMPORARY = re.compile(rf"\.?(.+)\.(\d{{1,10}})\.({PARTIAL}|{RETIRED})")
_NO_FOLDER_SYNC = (errno.EINVAL, errno.ENOTSUP, errno.EBADF, errno.EROFS)
_AT_FDCWD, _EXCHANGE, _SWAP = -100, 2, 2
_NO_EXCHANGE = (errno.ENOSYS, errno.EINVAL, errno.ENOTSUP, errno.EPERM)

COMPRESSED_BYTES = 1 << 26
"""Total size from which arrays are stored without compression, because readers reject a small file that unpacks to a large one."""
_HEADERS = 1 << 20


@contextlib.contextmanager
def input_errors(where: str) -> Iterator[None]:
    """Raise `InputError` with a message that begins with `where` for an `OSError` of the statements inside."""
    try:
        yield
    except OSError as error:
        raise InputError(f"{where}: {error.strerror or error}") from error


# ---------------------------------------------------------------------- files


def write(path: Path, data: bytes, durable: bool = True, name_too: bool = True) -> Path:
    """Write `data` to a temporary file next to `path` and rename it. Creates the folder if necessary. Returns `path`.

    If `durable`, leftovers of processes that died while writing the file are removed first.

    Args:
        data: content of the file.
        durable: whether the bytes are flushed to the disk before the file is renamed. False suits files that may be lost in a power cut.
        name_too: whether the name is also flushed before this returns. False suits several files of one folder, which one call of
            `sync_folder` flushes together; until then a power cut may restore the previous file.

    Raises:
        InputError: the file cannot be written; a previous file is then unchanged.
    """
    partial = temporary(path)
    with input_errors(f"{path}: cannot be written"):
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
    return path


def check_member(name: str, where: str) -> None:
    """Raise `InputError` for an array name that an archive cannot contain, or that readers reject because it points outside."""
    if member_leads_out(name):
        raise InputError(f"{where} {printable(name)}: a name that leads out of an archive; rename the object")
    encode_text(name, f"{where} {printable(name)}")


def member_leads_out(name: str) -> bool:
    """Return whether the name of an array in an archive could refer to a file outside of it."""
    return name.startswith(("/", "\\")) or ".." in name.replace("\\", "/").split("/") or "\0" in name


def write_arrays(
    path: Path, arrays: Mapping[str, np.ndarray], compress: bool = True, durable: bool = True, name_too: bool = True
) -> Path:
    """Write an .npz archive of float32 arrays; see `write`. With `compress`, archives of less than `COMPRESSED_BYTES` are compressed."""
    buffer = io.BytesIO()
    values = {k: np.asarray(v, np.float32) for k, v in arrays.items()}
    small = sum(value.nbytes for value in values.values()) < COMPRESSED_BYTES - _HEADERS
    # `numpy.savez` cannot store an array named "file", which is one of its arguments.
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED if compress and small else zipfile.ZIP_STORED) as archive:
        for key, value in values.items():
            with archive.open(f"{key}.npy", "w", force_zip64=True) as member:
                np.lib.format.write_array(member, value, allow_pickle=False)
    return write(path, buffer.getvalue(), durable, name_too)


def temporary(path: Path) -> Path:
    """Return the temporary name next to `path` under which this process writes it."""
    return path.with_name(f"{path.name}.{os.getpid()}.{PARTIAL}")


def flush(descriptor: int) -> None:
    """Flush a file's bytes to the disk. Raises `OSError`."""
    full = getattr(fcntl, "F_FULLFSYNC", None)  # on macOS, fsync alone leaves the bytes in the drive's cache
    if full is not None:
        with contextlib.suppress(OSError):  # the file system does not support it
            fcntl.fcntl(descriptor, full)
            return
    os.fsync(descriptor)


# ---------------------------------------------------------------------- folders


def make_folder(folder: Path, durable: bool = True) -> None:
    """Create a folder and its missing parents, and flush them to the disk if `durable`. Raises `OSError`."""
    missing = [] if folder.is_dir() else [folder]
    while missing and not os.path.lexists(missing[-1].parent):
        missing.append(missing[-1].parent)
    for path in reversed(missing):
        path.mkdir(exist_ok=True)
        if durable:
            sync_folder(path.parent)


def sync_folder(folder: Path) -> None:
    """Flush the names in a folder to the disk, if the file system supports it. Raises `OSError`."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        flush(descriptor)
    except OSError as error:
        if error.errno not in _NO_FOLDER_SYNC:
            raise
    finally:
        os.close(descriptor)


def sync_tree(folder: Path) -> None:
    """Flush all files of a folder and its subfolders to the disk. Raises `OSError`."""
    for place, _, names in os.walk(folder, topdown=False):
        for name in names:
            descriptor = os.open(Path(place, name), os.O_RDONLY | os.O_NOFOLLOW)
            try:
                flush(descriptor)
            finally:
                os.close(descriptor)
        sync_folder(Path(place))


def replace_folder(new: Path, place: Path) -> None:
    """Move the folder `new` to `place` in the same parent, and replace an existing folder. Raises `OSError`.

    If the system can exchange two names, one of the two folders is at `place` at every instant. Otherwise there is an instant with
    neither; after a crash at that point, `remove_leftovers` of the next writer restores the old folder.
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
    """Exchange the names of two folders atomically; False if this system does not support it. Raises `OSError`."""
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


# ---------------------------------------------------------------------- leftovers of dead processes


def check_replaceable(place: Path, own: Collection[str], record: str, overwrite: bool, label: str, what: str) -> None:
    """Raise `InputError` if `write_folder` would replace a folder that has other files than its `own`, or lacks `record`, or if not
    `overwrite`.

    Leftovers of a process that died while writing it are removed first. Messages begin with `label` and call such a folder `what`.
    """
    remove_leftovers(place.parent, (place.name,))
    with input_errors(label):
        if place.exists() and not place.is_dir():
            raise InputError(f"{label}: a file, expected a folder")
        present = {path.name for path in place.iterdir()} if place.is_dir() else set()
    if present and (record not in present or not present <= set(own)):
        raise InputError(f"{label}: the folder holds other things; give a new one")
    if present and not overwrite:
        raise InputError(f"{label}: holds {what}; give --overwrite (overwrite=True) to replace it")


def write_folder(place: Path, fill: Callable[[Path], _T], label: str) -> _T:
    """Create or replace the folder `place` as `replace_folder` does, and return the result of `fill`. If that fails, nothing is left
    behind.

    Raises `InputError`, beginning with `label`, if the folder cannot be written, and whatever `fill` raises.
    """
    partial = place.with_name(f".{place.name}.{os.getpid()}.{PARTIAL}")
    try:
        with input_errors(label):
            make_folder(partial)
            result = fill(partial)
            replace_folder(partial, place)
        return result
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def remove_leftovers(folder: Path, names: Collection[str] | None = None) -> None:
    """Remove what dead processes left half-written or half-removed in a folder, under these `names` or any; subfolders are not searched.

    A folder that was moved away for a replacement that did not happen is restored. Files of other live processes are not touched.
    """
    with contextlib.suppress(OSError):
        if folder.is_symlink():
            return
        for path in sorted(folder.iterdir()):
            match = _TEMPORARY.fullmatch(path.name)
            if match is None or (names is not None and match[1] not in names):
                continue
            if int(match[2]) not in (0, os.getpid()) and is_alive(int(match[2])):
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
    """Remove a file, a link, or a folder with its contents; does nothing if there is none."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        with contextlib.suppress(OSError):
            path.unlink()


def is_alive(pid: int) -> bool:
    """Return whether a process of this machine exists; True if the system does not tell."""
    try:
        os.kill(pid, 0)  # signal 0 only checks for existence
    except (ProcessLookupError, OverflowError):
        return False
    except OSError:
        return True
    return True
