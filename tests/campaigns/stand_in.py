"""Workers that render nothing: each answers after a given time for each of its views, with gradients of the right shapes.

What is left of a step is what a dealt run costs beside rendering, for as many workers as a machine can start.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any
from unittest import mock

import numpy as np

from unrender.app.distributed.actor import ViewWorker
from unrender.app.distributed.messages import Call, Reply

__all__ = ["StandIn", "stand_ins"]


class StandIn(ViewWorker):
    """A Ray actor in the place of `ViewWorker`."""

    seconds = 0.0
    """Of each view."""

    def __init__(self, variant: str, threads: int):
        del threads
        self._variant = variant
        self._views: dict[int, tuple[int, ...]] = {}
        self._arrays: dict[int, np.ndarray] = {}

    def hold(self, share: int, views: tuple[int, ...], blob: bytes) -> None:
        """Note which views."""
        del blob
        self._views[share] = views

    def drop(self, share: int) -> None:
        """Hold it no more."""
        self._views.pop(share, None)

    def run(self, share: int, call: Call, arrays: dict[int, Any]) -> Reply:
        """What `ViewShare.run` answers, of zeros and ones."""
        began, views = time.perf_counter(), self._views[share]
        for number, value in arrays.items():
            self._arrays[number] = value
        for number in call.drop_arrays:
            self._arrays.pop(number, None)
        gradient = {key: np.full(self._arrays[n].shape, 1 + share, np.float64) for key, n in call.parameters.items()}
        time.sleep(max(self.seconds * len(views) - (time.perf_counter() - began), 0.0))
        return Reply(gradient, {}, {}, dict.fromkeys(views, 1.0), 1, {}, {}, time.perf_counter() - began)


@contextmanager
def stand_ins(seconds: float) -> Iterator[None]:
    """Within, dealt runs have workers that answer after so many seconds for each view."""
    kind = type("StandIn", (StandIn,), {"seconds": seconds, "__module__": "__main__"})
    with mock.patch("unrender.app.distributed.ray_hosts.ViewWorker", kind):
        yield
