"""File operations counted, and a death at one of them.

Counted are those that change what lies below a folder: files opened to be written, written by descriptor, cut or flushed, and names made,
changed or removed. What compiled libraries write is not seen.
"""

from __future__ import annotations

import contextlib
import os
import signal
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NoReturn

__all__ = ["Killed", "die", "operations"]

_CHANGES = ("os.rename", "os.remove", "os.mkdir", "os.rmdir", "os.truncate", "os.link", "os.symlink")
_WRITES = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC


class Killed(BaseException):
    """Stands for a kill inside one process: nothing below the folder can be changed any more."""


class _Counter:
    """What is counted now."""

    def __init__(self, folder: Path, at: int | None, kill: Callable[[], Any]):
        self.prefix, self.at, self.kill = os.path.realpath(folder), at, kill
        self.names: list[str] = []
        self.inside = False

    def see(self, name: str, path: Any, folder: Any = None) -> None:
        if self.inside or not isinstance(path, (str, bytes, int, os.PathLike)):
            return
        self.inside = True
        try:
            place = _place(path, folder)
            if place != self.prefix and not place.startswith(self.prefix + os.sep):
                return
            self.names.append(f"{name} {os.path.relpath(place, self.prefix)}")
            if self.at is not None and len(self.names) > self.at:
                self.kill()
        finally:
            self.inside = False


_counting: _Counter | None = None
_listening = False


def _place(path: Any, folder: Any) -> str:
    if isinstance(path, int):
        return os.readlink(f"/proc/self/fd/{path}")
    text = os.fsdecode(path)
    if isinstance(folder, int) and folder >= 0 and not os.path.isabs(text):
        text = os.path.join(os.readlink(f"/proc/self/fd/{folder}"), text)
    where, name = os.path.split(os.path.abspath(text))
    return os.path.join(os.path.realpath(where), name)


def _hear(event: str, arguments: tuple[Any, ...]) -> None:
    counter = _counting
    if counter is None:
        return
    if event == "open":
        path, _, flags = arguments
        if isinstance(flags, int) and flags & _WRITES:
            counter.see("open", path)
    elif event == "os.rename":
        counter.see(event, arguments[1], arguments[3])
    elif event in _CHANGES:
        counter.see(event, arguments[0], arguments[-1] if event != "os.truncate" else None)


def die() -> NoReturn:
    """Kill this process."""
    os.kill(os.getpid(), signal.SIGKILL)
    raise SystemExit


def raise_killed() -> NoReturn:
    """Stand for a kill in this process."""
    raise Killed


@contextlib.contextmanager
def operations(
    folder: Path, at: int | None = None, kill: Callable[[], Any] = raise_killed, flush: bool = False
) -> Iterator[list[str]]:
    """Count the operations below a folder, each in one line that the list gets.

    Args:
        folder: where.
        at: how many are let through; the next one, and all after it, `kill`. None for all.
        kill: instead of the operation.
        flush: whether flushing reaches the disk; it takes most of the time, and no kill needs it.
    """
    global _counting, _listening
    if not _listening:
        sys.addaudithook(_hear)
        _listening = True
    counter = _counting = _Counter(folder, at, kill)
    fsync, pwrite = os.fsync, os.pwrite

    def counted_fsync(file: int) -> None:
        counter.see("fsync", file)
        if flush:
            fsync(file)

    def counted_pwrite(file: int, data: Any, offset: int) -> int:
        counter.see("pwrite", file)
        return pwrite(file, data, offset)

    os.fsync, os.pwrite = counted_fsync, counted_pwrite  # pyright: ignore[reportAttributeAccessIssue]
    try:
        yield counter.names
    finally:
        os.fsync, os.pwrite = fsync, pwrite
        _counting = None
