"""What keeping a run folder costs: checkpoints every 50 steps, and the history's lines, as shares of the run's time.

    python benchmarks/checkpoints/run.py [--steps 100]

Problems of the gallery at their default size, by each method at its default settings, one with a texture of 1024² texels, whose state
is large, and one without a renderer, whose steps take no time at all. For each the steps' own time, the time spent in the run folder
(both on one clock, in one run), and the bytes of a checkpoint: every 50 steps exactly; for the two extremes also as `optimize` chooses.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from common import write

import unrender as ur
from unrender.methods.catalogue import method
from unrender.runs.folder.writer import RunWriter

HERE = Path(__file__).resolve().parent
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


class Timed(RunWriter):
    """A writer that measures how long it takes."""

    spent: dict[str, float] = {}  # noqa: RUF012
    count = 0

    def append(self, record: Any) -> None:
        began = time.perf_counter()
        super().append(record)
        Timed.spent["history"] = Timed.spent.get("history", 0.0) + time.perf_counter() - began

    def write_checkpoint(self, *arguments: Any) -> None:
        began, before = time.perf_counter(), self._written_step
        super().write_checkpoint(*arguments)
        Timed.spent["checkpoints"] = Timed.spent.get("checkpoints", 0.0) + time.perf_counter() - began
        Timed.count += self._written_step != before


def measure(case: tuple[str, dict[str, Any], str, dict[str, Any]], steps: int, every: int | None) -> dict[str, Any]:
    """One run."""
    name, options, by, settings = case
    problem = ur.gallery.problem(name, reference_spp=16, **options) if name != "quad" else ur.gallery.problem(name)
    Timed.spent, Timed.count = {}, 0
    (place_for := HERE.parents[1] / "out").mkdir(exist_ok=True)  # not in memory, as temporary folders may be
    with tempfile.TemporaryDirectory(dir=place_for) as place:
        parts = method(by).start(settings)
        began = time.perf_counter()
        result = ur.optimize(problem, *parts, steps=steps, run_directory=place, checkpoint_every=every)
        size = max(path.stat().st_size for path in Path(place).glob("checkpoints/*/state.safetensors"))
    whole = sum(Timed.spent.values()) + result.seconds
    return {
        "step_ms": 1e3 * result.seconds / steps,
        "checkpoint_ms": 1e3 * Timed.spent["checkpoints"] / Timed.count,
        "checkpoints": Timed.count,
        "bytes": size,
        "share_checkpoints": Timed.spent["checkpoints"] / whole,
        "share_history": Timed.spent["history"] / whole,
        "wall_seconds": time.perf_counter() - began,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=100)
    asked = parser.parse_args()
    print(ur.use())
    from unrender.runs import optimize

    optimize.RunWriter = Timed
    found: dict[str, Any] = {}
    for name, case in CASES.items():
        ways = {"50": 50, "default": None} if name in BOTH else {"50": 50}
        found[name] = {words: measure(case, asked.steps, every) for words, every in ways.items()}
        for words, row in found[name].items():
            print(
                f"{name}, every {words}: step {row['step_ms']:.2f} ms, checkpoint {row['checkpoint_ms']:.2f} ms, "
                f"{row['bytes'] / 1e6:.2f} MB, {row['checkpoints']} of them: {100 * row['share_checkpoints']:.2f} % of the run, "
                f"history {100 * row['share_history']:.2f} %"
            )
    write(HERE, {"steps": asked.steps, "cases": found})


if __name__ == "__main__":
    main()
