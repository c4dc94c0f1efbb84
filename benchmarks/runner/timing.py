"""Timing in turns (A B A B ...), so that a machine whose speed changes slows all contenders alike."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from benchmarks.internals import dr, mi

Times = dict[str, list[float]]


def work_time() -> float:
    """Seconds of work, for differences: the processor's time of this process, which others on the machine do not lengthen; on a GPU, whose
    work is none of the processor's, the wall clock's once what was begun has ended."""
    if (mi.variant() or "").startswith("cuda"):
        dr.sync_thread()
        return time.perf_counter()
    return time.process_time()


def turns(
    contenders: Mapping[str, Callable[[int], Any]],
    repeats: int = 15,
    warm: int = 4,
    clock: Callable[[], float] = time.perf_counter,
) -> Times:
    """Milliseconds by a clock of each call of each contender, a function of the turn's number that must evaluate what it makes."""
    times: Times = {name: [] for name in contenders}
    for number in range(warm + repeats):
        for name, contender in contenders.items():
            dr.sync_thread()
            began = clock()
            contender(number)
            dr.sync_thread()
            if number >= warm:
                times[name].append(1e3 * (clock() - began))
    return times


def medians(times: Times) -> dict[str, float]:
    """The median of each contender."""
    return {name: float(np.median(found)) for name, found in times.items()}


def percentiles(values: Any) -> list[float]:
    """Median, 10th and 90th percentile."""
    return [float(q) for q in np.percentile(values, [50, 10, 90])]
