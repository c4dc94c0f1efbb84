"""Checks whether other users of this machine can read or change files and folders. Independent of Ray."""

from __future__ import annotations

import os
import stat
from pathlib import Path

_UIDS = Path("/proc/self/uid_map")
_OVERFLOW = Path("/proc/sys/kernel/overflowuid")


def can_change(folder: Path, shared: bool = False) -> str:
    """Return how other users could change entries of a folder or replace it, as a phrase for a message; "" if they cannot.

    Args:
        folder: existing folder.
        shared: whether others may add entries, as in the system's temporary folder, whose sticky bit must be set.
    """
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
