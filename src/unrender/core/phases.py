"""Phases of a long call, with names and progress, and the listeners that receive them.

Code that takes seconds reports its phase:

    from unrender.core import phases

    with phases.phase("reference images") as advance:
        for index in range(8):
            advance((index + 1) / 8)

Without a listener the cost is negligible. The command line and notebooks register a listener that displays the progress.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar


class Listener:
    """Receiver of the phases of all calls within `listening`. Phases may nest. Override the methods of interest."""

    def on_phase(self, name: str) -> None:
        """Called at the start of a phase."""

    def on_progress(self, share: float) -> None:
        """Called with the progress of the innermost phase, in [0, 1]."""

    def on_phase_end(self, name: str) -> None:
        """Called at the end of the innermost phase, whether it returned or raised."""


_listeners: ContextVar[tuple[Listener, ...]] = ContextVar("listeners", default=())


@contextmanager
def listening(*listeners: Listener) -> Iterator[None]:
    """Send the phases of all calls within this context to listeners. One that already receives them receives them once."""
    receiving = list(_listeners.get())
    for listener in listeners:
        if not any(listener is each for each in receiving):
            receiving.append(listener)
    token = _listeners.set(tuple(receiving))
    try:
        yield
    finally:
        _listeners.reset(token)


@contextmanager
def phase(name: str) -> Iterator[Callable[[float], None]]:
    """Report a phase to the listeners. Yields a function that takes the progress in [0, 1]."""
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


class Stopwatch(Listener):
    """Listener that sums the seconds of each phase, in the order of their first starts. Time in a nested phase counts for the nested phase
    only."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._within: list[str] = []
        self._since = 0.0

    def on_phase(self, name: str) -> None:
        self._charge()
        self._within.append(name)
        self.seconds.setdefault(name, 0.0)

    def on_phase_end(self, name: str) -> None:
        self._charge()
        self._within.pop()

    def _charge(self) -> None:
        now = time.perf_counter()
        if self._within:
            self.seconds[self._within[-1]] += now - self._since
        self._since = now
