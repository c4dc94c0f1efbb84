"""The cost of watching a run: alone, with the live files, and with the live page open in a browser.

One run of `indirect-room` by recursive control variates. Its time is cut into blocks; in each block the run is as it is
(`alone`), writes what a live page shows (`files`), or does so while `unrender watch` serves the page to a Chromium that
shows it (`page`), in random order within each round, so that a machine that slows down slows all three. What is compared
is wall clock per step, writing and serving included; the time it takes to open and close the page is left out. Beside it
stands the processor time that server and browser take while the page is open: on a machine that does nothing else, their
share of all cores is what the run can lose. Needs Playwright, a Chromium, and Linux.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

import unrender as ur

MODES = ("alone", "files", "page")
SETTLE = 1.5
QUICK = {"resolution": 16, "spp": 2, "rounds": 2, "block": 0.5}


def processor_seconds(root: int) -> float:
    """Of a process and all that it has started, as far as they still run."""
    parents: dict[int, int] = {}
    ticks: dict[int, int] = {}
    for path in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = path.read_text().rpartition(")")[2].split()
        except OSError:
            continue  # ended meanwhile
        number = int(path.parent.name)
        parents[number], ticks[number] = int(fields[1]), int(fields[11]) + int(fields[12])

    def descends(number: int) -> bool:
        while number not in (0, root):
            number = parents.get(number, 0)
        return number == root

    return sum(of for number, of in ticks.items() if descends(number)) / os.sysconf("SC_CLK_TCK")


class Blocks(ur.Callback):
    """Switches from block to block, and measures each one's wall clock per step."""

    def __init__(self, live: ur.Live, page: Any, address: str, rounds: int, block: float, server: int):
        self._server = server
        self._taken: dict[str, float] = {}
        self.shares: list[dict[str, float]] = []
        self._live, self._page, self._address, self._block = live, page, address, block
        rng = np.random.default_rng(0)
        self._plan = [MODES[i] for _ in range(rounds) for i in rng.permutation(len(MODES))]
        self._mode = ""
        self._began = 0.0
        self._last: tuple[float, int] = (0.0, 0)
        self.rounds: list[dict[str, float]] = []

    def on_start(self, run: Any) -> None:
        """The folder is made once."""
        self._live.on_start(run)

    def _processors(self) -> dict[str, float]:
        """Seconds of the server's, and of the browser's: all else that this process has started, and what drives it."""
        server, all_of_us = processor_seconds(self._server), processor_seconds(os.getpid())
        return {"server": server, "browser": all_of_us - server - time.process_time()}

    def on_step(self, run: Any, record: dict[str, Any]) -> None:
        """Part of the block, or the end of it."""
        if self._mode in ("files", "page"):
            self._live.on_step(run, record)
        now = time.perf_counter()
        if self._mode and self._last[1] == 0 and now >= self._began + SETTLE:
            self._last = now, run.step
            self._taken = self._processors()
        if self._mode and now < self._began + SETTLE + self._block:
            return
        if self._mode:
            if len(self.rounds) == 0 or len(self.rounds[-1]) == len(MODES):
                self.rounds.append({})
            self.rounds[-1][self._mode] = 1e3 * (now - self._last[0]) / (run.step - self._last[1])
            if self._mode == "page":
                cores = len(os.sched_getaffinity(0)) * (now - self._last[0])
                taken = {name: seconds - self._taken[name] for name, seconds in self._processors().items()}
                self.shares.append({name: seconds / cores for name, seconds in taken.items()})
                print(self.shares[-1])
            print(f"{self._mode:6} {self.rounds[-1][self._mode]:.2f} ms per step", flush=True)
        if not self._plan:
            run.stop()
            return
        self._mode = self._plan.pop(0)
        self._page.goto(self._address if self._mode == "page" else "about:blank")
        self._began, self._last = time.perf_counter(), (0.0, 0)


def measure(resolution: int, spp: int, rounds: int, block: float) -> dict[str, Any]:
    """Milliseconds per step of every round and mode, and their ratios."""
    from playwright.sync_api import sync_playwright

    program = next(p for n in ("chromium", "chromium-browser", "google-chrome") if (p := shutil.which(n)))
    problem = ur.gallery.problem("indirect-room", resolution=resolution)
    with tempfile.TemporaryDirectory() as folder, sync_playwright() as playwright:
        command = [sys.executable, "-u", "-m", "unrender", "watch", folder, "--no-browser"]
        server = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        browser = playwright.chromium.launch(executable_path=program, args=["--no-sandbox"])
        try:
            lines: Any = server.stdout
            address = next(line.split()[-1] for line in lines if line.startswith("watching at "))
            page = browser.new_page()
            blocks = Blocks(ur.Live(folder), page, address, rounds, block, server.pid)
            estimator = ur.PathGradient(image=ur.images.RecursiveControlVariate(), spp=spp)
            adam = ur.optimizers.Adam(learning_rate=1e-3)
            ur.optimize(problem, estimator, adam, seconds=3600.0, callbacks=[blocks])
            updates = read_cost(Path(folder))
        finally:
            browser.close()
            server.terminate()
            server.wait()
    ratios = {mode: [of[mode] / of["alone"] for of in blocks.rounds] for mode in MODES[1:]}
    return {
        "rounds_ms": blocks.rounds,
        "ratios": {mode: summary(of) for mode, of in ratios.items()},
        "processor_share": {name: float(np.mean([of[name] for of in blocks.shares])) for name in blocks.shares[0]},
        "update_ms": updates,
    }


def read_cost(folder: Path) -> float:
    """What the last update of the files took, in milliseconds, as the run itself says."""
    return 1e3 * json.loads((folder / "live" / "status.json").read_text())["update_seconds"]


def summary(ratios: list[float]) -> dict[str, float]:
    """The median, its standard error (1.25 that of the mean of a normal), and the quartiles."""
    low, middle, high = np.percentile(ratios, [25, 50, 75])
    error = 1.2533 * np.std(ratios, ddof=1) / np.sqrt(len(ratios))
    return {"median": float(middle), "standard_error": float(error), "low": float(low), "high": float(high)}


def run(resolution: int = 128, spp: int = 8, rounds: int = 12, block: float = 6.0) -> dict[str, Any]:
    """Every round.

    Args:
        block: seconds
    """
    return measure(resolution, spp, rounds, block)
