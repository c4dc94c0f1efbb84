"""Functions of device arrays that are traced once, recorded, and replayed."""

from __future__ import annotations

import functools
import gc
import logging
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import Any

import drjit as dr

from unrender.core.errors import InputError

_log = logging.getLogger("unrender")
_ATTEMPTS = 3
"""Failures in a row after which a function is traced at every call."""
_INDEPENDENT = "the argument does not depend on the input variable"
"""From Dr.Jit's error where a derivative was asked for and there is none."""


class FrozenFunction:
    """A function that Dr.Jit records at its first call and replays at later ones. Where it cannot be recorded, it is traced each time.

    A call through a pointer sees the objects of every scene in the process, those of the caller's own scenes too. Some of these, such as
    lights with textures, make tables at their first use, which no recording can hold. The traced call that follows a failure makes them, so
    the next call tries again, up to three times in a row.

    A replay that fails raises its error: out of memory, say, is no reason to trace at every call from then on.

    Mitsuba objects outside the scenes that it is handed, even unused ones, can keep Dr.Jit from recording.

    Args:
        function: of device arrays and Mitsuba objects. It may be called again after it failed.
        recordable: whether to record it at all.
    """

    def __init__(self, function: Callable[..., Any], recordable: bool = True):
        self._function = function
        self._tracing = _Tracing()
        self._frozen: Callable[..., Any] | None = _recorder(function, self._tracing) if recordable else None
        self._recorded, self._failures = False, 0
        self._threads = dr.thread_count()

    def __call__(self, prepare: Callable[[], None], *arguments: Any) -> Any:
        """What the function returns. `prepare` is called before each attempt, to undo what a failed one has left."""
        prepare()
        if self._frozen is None:
            return self._function(*arguments)
        if dr.thread_count() != self._threads:
            # A recording keeps sums with a place for each thread: replayed by more, it would write beyond them.
            self._threads, self._recorded = dr.thread_count(), False
            self._frozen = _recorder(self._function, self._tracing)
        self._tracing.happened = False
        try:
            result = _without_garbage_collection(self._frozen, *arguments)
        except Exception as error:
            if self._recorded and not self._tracing.happened:
                raise
            prepare()
            result = self._function(*arguments)  # its own error is the one that counts
            self._failures += 1
            self._frozen = _recorder(self._function, self._tracing) if self._failures < _ATTEMPTS else None
            if self._frozen is None:
                _warn(str(_first_cause(error)).partition("\n")[0])
        else:
            self._failures = 0
        self._recorded = True
        return result


class _Tracing:
    """Whether a call has run the function to record it, or tried to. An object of its own, so that recordings hold no cycle of
    references.
    """

    happened = False


def _recorder(function: Callable[..., Any], tracing: _Tracing) -> Callable[..., Any]:
    """The function, frozen. A replay does not run it, and so leaves `tracing` as it is."""

    def traced(*arguments: Any) -> Any:
        tracing.happened = True
        return function(*arguments)

    return dr.freeze(traced)


def _without_garbage_collection(function: Callable[..., Any], *arguments: Any) -> Any:
    """Arrays that die in the middle of a recording abort the process."""
    enabled = gc.isenabled()
    gc.disable()
    try:
        return function(*arguments)
    finally:
        if enabled:
            gc.enable()


@contextmanager
def naming(keys: Iterable[str]) -> Iterator[None]:
    """Turn Dr.Jit's error about a picture that depends on no parameter into an `InputError` that names the parameters."""
    try:
        yield
    except RuntimeError as error:
        if _INDEPENDENT not in str(_first_cause(error)):
            raise
        names = ", ".join(sorted(keys))
        raise InputError(
            f"parameter {names}: the picture depends on it through nothing that Mitsuba differentiates: --method smoothed"
        ) from error


def _first_cause(error: BaseException) -> BaseException:
    while error.__cause__ is not None:
        error = error.__cause__
    return error


@functools.cache
def _warn(reason: str) -> None:
    """Once for each reason."""
    _log.warning("a kernel could not be recorded and is traced at every call, which is slower: %s", reason)
