"""Ctrl-C and SIGTERM at uniformly distributed moments of commands that are too slow for the other tiers."""

from __future__ import annotations

import json
import random
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from tests.campaigns.cluster_machines import processes_below
from tests.campaigns.cuts import final_state, leftovers
from tests.campaigns.kills import digest
from tests.campaigns.sweep_kills import is_running
from tests.cli.test_signals_anywhere import ENVIRONMENT, await_package, ended, start
from unrender.runs.folder.schema import ENDED

__all__ = ["COMMANDS", "campaign"]

_ROOM = ["indirect-room", "-p", "resolution=8", "-p", "texture_resolution=4", "-p", "reference_spp=8"]
_PLANETS = ["two-planets", "-p", "resolution=8", "-p", "texture_resolution=8", "-p", "reference_spp=8"]
_COMMON = ["--method", "plain", "--final-spp", "4", "--threads", "1", "--variant", "llvm_ad_rgb"]
_DISTRIBUTED = [
    "run",
    *_PLANETS,
    *_COMMON,
    "--steps",
    "60",
    "--checkpoint-every",
    "10",
    "--workers",
    "2",
    "--out",
    "run",
]
_LONGEST = 90.0
"""Seconds after which a process counts as left over: Ray's workers need some to notice that their node has ended."""


class _Export:
    """Export of a finished run: its folder is complete or absent."""

    def __init__(self, home: Path):
        self._run = home / "finished"
        _must("run", *_ROOM, *_COMMON, "--steps", "4", "--out", str(self._run))
        self.words = ["export", str(self._run), "--out", "scene", "--variant", "llvm_ad_rgb"]

    def state(self, folder: Path) -> Any:
        return digest(folder / "scene")

    def judge(self, folder: Path, expected: Any) -> str:
        return "" if not (folder / "scene").exists() or self.state(folder) == expected else "half an export"


class _Distributed:
    """Run on two worker processes: resumed on two, it ends in the numbers of the undisturbed one."""

    def __init__(self, home: Path):
        del home
        self.words = _DISTRIBUTED

    def state(self, folder: Path) -> Any:
        return final_state(folder / "run")

    def judge(self, folder: Path, expected: Any) -> str:
        record = folder / "run" / "run.json"
        if not record.exists():
            return ""
        if json.loads(record.read_text())["status"] not in ENDED:
            _must("resume", str(folder / "run"), "--workers", "2")
        return "" if self.state(folder) == expected else "other numbers"


COMMANDS: dict[str, Callable[[Path], Any]] = {"export": _Export, "distributed": _Distributed}


def campaign(
    folder: Path, command: str, number: signal.Signals, count: int, dice: random.Random
) -> list[dict[str, Any]]:
    """Send a signal to `count` executions of a command before their end; return a row for each, with its fault ("" for none)."""
    folder.mkdir()
    case = COMMANDS[command](folder)
    begun = time.monotonic()
    whole = start(folder / "whole", *case.words)
    if whole.communicate(timeout=600)[1] != "loading\n" or whole.returncode:
        raise RuntimeError(f"{command}: exit status {whole.returncode}")
    seconds, expected = time.monotonic() - begun, case.state(folder / "whole")
    rows: list[dict[str, Any]] = []
    for index in range(3 * count):
        place = folder / str(index)
        process = start(place, *case.words)
        await_package(process)
        begun, moment = time.monotonic(), dice.uniform(0, seconds)
        try:
            process.wait(moment)
            seconds = min(seconds, time.monotonic() - begun)  # it ended before its signal: the machine is faster now
            process.communicate()
        except subprocess.TimeoutExpired:
            rows.append({"moment": moment, "of": seconds, **_interrupt(process, number, case, place, expected)})
            print(command, number.name, rows[-1], flush=True)
        shutil.rmtree(place)
        if len(rows) == count:
            break
    return rows


def _interrupt(
    process: subprocess.Popen[str], number: signal.Signals, case: Any, place: Path, expected: Any
) -> dict[str, Any]:
    below = {pid: words for pid, words in processes_below(process.pid).items() if pid != process.pid}
    wrong, waited = "", 0.0
    try:
        waited = ended(process, number)
    except (AssertionError, subprocess.TimeoutExpired) as error:
        wrong = " ".join(str(error).split())[:500] or "no end"
        process.kill()
    wrong = wrong or case.judge(place, expected) or _left(place, below)
    return {"waited": waited, "status": process.returncode, "wrong": wrong}


def _must(*words: str) -> None:
    command = [sys.executable, "-m", "unrender", *words]
    done = subprocess.run(command, env=ENVIRONMENT, capture_output=True, text=True, timeout=600)
    if done.returncode:
        raise RuntimeError(f"{words}: exit status {done.returncode}: {done.stderr}")


def _left(folder: Path, below: dict[int, str]) -> str:
    """Return files that remain, and processes that remain for longer than `_LONGEST` seconds."""
    until = time.monotonic() + _LONGEST
    while (alive := [words for pid, words in below.items() if is_running(pid)]) and time.monotonic() < until:
        time.sleep(0.2)
    return f"left over: {leftovers(folder)} {alive}" if alive or leftovers(folder) else ""
