"""The live page among strangers: what its owner waits for, and what a run loses, while others connect to it.

One run of `indirect-room` by recursive control variates, its live files, and `unrender watch`. The run's time is cut into blocks: its
owner alone asks for the page, once a second (`owner`), or so does he while 500 connections idle and 50 ask without the token
again and again (`crowd`), in random order within each round, so that a machine that slows down slows both. What is compared is
wall clock per step. The strangers' processes have the lowest priority, as if they were on another machine; what the system and the
server do for them is counted. Linux.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

import unrender as ur
from benchmarks.watch.run import summary

MODES = ("owner", "crowd")
SETTLE = 2.5
CLIENTS = Path(__file__).with_name("clients.py")
QUICK = {"resolution": 16, "spp": 2, "rounds": 2, "block": 2.0, "idle": 50, "busy": 5}


def _lowest_priority() -> None:
    os.nice(19)


class Blocks(ur.Callback):
    """Switches from block to block, and measures each one's wall clock per step."""

    def __init__(self, live: ur.Live, address: str, rounds: int, block: float, idle: int, busy: int):
        self._live, self._address, self._block = live, address, block
        self._crowd = {"owner": (0, 0), "crowd": (idle, busy)}
        rng = np.random.default_rng(0)
        self._plan = [MODES[i] for _ in range(rounds) for i in rng.permutation(len(MODES))]
        self._mode, self._began, self._first = "", 0.0, (0.0, 0)
        self._clients: list[subprocess.Popen[Any]] = []
        self.rounds: list[dict[str, float]] = []
        self.clients: dict[str, list[dict[str, Any]]] = {mode: [] for mode in MODES}

    def on_start(self, run: Any) -> None:
        """The folder is made once."""
        self._live.on_start(run)

    def on_step(self, run: Any, record: dict[str, Any]) -> None:
        """Part of the block, or the end of it."""
        self._live.on_step(run, record)
        now = time.perf_counter()
        if self._mode and self._first[1] == 0 and now >= self._began + SETTLE:
            self._first = now, run.step
        if self._mode and now < self._began + SETTLE + self._block:
            return
        if self._mode:
            self._finish(1e3 * (now - self._first[0]) / (run.step - self._first[1]))
        if not self._plan:
            run.stop()
            return
        self._mode = self._plan.pop(0)
        length = str(SETTLE + self._block)
        self._clients = [self._start(("0", "0", length, "1"))]
        if any(self._crowd[self._mode]):
            self._clients.append(
                self._start((*map(str, self._crowd[self._mode]), length, "0"), preexec_fn=_lowest_priority)
            )
        self._began, self._first = time.perf_counter(), (0.0, 0)

    def _start(self, words: tuple[str, ...], **options: Any) -> subprocess.Popen[Any]:
        return subprocess.Popen([sys.executable, CLIENTS, self._address, *words], stdout=subprocess.PIPE, **options)

    def _finish(self, milliseconds: float) -> None:
        if len(self.rounds) == 0 or len(self.rounds[-1]) == len(MODES):
            self.rounds.append({})
        self.rounds[-1][self._mode] = milliseconds
        owner, *strangers = [json.loads(process.communicate()[0]) for process in self._clients]
        found = {**(strangers or [owner])[0], "waits": owner["waits"]}
        self.clients[self._mode].append(found)
        print(
            f"{self._mode:6} {milliseconds:.2f} ms per step, the owner waits {max(found['waits']):.3f} s at most",
            flush=True,
        )


def measure(resolution: int, spp: int, rounds: int, block: float, idle: int, busy: int) -> dict[str, Any]:
    """Milliseconds per step of every round and mode, and what the owner waited."""
    problem = ur.gallery.problem("indirect-room", resolution=resolution)
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-u", "-m", "unrender", "watch", folder, "--no-browser"]
        server = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        try:
            lines: Any = server.stdout
            address = next(line.split()[-1] for line in lines if line.startswith("watching at "))
            blocks = Blocks(ur.Live(folder), address, rounds, block, idle, busy)
            estimator = ur.PathGradient(image=ur.images.RecursiveControlVariate(), spp=spp)
            adam = ur.optimizers.Adam(learning_rate=1e-3)
            ur.optimize(problem, estimator, adam, seconds=3600.0, callbacks=[blocks])
        finally:
            server.terminate()
            server.wait()
    waits = {mode: [wait for of in blocks.clients[mode] for wait in of["waits"]] for mode in MODES}
    crowd = {
        name: float(np.mean([of[name] for of in blocks.clients["crowd"]])) for name in ("idle", "busy", "answered")
    }
    return {
        "rounds_ms": blocks.rounds,
        "speed": summary([of["owner"] / of["crowd"] for of in blocks.rounds]),
        "waits": {
            mode: {"median": float(np.median(of)), "longest": max(of), "count": len(of)} for mode, of in waits.items()
        },
        "crowd": crowd,
    }


def run(
    resolution: int = 128, spp: int = 8, rounds: int = 10, block: float = 8.0, idle: int = 500, busy: int = 50
) -> dict[str, Any]:
    """Every round.

    Args:
        block: seconds
        idle: connections that say nothing
        busy: connections that ask without the token
    """
    return measure(resolution, spp, rounds, block, idle, busy)
