"""One thread at a time: Dr.Jit and Mitsuba keep state that two threads would share, and abort the process where they meet."""

from __future__ import annotations

import contextlib
import functools
import os
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import ParamSpec, TypeVar

from unrender.core.errors import InputError

_Parameters = ParamSpec("_Parameters")
_Returned = TypeVar("_Returned")


@dataclass
class _Turn:
    """Whose turn it is.

    Attributes:
        changed: notified when a turn ends.
        thread: whose turn it is; None where it is nobody's.
        doing: what that thread does, the innermost last: a name, and whether it may take long.
    """

    changed: threading.Condition = field(default_factory=threading.Condition)
    thread: threading.Thread | None = None
    doing: list[tuple[str, bool]] = field(default_factory=list)


_turn = _Turn()


def _begin_anew() -> None:
    """In the child of a fork, whose other threads are gone."""
    _turn.__init__()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_begin_anew)


def exclusive(
    what: str, long: bool = False
) -> Callable[[Callable[_Parameters, _Returned]], Callable[_Parameters, _Returned]]:
    """A decorator: calls from different threads take turns, those within one thread may be nested.

    A call waits for another thread's, except where that may take `long`: then it raises `InputError`, one line that says so.

    Args:
        what: the name of the function, for that line.
        long: whether it may take hours, as a run does.
    """

    def decorate(function: Callable[_Parameters, _Returned]) -> Callable[_Parameters, _Returned]:
        @functools.wraps(function)
        def call(*arguments: _Parameters.args, **named: _Parameters.kwargs) -> _Returned:
            with _taking_turns(what, long):
                return function(*arguments, **named)

        return call

    return decorate


@contextlib.contextmanager
def _taking_turns(what: str, long: bool) -> Iterator[None]:
    me = threading.current_thread()
    with _turn.changed:
        while _turn.thread not in (None, me):
            if slow := next((name for name, takes_long in _turn.doing if takes_long), ""):
                raise InputError(
                    f"{what}: {slow} goes on in another thread, and one process computes for one thread at a time; "
                    "wait until it has ended, or use another process"
                )
            _turn.changed.wait()
        _turn.thread = me
        _turn.doing.append((what, long))
    try:
        yield
    finally:
        with _turn.changed:
            _turn.doing.pop()
            if not _turn.doing:
                _turn.thread = None
                _turn.changed.notify_all()
