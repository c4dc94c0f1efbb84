"""The user's cache folder, for results that can be recomputed; and whether other users can change or read a folder.

Its place is the system's default, or the environment variable `UNRENDER_CACHE_DIR`. An empty value turns the cache off. It contains:

    references/    reference images of the gallery's problems
    kernels/       kernels that Dr.Jit has compiled

The size of each part is limited: the least recently used files are removed. If the folder is not writable, nothing is cached.
"""

from __future__ import annotations

import contextlib
import os
import stat
import time
from collections.abc import Iterator
from pathlib import Path

ENVIRONMENT_VARIABLE = "UNRENDER_CACHE_DIR"
REFERENCES, KERNELS = "references", "kernels"
LARGEST = {REFERENCES: 1 << 29, KERNELS: 1 << 30}
"""Maximum size of each part in bytes."""

_DRJIT_VARIABLE = "DRJIT_CACHE_DIR"  # Dr.Jit's folder of compiled kernels. Dr.Jit reads the variable once, on import.
_STAMP = ".tidied"
_DAY = 86400.0

_bypassed = False


def root() -> Path | None:
    """Return the cache folder, which need not exist; None if the cache is off or the user has no home folder."""
    setting = os.environ.get(ENVIRONMENT_VARIABLE)
    if setting is not None:
        return Path(setting).absolute() if setting else None
    import platformdirs

    try:
        return Path(platformdirs.user_cache_dir("unrender", appauthor=False))
    except (RuntimeError, KeyError):  # HOME is not set, and the password file has no entry for this user
        return None


def folder(part: str) -> Path | None:
    """Return a part of the cache, `REFERENCES` or `KERNELS`, and create its folder.

    Returns:
        The folder. None if the cache is off, bypassed or not writable, or if another user could replace it or add files: a compiled
        kernel is code that runs with this user's rights.
    """
    top = None if _bypassed else root()
    if top is None:
        return None
    place = top / part
    try:
        top.mkdir(mode=0o700, parents=True, exist_ok=True)
        place.mkdir(mode=0o700, exist_ok=True)
        if any(each.stat().st_mode & stat.S_IWOTH for each in (top, place)) or can_change(place):
            return None
    except OSError:
        return None
    return place if os.access(place, os.R_OK | os.W_OK | os.X_OK) else None


@contextlib.contextmanager
def bypassed() -> Iterator[None]:
    """Disable reading and writing of the cache within this context. Dr.Jit's kernel cache is not affected."""
    global _bypassed
    before, _bypassed = _bypassed, True
    try:
        yield
    finally:
        _bypassed = before


def use_for_kernels() -> None:
    """Make Dr.Jit cache its kernels here unless `DRJIT_CACHE_DIR` is set. Must be called before Dr.Jit is imported."""
    if os.environ.get(_DRJIT_VARIABLE):
        return
    place = folder(KERNELS)
    if place is not None:
        os.environ[_DRJIT_VARIABLE] = str(place)
        tidy(place, LARGEST[KERNELS])


def kernels_changed() -> int | None:
    """Return the time in nanoseconds at which a process last added or removed a kernel in Dr.Jit's cache folder; None if unknown."""
    place = os.environ.get(_DRJIT_VARIABLE) or os.path.expanduser("~/.drjit")
    try:
        return os.stat(place).st_mtime_ns
    except OSError:
        return None


def tidy(place: Path, largest: int) -> None:
    """Call `trim` unless it ran for this folder within the last day. A hidden file in the folder records the time."""
    stamp = place / _STAMP
    with contextlib.suppress(OSError):
        if stamp.exists() and 0 <= time.time() - stamp.stat().st_mtime < _DAY:
            return
        stamp.touch()
        os.utime(stamp)
        trim(place, largest)


def trim(place: Path, largest: int) -> None:
    """Remove the least recently used files until the rest have at most `largest` bytes. A file that cannot be removed stays."""
    entries = []
    with contextlib.suppress(OSError):
        for entry in os.scandir(place):
            if entry.name != _STAMP and entry.is_file(follow_symlinks=False):
                with contextlib.suppress(OSError):  # another process may have removed it
                    status = entry.stat(follow_symlinks=False)
                    entries.append((max(status.st_mtime, status.st_atime), status.st_size, entry.path))
    total = sum(size for _, size, _ in entries)
    for _, size, path in sorted(entries):
        if total <= largest:
            break
        with contextlib.suppress(OSError):
            os.unlink(path)
            total -= size


def size(part: str) -> int:
    """Return the number of bytes of the files in a part of the cache; 0 if there is none."""
    top = root()
    if top is None:
        return 0
    try:
        return sum(entry.stat(follow_symlinks=False).st_size for entry in os.scandir(top / part) if entry.is_file())
    except OSError:
        return 0


_UIDS = Path("/proc/self/uid_map")
_OVERFLOW = Path("/proc/sys/kernel/overflowuid")


def can_change(folder: Path, shared: bool = False) -> str:
    """Return how other users could change entries of a folder or replace it, as a phrase for a message; "" if they cannot. In a `shared`
    one, as the system's temporary folder, others may add entries, and the sticky bit must be set."""
    place = Path(os.path.realpath(folder))
    for above in (place, *place.parents):
        if _shielded(above.parent):  # the shielding folder itself may still be replaced, so its parents are checked too
            continue
        status = above.stat()
        mode = stat.S_IMODE(status.st_mode)
        if status.st_uid not in _trusted():
            return f"{above} belongs to user {status.st_uid}"
        sticky = mode & stat.S_ISVTX and (shared or above != place)
        if mode & 0o022 and not sticky:
            return f"{above} is writable by others (mode {mode:04o})"
    return ""


def can_read(path: Path) -> str:
    """Return how other users can read or write a file, as a phrase for a message; "" if they cannot."""
    path = Path(os.path.realpath(path))
    if _shielded(path.parent):
        return ""
    status = path.stat()
    mode = stat.S_IMODE(status.st_mode)
    if status.st_uid not in _trusted():
        return f"{path} belongs to user {status.st_uid}"
    return f"{path} is {'readable' if mode & 0o044 else 'writable'} by others (mode {mode:04o})" if mode & 0o066 else ""


def _shielded(folder: Path) -> bool:
    """Return whether no other user can enter the folder, because it or a parent is closed to them."""
    for place in (folder, *folder.parents):
        status = place.stat()
        if status.st_uid == os.geteuid() and not stat.S_IMODE(status.st_mode) & 0o011:
            return True
    return False


def _trusted() -> set[int]:
    """Return the accepted owners of a folder: this user, root, and in a container the owner of files without a mapped id."""
    owners = {0, os.geteuid()}
    try:
        if _UIDS.read_text().split() != ["0", "0", "4294967295"]:
            owners.add(int(_OVERFLOW.read_text()))
    except (OSError, ValueError):  # not Linux
        pass
    return owners
