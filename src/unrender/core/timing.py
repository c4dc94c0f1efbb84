"""Clock of tests that have a time limit: seconds, or the cost of their renderings, which is the same on every machine.

A run whose user gave steps and no seconds counts renderings, so that its end does not depend on the machine or its load. The unit is still
the second: about that of two processor cores.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar

_PATHS, _LAUNCH_PATHS = 1 << 21, 1 << 13
"""Paths of a second, and paths that a launch without any costs as much as."""

_spent: ContextVar[list[float] | None] = ContextVar("spent", default=None)


@contextmanager
def counting(counts: bool = True) -> Iterator[None]:
    """Count renderings within this context if `counts` is true; otherwise seconds."""
    token = _spent.set([0.0] if counts else None)
    try:
        yield
    finally:
        _spent.reset(token)


def scheduled(thread: str = "/proc/thread-self") -> tuple[float, float]:
    """Return the seconds that a thread, by default this one, has computed and has waited for a processor; zeros if unknown."""
    try:
        with open(f"{thread}/schedstat") as file:
            ran, waited, _ = (1e-9 * int(word) for word in file.read().split())
    except (OSError, ValueError):
        return 0.0, 0.0
    return ran, waited


def counts() -> bool:
    """Return whether renderings are counted."""
    return _spent.get() is not None


def now() -> float:
    """Return the time in seconds from an arbitrary origin."""
    spent = _spent.get()
    return time.perf_counter() if spent is None else spent[0]


def cost(paths: float, launches: int = 1) -> float:
    """Return the cost of renderings in seconds."""
    return (paths + launches * _LAUNCH_PATHS) / _PATHS


def add(paths: float, launches: int = 1) -> None:
    """Count a rendering."""
    if (spent := _spent.get()) is not None:
        spent[0] += cost(paths, launches)
