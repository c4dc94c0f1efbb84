"""What a dealt run costs beside rendering, and what that means for 8, 64 and 512 GPUs: a cost model, fitted, simulated and extrapolated.

Measured: steps of dealt runs whose workers render nothing, but answer after a given time with gradients of the right shapes (stand-ins),
for 2 to 16 workers and up to three million parameters, on this machine, and half of them behind a link between two network
namespaces: as fast as it goes, throttled by `tc` (token bucket), and throttled and late. Also runs whose workers render.

Fitted: the seven costs of `cost.py` to two thirds of the steps with stand-ins; the others, and those that render, are predicted.

Simulated: the same steps as events on a clock, with workers of random speed, with stragglers and losses, by a seeded generator.

The link needs root.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from benchmarks.runner.catalogue import ROOT
from benchmarks.runner.records import Record, scratch
from benchmarks.workers.machines import Link, Machines
from benchmarks.workers.scale.summary import summary

RENDERS = False
PARTS = ("local", "link")
LINKS: dict[str, tuple[float | None, float]] = {
    "no limit": (None, 0.0),
    "1000 Mbit/s": (1000.0, 0.0),
    "200 Mbit/s": (200.0, 0.0),
    "100 Mbit/s, 20 ms": (100.0, 20.0),
}
"""Megabits a second, each way, and milliseconds there and back."""
MERGE = ("cases",)
QUICK = {"part": ("local",), "sides": (16,), "workers": (2,), "steps": 6, "views": 4, "view_seconds": 0.005}


def run(
    part: tuple[str, ...] = PARTS,
    workers: tuple[int, ...] = (2, 4, 8, 16),
    sides: tuple[int, ...] = (64, 512, 1024),
    link_workers: tuple[int, ...] = (2, 8),
    link_sides: tuple[int, ...] = (64, 512),
    view_seconds: float = 0.02,
    views: int = 16,
    steps: int = 20,
) -> Iterator[dict[str, Any]]:
    """All of it.

    Args:
        part: of the benchmark
        workers: how many, of this machine
        sides: of the texture, in texels
        link_workers: how many, half of them behind the link
        link_sides: of the texture there
        view_seconds: that a stand-in takes for a view
        views: dealt to the workers
        steps: of each run
    """
    if os.geteuid() != 0 and "link" in part:
        sys.exit("workers.scale: network namespaces need root; --part local does without")
    order: dict[str, Any] = {"steps": steps, "views": views}
    found: dict[str, Any] = {"commit": _commit(), "views": views, "cases": {}}
    if "local" in part:
        cases = [_case(side, str(count), view_seconds) for count in workers for side in sides]
        found["cases"]["this machine"] = _measured(order, [*cases, _case(sides[0], "2", None)])
        yield found
    if "link" in part:
        for name, (megabits, milliseconds) in LINKS.items():
            with Link(megabits, milliseconds) as link, Machines(link) as machines:
                at = f"@{machines.address}"
                cases = [_case(side, f"{count}{at}", view_seconds) for count in link_workers for side in link_sides]
                cases.append({**cases[-1], "compress": True})
                cases.append(_case(link_sides[-1], f"2{at}", None))
                rows = _measured(order, cases, machines)
            limits = {"rate": None if megabits is None else megabits * 1e6 / 8, "trip": milliseconds / 1e3}
            found["cases"][name] = [{**row, **limits} for row in rows]
            yield found


def summarize(record: Record) -> Record:
    """The fit, the simulation, the prediction."""
    return summary(record)


def _case(side: int, workers: str, seconds: float | None) -> dict[str, Any]:
    return {"side": side, "workers": workers, "compress": False, "seconds": seconds}


def _measured(
    order: dict[str, Any], cases: list[dict[str, Any]], machines: Machines | None = None
) -> list[dict[str, Any]]:
    """What `driver` answers."""
    file = scratch("workers.scale") / "order.json"
    named = [{**case, "view_seconds": case["seconds"]} for case in cases]
    file.write_text(json.dumps({**order, "cases": named}))
    words: list[object] = [sys.executable, "-m", "benchmarks.workers.scale.driver", file]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), str(ROOT / "src")])}
    if machines is not None:
        words, environment = list[object](machines.link.words(machines.head, *words)), machines.environment
    process = subprocess.Popen(
        [str(word) for word in words], stdout=subprocess.PIPE, text=True, env=environment, cwd=ROOT
    )
    assert process.stdout is not None
    rows = []
    for line in process.stdout:
        if line.startswith("{"):
            rows.append(json.loads(line))
            print(rows[-1], flush=True)
    if process.wait():
        raise RuntimeError(f"a case after {len(rows)} ended with status {process.returncode}")
    return [{**row, "workers": int(row["workers"].partition("@")[0])} for row in rows]


def _commit() -> str:
    words = ["git", "-C", str(Path(ROOT)), "rev-parse", "--short", "HEAD"]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    return done.stdout.strip() if done.returncode == 0 else ""
