"""A link between two network interfaces that lets a given rate through, late by a given time. In a thread of this process."""

from __future__ import annotations

import fcntl
import os
import select
import struct
import threading
import time
from collections import deque

__all__ = ["DelayLine"]

_SET_INTERFACE, _TAP, _NO_HEADER = 0x400454CA, 0x0002, 0x1000
_LONGEST_FRAME = 1 << 16
_QUEUE = 4 << 20
"""Bytes that wait, each way; more are dropped."""


class DelayLine:
    """Two Ethernet interfaces (tap); a frame that enters one leaves the other. Each way has the rate to itself.

    Args:
        names: of the interfaces, which are made.
        megabits: a second.
        milliseconds: from one end to the other.
    """

    def __init__(self, names: tuple[str, str], megabits: float, milliseconds: float):
        self._ends = [_interface(name) for name in names]
        self._rate, self._delay = megabits * 1e6 / 8, milliseconds / 1e3
        self._stopped = threading.Event()
        self._thread = threading.Thread(target=self._carry, daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Carry no more; the interfaces are gone."""
        self._stopped.set()
        self._thread.join()
        for end in self._ends:
            os.close(end)

    def _carry(self) -> None:
        waiting: list[deque[tuple[float, bytes]]] = [deque(), deque()]
        free, size = [0.0, 0.0], [0, 0]
        while not self._stopped.is_set():
            now = time.perf_counter()
            due = min((queue[0][0] for queue in waiting if queue), default=now + 0.1)
            ready, _, _ = select.select(self._ends, [], [], max(due - now, 0.0))
            now = time.perf_counter()
            for way, end in enumerate(self._ends):
                if end in ready:
                    frame = os.read(end, _LONGEST_FRAME)
                    if size[way] + len(frame) <= _QUEUE:
                        free[way] = max(now, free[way]) + len(frame) / self._rate
                        waiting[way].append((free[way] + self._delay, frame))
                        size[way] += len(frame)
                while waiting[way] and waiting[way][0][0] <= now:
                    frame = waiting[way].popleft()[1]
                    size[way] -= len(frame)
                    try:
                        os.write(self._ends[1 - way], frame)
                    except OSError:
                        continue  # the other end is not up


def _interface(name: str) -> int:
    end = os.open("/dev/net/tun", os.O_RDWR | os.O_NONBLOCK)
    fcntl.ioctl(end, _SET_INTERFACE, struct.pack("16sH22x", name.encode(), _TAP | _NO_HEADER))
    return end
