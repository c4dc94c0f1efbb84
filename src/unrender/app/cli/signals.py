"""Handling of Ctrl-C and SIGTERM: one line and a specific exit status, at any time and any number of signals.

A run handles both signals itself, and stops regularly after its step (`runs.run.interruptible`). Otherwise, and at a second signal, the
command is interrupted immediately. A further signal during this ends the process at once. Data that a run has written remains, as after
a kill.

Python's handlers wait for the end of compiled code. A thread reports long waits, and lets a second signal end the process. The exit does
not wait for launched kernels: all data that must remain is written before.
"""

from __future__ import annotations

import contextlib
import os
import select
import signal
import sys
import threading
import time
from types import FrameType, TracebackType
from typing import Any

from unrender.core.signals import GRACEFUL

INPUT, ENVIRONMENT, FAILED, DOUBTFUL = 2, 3, 4, 5
"""Exit status for invalid input, a missing feature of the machine, a failed run, and failed verification by fresh pictures."""
INTERRUPTED, TERMINATED = 130, 143
"""Exit status after Ctrl-C and SIGTERM: 128 plus the number of the signal, as shells and schedulers expect."""
WORDS = {
    FAILED: "failed: the lines above name the cause",
    DOUBTFUL: "the result is doubtful: see the warnings",
    INTERRUPTED: "interrupted",
    TERMINATED: "terminated",
}
"""{exit status: line on standard error} for exits without an error message."""

_LATER, _LONGEST = 0.02, 1.5
"""Seconds after which a signal during an import is repeated, and after which the command ends even during an import."""
_SILENT, _STUCK = 1.5, 0.5
"""Seconds for which compiled code can delay a signal before a line reports it, and a second signal before the process ends."""
WAITING = "waiting for the end of the current work (a kernel, a picture, a worker); interrupt again to end at once"
_SHOW_CURSOR = b"\x1b[?25h"


class Signals:
    """Handles SIGINT and SIGTERM within its context, in the main thread. `status` is 130 or 143 after the first signal, else 0.

    If the `process` ends with the command, later signals are ignored, because all files are written.
    """

    def __init__(self, process: bool):
        self.status = 0
        self._process = process
        self._before: dict[int, Any] = {}
        self._deferred: set[int] = set()
        self._first: dict[int, float] = {}
        self._watch: _Watch | None = None

    def __enter__(self) -> Signals:
        if threading.current_thread() is threading.main_thread():
            if self._process:
                with contextlib.suppress(OSError, RuntimeError):  # out of memory for a thread
                    self._watch = _Watch()
            for number in (signal.SIGINT, signal.SIGTERM):
                if number == signal.SIGINT or signal.getsignal(number) is not signal.SIG_IGN:
                    self._before[number] = signal.signal(number, _Handler(self))
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for number, handler in self._before.items():
            signal.signal(number, signal.SIG_IGN if self._process else handler)
        if self._watch is not None:
            self._watch.close()

    def receive(self, number: int, frame: FrameType | None) -> None:
        """Interrupt the command by `KeyboardInterrupt`; end the process at a further signal.

        During an import, the signal is sent again later, since compiled code that imports modules may abort at an exception.
        """
        waited = time.monotonic() - self._first.setdefault(number, time.monotonic())
        if self.status or number in self._deferred or waited > _LONGEST:
            _leave(self.status or 128 + number)
        if _is_importing(frame):
            self._deferred.add(number)
            timer = threading.Timer(_LATER, self._send_again, (number,))
            timer.daemon = True
            with contextlib.suppress(RuntimeError):  # out of memory for a thread: the next signal ends the command
                timer.start()
            return
        self.status = 128 + number
        raise KeyboardInterrupt

    def _send_again(self, number: int) -> None:
        self._deferred.discard(number)
        if self._watch is not None:
            self._watch.own += 1
        os.kill(os.getpid(), number)


class _Watch:
    """Thread that receives signals at once, even while compiled code keeps the main thread from it; `own` counts those sent to itself."""

    def __init__(self) -> None:
        self.own = 0
        self._main = threading.main_thread().ident
        self._read, self._write = os.pipe()
        os.set_blocking(self._write, False)
        threading.Thread(target=self._run, daemon=True).start()
        self._before = signal.set_wakeup_fd(self._write, warn_on_full_buffer=False)

    def close(self) -> None:
        signal.set_wakeup_fd(self._before)
        os.close(self._write)

    def _run(self) -> None:
        signals, number, reported, last = 0, 0, False, (0, 0)
        while True:
            again = signals > 1
            waits = signals and (again or not reported)
            heard = select.select([self._read], [], [], (_STUCK if again else _SILENT) if waits else None)[0]
            place = self._place()
            if not heard:
                if place == last and again:
                    _leave(128 + number)
                if place == last and not reported:
                    reported = True
                    os.write(2, f"unrender: {WAITING}\n".encode())
                last = place
            elif not (data := os.read(self._read, 1)):
                os.close(self._read)
                return
            elif self.own:
                self.own -= 1
            elif data[0] in (signal.SIGINT, signal.SIGTERM):
                signals, number, last = signals + 1, data[0], place

    def _place(self) -> tuple[int, int]:
        """Return the instruction at which the main thread is."""
        frame = sys._current_frames().get(self._main or 0)
        return (0, 0) if frame is None else (id(frame), frame.f_lasti)


class _Handler:
    """A handler of signals in whose place a run may put its own."""

    def __init__(self, signals: Signals):
        self._signals = signals
        setattr(self, GRACEFUL, True)

    def __call__(self, number: int, frame: FrameType | None) -> None:
        self._signals.receive(number, frame)


def _leave(status: int) -> None:
    if sys.stderr.isatty():
        os.write(2, _SHOW_CURSOR)
    os.write(2, f"unrender: {WORDS[status]}\n".encode())
    os._exit(status)


def _is_importing(frame: FrameType | None) -> bool:
    while frame is not None:
        if frame.f_code.co_filename.startswith("<frozen importlib"):
            return True
        frame = frame.f_back
    return False
