"""One dealt run, measured step by step.

    python -m benchmarks.workers.driver ORDER.json > one JSON object

The order holds "problem" and "options" of the gallery, "method" and "settings", "steps", "seed", "workers" ("" for one process),
"compress" and "threads". The answer: seconds a step, and of the last half of the steps the medians of what went over the wire.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from statistics import median
from typing import Any

__all__ = ["main"]


def main() -> None:
    """Carry out one order."""
    import numpy as np

    import unrender as ur
    from benchmarks.internals import method_parts
    from unrender.backend import variant
    from unrender.dealing.gatherer import DealtViews

    order: dict[str, Any] = json.loads(Path(sys.argv[1]).read_text())
    ur.use("llvm_ad_rgb")
    variant.use_threads(order["threads"])
    problem = ur.gallery.problem(order["problem"], **order["options"])
    rows: list[dict[str, float]] = []

    class Watch(ur.Callback):
        """Notes each step."""

        def __init__(self) -> None:
            self.clock = 0.0

        def on_step(self, run: Any, record: Any) -> None:
            row = {"seconds": run.clock - self.clock}
            self.clock = run.clock
            if isinstance(run.problem.gatherer, DealtViews):
                traffic = run.problem.gatherer.traffic
                row |= {"sent": traffic.sent, "received": traffic.received, "busy": traffic.busy}
                row |= {"waited": traffic.seconds}
            rows.append(row)

    def descend(given: ur.Problem) -> ur.Result:
        parts = method_parts(order["method"], order["settings"])
        return ur.optimize(given, *parts, steps=order["steps"], seed=order["seed"], progress=False, callbacks=[Watch()])

    if order["workers"]:
        with ur.deal(problem, order["workers"], order["compress"], threads=order["threads"], tell=_tell) as dealt:
            result = descend(dealt)
    else:
        result = descend(problem)
    np.savez(order["parameters"], **result.parameters)  # pyright: ignore[reportArgumentType]
    settled = rows[len(rows) // 2 :]
    print(
        json.dumps(
            {name: median(row[name] for row in settled) for name in settled[0]} | {"loss": result.history[-1]["loss"]}
        )
    )


def _tell(line: str) -> None:
    print(line, file=sys.stderr, flush=True)


if __name__ == "__main__":
    main()
