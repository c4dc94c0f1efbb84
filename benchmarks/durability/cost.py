"""What flushing costs a run."""

from __future__ import annotations

import os
import tempfile
import time
from typing import Any

import unrender as ur
from benchmarks.internals import method_parts
from benchmarks.runner.records import scratch

__all__ = ["measure"]

SECONDS = 20.0
PROBLEMS: dict[str, tuple[str, dict[str, Any]]] = {
    "rcv": ("indirect-room", {"reference_spp": 16}),
    "meta": ("indirect-room", {"reference_spp": 16}),
    "coupled": ("indirect-room", {"reference_spp": 16}),
    "smoothed": ("quad", {}),
}


def measure(method: str) -> dict[str, Any]:
    """A run at default settings, for some seconds, with checkpoints as `optimize` chooses."""
    ur.use()
    name, options = PROBLEMS[method]
    problem = ur.gallery.problem(name, **options)
    spent: list[float] = []
    fsync = os.fsync

    def timed(file: int) -> None:
        began = time.perf_counter()
        fsync(file)
        spent.append(time.perf_counter() - began)

    os.fsync = timed  # pyright: ignore[reportAttributeAccessIssue]
    try:
        with tempfile.TemporaryDirectory(dir=scratch("durability")) as folder:
            began = time.perf_counter()
            result = ur.optimize(problem, *method_parts(method), seconds=SECONDS, run_directory=folder)
            wall = time.perf_counter() - began
    finally:
        os.fsync = fsync
    return {
        "problem": name,
        "steps": result.steps,
        "seconds": result.seconds,
        "wall_seconds": wall,
        "flushes": len(spent),
        "flush_seconds": sum(spent),
        "share": sum(spent) / (result.seconds + sum(spent)),
    }
