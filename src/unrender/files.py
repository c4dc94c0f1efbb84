"""Writing files so that none is ever seen half-written, and reading text."""

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


def read_text(path: Path) -> str:
    """The text of a UTF-8 file, without a byte order mark. Raises `InputError` where there is none that can be read."""
    try:
        return path.read_bytes().decode("utf-8-sig")
    except FileNotFoundError as error:
        raise InputError(f"{path}: no such file") from error
    except IsADirectoryError as error:
        raise InputError(f"{path}: a folder, expected a file") from error
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from error
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: not UTF-8 text ({error.reason} at byte {error.start})") from error
