"""Functions of device arrays that are traced once, recorded, and replayed."""

from __future__ import annotations

import functools
import gc
import logging
from collections.abc import Callable
from typing import Any

import drjit as dr

__all__ = ["FrozenFunction"]

_log = logging.getLogger("unrender")


class FrozenFunction:
    """A function that Dr.Jit records at its first call and replays at later ones. Where it cannot be recorded, it is traced each time.

    Mitsuba objects outside the scenes that it is handed, even unused ones, can keep Dr.Jit from recording.

    Args:
        function: of device arrays and Mitsuba objects. It may be called again after it failed.
        recordable: whether to record it at all.
    """

    def __init__(self, function: Callable[..., Any], recordable: bool = True):
        self._function = function
        self._frozen: Callable[..., Any] | None = dr.freeze(function) if recordable else None

    def __call__(self, prepare: Callable[[], None], *arguments: Any) -> Any:
        """What the function returns. `prepare` is called before each attempt, to undo what a failed one has left."""
        prepare()
        if self._frozen is None:
            return self._function(*arguments)
        try:
            return _without_garbage_collection(self._frozen, *arguments)
        except Exception as error:
            prepare()
            result = self._function(*arguments)  # its own error is the one that counts
            self._frozen = None
            _warn(str(error).partition("\n")[0])
            return result


def _without_garbage_collection(function: Callable[..., Any], *arguments: Any) -> Any:
    """Arrays that die in the middle of a recording abort the process."""
    enabled = gc.isenabled()
    gc.disable()
    try:
        return function(*arguments)
    finally:
        if enabled:
            gc.enable()


@functools.cache
def _warn(reason: str) -> None:
    """Once for each reason."""
    _log.warning("a kernel could not be recorded and is traced at every call, which is slower: %s", reason)
