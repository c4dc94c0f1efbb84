"""The cost of a run folder: checkpoints every 50 steps, and the history's lines, as shares of the run's time.

Problems of the gallery at their default size, by each method at its default settings, one with a texture of 1024²
texels, whose state is large, and one without a renderer, whose steps take almost no time. For each the steps' own time,
the time spent on the run folder (both on one clock, in one run), and the bytes of a checkpoint: every 50 steps exactly;
for the two extremes also as `optimize` chooses.
"""

from __future__ import annotations

import tempfile
import time
from pathlib import Path
from typing import Any

import unrender as ur
from benchmarks.internals import method_parts, time_run_folder
from benchmarks.runner.records import scratch

CASES: dict[str, tuple[str, dict[str, Any], str, dict[str, Any]]] = {
    "indirect-room, plain": ("indirect-room", {}, "plain", {}),
    "indirect-room, rcv": ("indirect-room", {}, "rcv", {}),
    "indirect-room, coupled with rcv": ("indirect-room", {}, "coupled", {"image": "rcv"}),
    "glossy-room, rcv": ("glossy-room", {}, "rcv", {}),
    "box2, smoothed": ("box2", {}, "smoothed", {}),
    "indirect-room of 256² pixels and 1024² texels, rcv": (
        "indirect-room",
        {"resolution": 256, "texture_resolution": 1024},
        "rcv",
        {},
    ),
    "quad, smoothed": ("quad", {}, "smoothed", {}),
}
BOTH = ("quad, smoothed", "indirect-room, rcv")
QUICK = {"case": ("indirect-room, rcv",), "steps": 4, "every": 2}


def measure(case: tuple[str, dict[str, Any], str, dict[str, Any]], steps: int, every: int | None) -> dict[str, Any]:
    """One run."""
    name, options, by, settings = case
    problem = ur.gallery.problem(name, **options, **({} if name == "quad" else {"reference_spp": 16}))
    spent: dict[str, list[float]] = {"history": [], "checkpoints": []}
    end, began = time_run_folder(spent), time.perf_counter()
    with tempfile.TemporaryDirectory(dir=scratch("checkpoints")) as folder:
        result = ur.optimize(
            problem, *method_parts(by, settings), steps=steps, run_directory=folder, checkpoint_every=every
        )
        size = max(path.stat().st_size for path in Path(folder).glob("checkpoints/*/state.safetensors"))
    end()
    history, checkpoints = sum(spent["history"]), sum(spent["checkpoints"])
    total = history + checkpoints + result.seconds
    return {
        "step_ms": 1e3 * result.seconds / steps,
        "checkpoint_ms": 1e3 * checkpoints / len(spent["checkpoints"]),
        "checkpoints": len(spent["checkpoints"]),
        "bytes": size,
        "share_checkpoints": checkpoints / total,
        "share_history": history / total,
        "wall_seconds": time.perf_counter() - began,
    }


def run(case: tuple[str, ...] = tuple(CASES), steps: int = 100, every: int = 50) -> dict[str, Any]:
    """Every case.

    Args:
        every: steps between checkpoints
    """
    found: dict[str, Any] = {}
    for name in case:
        intervals = {str(every): every, **({"default": None} if name in BOTH else {})}
        found[name] = {words: measure(CASES[name], steps, interval) for words, interval in intervals.items()}
        for words, row in found[name].items():
            print(name, f"every {words}:", {key: round(value, 4) for key, value in row.items()}, flush=True)
    return {"cases": found}
