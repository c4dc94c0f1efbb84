"""Kills of workers, nodes, the driver of a dealt run, and of the head node with the driver, at random instants."""

from __future__ import annotations

import contextlib
import os
import random
import shutil
import signal
import subprocess
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from tests.campaigns.cluster_machines import Machines, processes_below

__all__ = ["KINDS", "METHODS", "campaign", "straggler"]

METHODS: dict[str, list[str]] = {
    "plain": ["--method", "plain", "--set", "spp=2"],
    "rcv": ["--method", "rcv", "--set", "spp=2"],
    "coupled": ["--method", "coupled", "--set", "image=rcv"],
}
KINDS = ("worker", "node", "driver", "head")
_PROBLEM = ["two-planets", "-p", "resolution=16", "-p", "texture_resolution=16", "-p", "reference_spp=32"]
_COMMON = ["--threads", 1, "--variant", "llvm_ad_rgb", "--final-spp", 1, "--checkpoint-every", 10]
_LONGEST = 300.0
"""Seconds without a step after which a run counts as one that hangs for ever, and is killed."""


class _Watched:
    """A command whose steps are counted by its history as it grows.

    Args:
        process: of the command.
        folder: its run folder.
    """

    def __init__(self, process: subprocess.Popen[bytes], folder: Path):
        self.process, self._history = process, folder / "history.jsonl"
        self._steps, self._since, self.longest = 0, time.monotonic(), 0.0

    def steps(self) -> int:
        """Done so far."""
        with contextlib.suppress(OSError):
            found = self._history.read_bytes().count(b"\n")
            if found != self._steps:
                self._steps = found
                self._since = time.monotonic()
        self.longest = max(self.longest, time.monotonic() - self._since)
        return self._steps

    def until(self, steps: int) -> bool:
        """Wait for so many steps; false where the command ended, or hangs."""
        while self.process.poll() is None and self.steps() < steps:
            if time.monotonic() - self._since > _LONGEST:
                self.end()
                return False
            time.sleep(0.05)
        return self.process.poll() is None

    def restart_clock(self) -> None:
        """Count the longest wait from now on."""
        self._since, self.longest = time.monotonic(), 0.0

    def end(self) -> None:
        """Kill it (SIGKILL)."""
        for pid in processes_below(self.process.pid):
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        self.process.wait()


def campaign(
    machines: Machines, folder: Path, method: str, number: int, steps: int, dice: random.Random
) -> Iterator[dict[str, Any]]:
    """So many kills of a method's runs, of the kinds in turn; what has been found after each."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    whole = _begin(machines, folder / "whole", method, steps)
    if whole.process.wait(1200):
        raise RuntimeError((folder / "whole.log").read_text()[-500:])
    expected = _parameters(folder / "whole")
    rows = []
    for index in range(number):
        kind = KINDS[index % len(KINDS)]
        place = folder / f"killed{index}"
        row = {"kind": kind, **_kill(machines, place, method, steps, kind, dice)}
        with contextlib.suppress(OSError, ValueError):
            found = _parameters(place)
            row["right"] = all(np.array_equal(found[key], value) for key, value in expected.items())
        print(method, row, flush=True)
        if row.get("right"):
            shutil.rmtree(place)
        if row["killed_at"] is None or row["killed_at"] >= steps:
            continue  # a run that ended before its kill says nothing
        rows.append({"right": False, **row})
        waits = [row["wait"] for row in rows]
        yield {"kills": len(rows), "right": sum(row["right"] for row in rows), "longest_wait": max(waits), "rows": rows}


def straggler(machines: Machines, folder: Path, method: str, steps: int, dice: random.Random) -> dict[str, Any]:
    """A run one of whose workers has a tenth of its speed from a random step on: it is stopped for nine tenths of the time.

    Needs the undisturbed run of `campaign`.
    """
    expected, place = _parameters(folder / "whole"), folder / "slow"
    shutil.rmtree(place, ignore_errors=True)
    run = _begin(machines, place, method, steps)
    step = dice.randrange(5, steps // 2)
    if not run.until(step):
        raise RuntimeError(f"{method}: ended at once, with status {run.process.returncode}")
    run.restart_clock()
    slow, ended = dice.choice(machines.workers()), threading.Event()

    def slow_down() -> None:
        with contextlib.suppress(ProcessLookupError):
            while not ended.is_set():
                for number, seconds in ((signal.SIGSTOP, 0.09), (signal.SIGCONT, 0.01)):
                    os.kill(slow, number)
                    time.sleep(seconds)

    thread = threading.Thread(target=slow_down)
    thread.start()
    run.until(steps)
    wait, status = run.longest, run.process.wait(600)
    ended.set()
    thread.join()
    with contextlib.suppress(ProcessLookupError):
        os.kill(slow, signal.SIGCONT)
    found = _parameters(place)
    right = all(np.array_equal(found[key], value) for key, value in expected.items())
    moved = place.with_suffix(".log").read_text().count("moved to")
    return {"right": right, "moved": moved, "wait": wait, "status": status, "slow_from": step}


def _begin(machines: Machines, place: Path, method: str, steps: int) -> _Watched:
    words = ["run", *_PROBLEM, *METHODS[method], "--steps", steps, *_COMMON, "--workers", f"2@{machines.address}"]
    log = place.with_suffix(".log")
    return _Watched(machines.begin("-m", "unrender", *words, "--out", place, log=log), place)


def _kill(machines: Machines, place: Path, method: str, steps: int, kind: str, dice: random.Random) -> dict[str, Any]:
    """One run, with a kill; the longest that it then took to go on, and the status that it ended with."""
    step = dice.randrange(1, steps - 1)
    run = _begin(machines, place, method, steps)
    if not run.until(step):
        return {"wait": run.longest, "status": run.process.poll(), "killed_at": None}
    time.sleep(dice.uniform(0, 0.2))
    killed_at = run.steps()
    run.restart_clock()
    if kind == "worker":
        workers = machines.workers()
        with contextlib.suppress(ProcessLookupError):
            os.kill(dice.choice(workers), signal.SIGKILL)
    elif kind == "node":
        machines.kill(1 - machines.head)
    else:
        run.end()
        if kind == "head":
            machines.move_head()
        words = ["resume", place, "--workers", f"2@{machines.address}"]
        run = _Watched(machines.begin("-m", "unrender", *words, log=place.with_suffix(".log")), place)
        run.until(killed_at + 1)
        run.restart_clock()  # a new process takes its time to start
    run.until(steps)
    wait = run.longest
    status = run.process.wait(600)
    if not machines.is_up(1 - machines.head):
        machines.start(1 - machines.head)
    return {"wait": wait, "status": status, "killed_at": killed_at}


def _parameters(place: Path) -> dict[str, np.ndarray]:
    with np.load(place / "parameters.npz", allow_pickle=False) as stored:
        return dict(stored)
