"""The user's cache folder: what can be computed again, kept so that it need not be.

It lies where the system wants such folders, or where the environment variable `UNRENDER_CACHE_DIR` says; an empty one switches it off.
In it:

    references/    reference images of the gallery's problems
    kernels/       kernels that Dr.Jit has compiled

Each part is bounded in size: what was not used for longest is removed. A folder that cannot be written is no error: nothing is kept then.
"""

from __future__ import annotations

import contextlib
import os
import stat
import time
from collections.abc import Iterator
from pathlib import Path

from unrender.backend import access

ENVIRONMENT_VARIABLE = "UNRENDER_CACHE_DIR"
REFERENCES, KERNELS = "references", "kernels"
LARGEST = {REFERENCES: 1 << 29, KERNELS: 1 << 30}
"""Bytes of each part at most."""

_DRJIT_VARIABLE = "DRJIT_CACHE_DIR"
"""Where Dr.Jit keeps compiled kernels; it reads this once, when it is imported."""
_STAMP = ".tidied"
_DAY = 86400.0

_bypassed = False


def root() -> Path | None:
    """Return the cache folder, whether it exists or not; None where it is switched off or the user has no home folder."""
    given = os.environ.get(ENVIRONMENT_VARIABLE)
    if given is not None:
        return Path(given).absolute() if given else None
    import platformdirs

    try:
        return Path(platformdirs.user_cache_dir("unrender", appauthor=False))
    except (RuntimeError, KeyError):  # HOME is not set, and this user has no entry in the password file
        return None


def folder(part: str) -> Path | None:
    """A part of the cache, `REFERENCES` or `KERNELS`, made where it is missing.

    Returns:
        None where the cache is switched off or bypassed, or the folder cannot be made or written, or where another user could put files
        there or replace it: a compiled kernel is code that runs as whoever loads it.
    """
    top = None if _bypassed else root()
    if top is None:
        return None
    place = top / part
    try:
        top.mkdir(mode=0o700, parents=True, exist_ok=True)
        place.mkdir(mode=0o700, exist_ok=True)
        if any(each.stat().st_mode & stat.S_IWOTH for each in (top, place)) or access.can_change(place):
            return None
    except OSError:
        return None
    return place if os.access(place, os.R_OK | os.W_OK | os.X_OK) else None


@contextlib.contextmanager
def bypassed() -> Iterator[None]:
    """Neither read nor write the cache meanwhile. Compiled kernels are Dr.Jit's own affair and stay."""
    global _bypassed
    before, _bypassed = _bypassed, True
    try:
        yield
    finally:
        _bypassed = before


def use_for_kernels() -> None:
    """Have Dr.Jit keep its kernels here, unless `DRJIT_CACHE_DIR` is set. To be called before Dr.Jit is imported."""
    if os.environ.get(_DRJIT_VARIABLE):
        return
    place = folder(KERNELS)
    if place is not None:
        os.environ[_DRJIT_VARIABLE] = str(place)
        tidy(place, LARGEST[KERNELS])


def tidy(place: Path, largest: int) -> None:
    """`trim`, at most once a day."""
    stamp = place / _STAMP
    with contextlib.suppress(OSError):
        if stamp.exists() and 0 <= time.time() - stamp.stat().st_mtime < _DAY:
            return
        stamp.touch()
        os.utime(stamp)
        trim(place, largest)


def trim(place: Path, largest: int) -> None:
    """Remove the files that were not used for longest until the others have `largest` bytes together at most.

    Whatever cannot be removed stays.
    """
    found = []
    with contextlib.suppress(OSError):
        for entry in os.scandir(place):
            if entry.name != _STAMP and entry.is_file(follow_symlinks=False):
                with contextlib.suppress(OSError):  # another process may have removed it
                    status = entry.stat(follow_symlinks=False)
                    found.append((max(status.st_mtime, status.st_atime), status.st_size, entry.path))
    total = sum(size for _, size, _ in found)
    for _, size, path in sorted(found):
        if total <= largest:
            break
        with contextlib.suppress(OSError):
            os.unlink(path)
            total -= size


def size(part: str) -> int:
    """Bytes of the files in a part of the cache."""
    top = root()
    if top is None:
        return 0
    try:
        return sum(entry.stat(follow_symlinks=False).st_size for entry in os.scandir(top / part) if entry.is_file())
    except OSError:
        return 0
