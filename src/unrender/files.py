"""Writing files so that none is ever seen half-written."""

from __future__ import annotations

import os
from pathlib import Path

from unrender.errors import InputError


def write(path: Path, data: bytes) -> Path:
    """Write `data` beside `path` and rename it into place, making the folder where it is missing. Returns `path`.

    Raises `InputError` where the place cannot be written to; what stood there before is then untouched.
    """
    beside = path.with_name(f"{path.name}.{os.getpid()}.part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            beside.write_bytes(data)
            beside.replace(path)
        finally:
            beside.unlink(missing_ok=True)
    except OSError as error:
        raise InputError(f"{path}: cannot be written: {error.strerror or error}") from error
    return path
