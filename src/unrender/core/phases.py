"""What a long call is doing: phases with names and progress, and who listens to them.

Code that takes seconds names what it does, wherever it stands:

    from unrender.core import phases

    with phases.phase("reference images") as advance:
        for index in range(8):
            advance((index + 1) / 8)

Without a listener that costs next to nothing. A command line or a notebook listens, and shows what is going on.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Protocol


class Listener(Protocol):
    """Hears of the phases of all calls within `listening`. Phases may lie within one another."""

    def on_phase(self, name: str) -> None:
        """A phase begins."""
        ...

    def on_progress(self, share: float) -> None:
        """How far the innermost phase is, in [0, 1]."""
        ...

    def on_phase_end(self, name: str) -> None:
        """The phase has ended, by an exception or not."""
        ...


_listeners: ContextVar[tuple[Listener, ...]] = ContextVar("listeners", default=())


@contextmanager
def listening(listener: Listener) -> Iterator[None]:
    """Let a listener hear of the phases of everything called within."""
    token = _listeners.set((*_listeners.get(), listener))
    try:
        yield
    finally:
        _listeners.reset(token)


@contextmanager
def phase(name: str) -> Iterator[Callable[[float], None]]:
    """A phase of what is being done. Yields a function that takes how far it is, in [0, 1]."""
    listeners = _listeners.get()

    def advance(share: float) -> None:
        for listener in listeners:
            listener.on_progress(min(max(share, 0.0), 1.0))

    for listener in listeners:
        listener.on_phase(name)
    try:
        yield advance
    finally:
        for listener in reversed(listeners):
            listener.on_phase_end(name)


class Stopwatch:
    """Sums up the seconds of each phase; those of a phase within another count as its own alone.

    Attributes:
        seconds: {name: seconds}, in the order in which the phases first began.
    """

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._within: list[str] = []
        self._since = 0.0

    def on_phase(self, name: str) -> None:
        self._charge()
        self._within.append(name)
        self.seconds.setdefault(name, 0.0)

    def on_progress(self, share: float) -> None:
        """See `Listener.on_progress`."""

    def on_phase_end(self, name: str) -> None:
        del name
        self._charge()
        self._within.pop()

    def _charge(self) -> None:
        now = time.perf_counter()
        if self._within:
            self.seconds[self._within[-1]] += now - self._since
        self._since = now
