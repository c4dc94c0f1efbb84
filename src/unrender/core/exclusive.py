"""A lock that serialises calls from several threads. Dr.Jit and Mitsuba share state between threads, and abort on concurrent use."""

from __future__ import annotations

import contextlib
import os
import sys
import threading
from collections.abc import Iterator
from dataclasses import dataclass, field

from unrender.core.errors import InputError


@dataclass
class _Turn:
    """Owner of the lock: its thread or None, a condition that is notified of its release, and the stack of its calls, (name, whether it may
    take long)."""

    changed: threading.Condition = field(default_factory=threading.Condition)
    thread: threading.Thread | None = None
    doing: list[tuple[str, bool]] = field(default_factory=list)


_turn = _Turn()


def _reset() -> None:
    """Reset the lock in the child of a fork, where the other threads no longer exist."""
    _turn.__init__()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_reset)


@contextlib.contextmanager
def _own_settings() -> Iterator[None]:
    """Undo `suspend_grad`, with which gradients are 0, and packet operations where `JitFlag.Debug` is set: it drops valid writes of packets
    (Dr.Jit 1.5), and with them a part of the gradients of textures."""
    if (dr := sys.modules.get("drjit")) is None:
        yield
        return
    packets = dr.flag(dr.JitFlag.PacketOps) and not dr.flag(dr.JitFlag.Debug)
    with dr.resume_grad(), dr.scoped_set_flag(dr.JitFlag.PacketOps, packets):
        yield


@contextlib.contextmanager
def exclusive(what: str, long: bool = False) -> Iterator[None]:
    """Serialise calls from different threads, as a decorator or in a `with` statement. Calls within one thread may nest.

    A call waits for the other thread's call to end. It raises `InputError` instead if the other call is marked `long`: it may take hours,
    as a run does. Settings of the caller that would change gradients do not apply within.
    """
    me = threading.current_thread()
    with _turn.changed:
        while _turn.thread not in (None, me):
            if slow := next((name for name, takes_long in _turn.doing if takes_long), ""):
                raise InputError(
                    f"{what}: {slow} is running in another thread, and one process computes for one thread at a time; "
                    "wait until it ends, or use another process"
                )
            _turn.changed.wait()
        _turn.thread = me
        _turn.doing.append((what, long))
    try:
        with _own_settings():
            yield
    finally:
        with _turn.changed:
            _turn.doing.pop()
            if not _turn.doing:
                _turn.thread = None
                _turn.changed.notify_all()
