"""Waiting for Ray in a thread of its own, so that handlers of signals run in Python's main thread and may raise anything."""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable
from typing import Any

_SLICE = 0.25
"""Longest wait of one call in seconds, and thereby longest delay of an exception that a handler raises."""
_ANSWER = 10.0
"""Seconds that a call may take to end after such an exception."""


class _Call:
    """A call, and its result once it has ended."""

    def __init__(self, function: Callable[[], Any]):
        self.ended = threading.Event()
        self._function = function
        self._value: Any = None
        self._error: BaseException | None = None

    def run(self) -> None:
        """Run the function and store its result."""
        try:
            self._value = self._function()
        except BaseException as error:
            self._error = error
        self.ended.set()

    def result(self) -> Any:
        """Return its value, or raise its exception."""
        if self._error is not None:
            raise self._error
        return self._value


class Waiter:
    """Carries out the calls of Ray that block.

    In the main thread, Ray's compiled code runs the handlers of signals itself while it waits. Where a handler raises `SystemExit`, the
    process then ends with status 1, and other exceptions than `KeyboardInterrupt` become a `SystemError`. In other threads it runs no
    handlers.
    """

    def __init__(self) -> None:
        self._calls: queue.SimpleQueue[_Call] = queue.SimpleQueue()
        self._started = False

    def call(self, function: Callable[[], Any]) -> Any:
        """Return the value of a function that soon ends. An exception of a handler is raised after it has ended."""
        if threading.current_thread() is not threading.main_thread():
            return function()
        if not self._started:
            threading.Thread(target=self._serve, daemon=True).start()
            self._started = True
        call = _Call(function)
        self._calls.put(call)
        try:
            # The system may deliver a signal to another thread, which does not wake this one. So the wait ends now and then.
            while not call.ended.wait(_SLICE):
                pass
        except BaseException:
            call.ended.wait(_ANSWER)  # nothing may leave Ray while a thread is in it
            raise
        return call.result()

    def wait(self, ray: Any, references: list[Any], count: int, seconds: float) -> list[Any]:
        """Return the references that are ready, once `count` of them are or after the given time."""
        while True:
            part = min(seconds, _SLICE)
            ready = self.call(lambda part=part: ray.wait(references, num_returns=count, timeout=part))[0]
            seconds -= part
            if len(ready) >= count or seconds <= 0:
                return ready

    def _serve(self) -> None:
        while True:
            self._calls.get().run()  # without a name, which would keep the last result
