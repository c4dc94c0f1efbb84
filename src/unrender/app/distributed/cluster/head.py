"""The head node of a cluster: whether it is there. Nothing here needs Ray."""

from __future__ import annotations

import socket
import time
from collections.abc import Callable

from unrender.core.errors import InputError

__all__ = ["HeadNode", "reach"]

_LOOK, _ANSWER, _PATIENCE = 3.0, 2.0, 15.0
"""Seconds between looks, that an answer may take, and without one until the head counts as lost. Ray itself would end the process, without
a word to its program, after 60."""


def reach(address: str, seconds: float) -> None:
    """Open a connection to HOST:PORT, and close it. Raises `OSError`."""
    host, _, port = address.rpartition(":")
    try:
        socket.create_connection((host.strip("[]"), int(port)), seconds).close()
    except OverflowError as error:
        raise OSError(str(error)) from error


class HeadNode:
    """Looks after the head node for whoever waits for workers: these go on for a while without it, but nothing can be started or found.

    Args:
        address: HOST:PORT; "" for none, which is never lost.
        clock: seconds.
        reach: see above.
    """

    def __init__(
        self,
        address: str = "",
        clock: Callable[[], float] = time.monotonic,
        reach: Callable[[str, float], None] = reach,
    ):
        self._address, self._clock, self._reach = address, clock, reach
        self._looked = self._answered = clock()

    def check(self) -> None:
        """Look, at most every few seconds. Raises `InputError` where it has not answered for a while."""
        now = self._clock()
        if not self._address or now - self._looked < _LOOK:
            return
        self._looked = now
        try:
            self._reach(self._address, _ANSWER)
            self._answered = self._clock()
        except OSError as error:
            if now - self._answered > _PATIENCE:
                reason = error.strerror or str(error)
                raise InputError(
                    f"workers: the cluster's head node at {self._address} is lost ({reason}); start one, and go on with unrender resume "
                    "or unrender sweep DIR"
                ) from error
