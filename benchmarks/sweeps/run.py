"""What a sweep costs beside its runs, and what pruning saves.

Overhead: a sweep of equal small tasks on workers of this machine. Its command's time, from typing to the prompt, times the number of
workers, against the sum of its runs' times, each from its beginning to its end in its worker: the difference is Ray's start and end,
imports, opening the problem, scheduling, records and the page.

Pruning: sweeps of a learning rate over four decades and of the samples per pixel, with random settings, with pruning and without, in this
process and with one thread, so that a run is the same in both. Against the whole sweep without pruning: steps, paths and time of the
pruned one, whether it found the same best trial, and what it had used by then.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from benchmarks.runner.catalogue import ROOT
from benchmarks.runner.records import scratch

RENDERS = False
MERGE = ("overhead", "pruning")
PARTS = ("overhead", "pruning")
QUICK = {"part": ("pruning",), "trials": 6, "steps": 10, "seeds": 1}
PROBLEM = ("poster", "-p", "resolution=32", "--method", "plain", "--final-spp", 8, "--threads", 1)


def run(
    part: tuple[str, ...] = PARTS,
    tasks: int = 64,
    task_steps: int = 3000,
    workers: int = 2,
    trials: int = 64,
    steps: int = 200,
    seeds: int = 3,
) -> Iterator[dict[str, Any]]:
    """Both.

    Args:
        part: of the benchmark
        tasks: of the sweep whose overhead is measured
        task_steps: of each of them
        workers: on this machine
        trials: of each sweep of which some are pruned
        steps: of each trial
        seeds: of the search, a pair of sweeps each
    """
    found: dict[str, Any] = {"overhead": {}, "pruning": {}}
    if "overhead" in part:
        for count in dict.fromkeys((1, workers)):
            found["overhead"][str(count)] = overhead(tasks, task_steps, count)
            yield found
    if "pruning" in part:
        for seed in range(seeds):
            found["pruning"][str(seed)] = pruning(trials, steps, seed)
            yield found


def overhead(tasks: int, steps: int, workers: int) -> dict[str, Any]:
    """One sweep of so many tasks; with one worker, in the command's own process."""
    rates = ("--over", f"learning_rate=0.02:0.03:{tasks}", "--steps", steps)
    record, seconds = sweep(f"overhead-{workers}", *PROBLEM, *rates, "--workers", workers)
    runs = sum(outcome["wall_seconds"] for trial in record["trials"] for outcome in trial["runs"])
    finished = sum(trial["status"] == "finished" for trial in record["trials"])
    entry = {
        "tasks": finished,
        "command_seconds": seconds,
        "sweep_seconds": record["wall_seconds"],
        "sum_of_runs": runs,
        "overhead": (seconds * workers - runs) / runs,
        "overhead_within_the_sweep": (record["wall_seconds"] * workers - runs) / runs,
    }
    print(f"{workers} workers:", {key: round(value, 3) for key, value in entry.items()}, flush=True)
    return entry


def pruning(trials: int, steps: int, seed: int) -> dict[str, Any]:
    """A sweep without pruning and one with it."""
    over = ("--over", "learning_rate=0.0001:1:log", "--over", "spp=1:16:log", "--search", "random")
    common = (*PROBLEM, *over, "--trials", trials, "--steps", steps, "--seed", seed)
    full, full_seconds = sweep(f"full-{seed}", *common)
    cut, cut_seconds = sweep(f"pruned-{seed}", *common, "--prune")
    entry: dict[str, Any] = {
        "pruned": sum(trial["status"] == "pruned" for trial in cut["trials"]),
        "same_best": full["best"] == cut["best"],
        "best": full["best"],
        "error_ratio": _error(cut) / _error(full),
        "command_seconds": cut_seconds / full_seconds,
    }
    for what in ("steps", "samples", "seconds", "wall_seconds"):
        whole, pruned = used(full, what), used(cut, what)
        entry[what] = pruned[-1] / whole[-1]
        entry[f"{what}_to_best"] = pruned[cut["best"]] / whole[-1]
        entry[f"{what}_to_best_of_full"] = pruned[cut["best"]] / whole[full["best"]]
    print(f"seed {seed}:", {key: round(value, 3) for key, value in entry.items()}, flush=True)
    return entry


def used(record: dict[str, Any], what: str) -> list[float]:
    """Used by the end of each trial, in order of their numbers."""
    total, found = 0.0, []
    for trial in record["trials"]:
        total += sum(outcome[what] for outcome in trial["runs"])
        found.append(total)
    return found


def sweep(name: str, *arguments: object) -> tuple[dict[str, Any], float]:
    """sweep.json of a sweep made by the command, and the seconds that the command took."""
    folder = scratch("sweeps") / name
    shutil.rmtree(folder, ignore_errors=True)
    command = [sys.executable, "-m", "unrender", "sweep", *map(str, arguments), "--out", str(folder)]
    began = time.perf_counter()
    paths = os.pathsep.join([str(ROOT / "src"), os.environ.get("PYTHONPATH", "")])
    done = subprocess.run(
        command, cwd=ROOT, env={**os.environ, "PYTHONPATH": paths}, capture_output=True, text=True, check=False
    )
    seconds = time.perf_counter() - began
    if done.returncode:
        raise RuntimeError(f"{' '.join(command)}: {done.stderr}")
    return json.loads(Path(folder, "sweep.json").read_text()), seconds


def _error(record: dict[str, Any]) -> float:
    return record["trials"][record["best"]]["error"]
