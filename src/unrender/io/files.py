"""Writing files so that none is ever seen half-written. Reading is in `bounded_files`."""

from __future__ import annotations

import io
import os
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from unrender.core.errors import InputError

__all__ = ["COMPRESSED_BYTES", "sync_folder", "write", "write_arrays"]

COMPRESSED_BYTES = 1 << 26
"""Arrays of more bytes together are stored as they are: readers refuse a small file that unpacks to a large one."""
_HEADERS = 1 << 20


def write(path: Path, data: bytes, durable: bool = False) -> Path:
    """Write `data` beside `path` and rename it into place, making the folder where it is missing. Returns `path`.

    With `durable`, it is on the disk before this returns.

    Raises `InputError` where the place cannot be written to; what stood there before is then untouched.
    """
    partial = path.with_name(f"{path.name}.{os.getpid()}.part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            with partial.open("wb") as file:
                file.write(data)
                if durable:
                    file.flush()
                    os.fsync(file.fileno())
            partial.replace(path)
            if durable:
                sync_folder(path.parent)
        finally:
            partial.unlink(missing_ok=True)
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


def write_arrays(path: Path, arrays: Mapping[str, np.ndarray], compress: bool = True) -> Path:
    """Write an .npz archive of float32 arrays. Raises `InputError` as `write`.

    With `compress`, archives of at most `COMPRESSED_BYTES` are compressed.
    """
    buffer = io.BytesIO()
    values = {k: np.asarray(v, np.float32) for k, v in arrays.items()}
    small = sum(value.nbytes for value in values.values()) < COMPRESSED_BYTES - _HEADERS
    save = np.savez_compressed if compress and small else np.savez
    save(buffer, allow_pickle=False, **values)
    return write(path, buffer.getvalue())
