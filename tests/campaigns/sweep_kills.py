"""Kills of a sweep's workers, of Ray's node and store, and of the command itself, at uniformly drawn moments."""

from __future__ import annotations

import contextlib
import json
import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

from benchmarks.runner.catalogue import ROOT
from tests.campaigns.cluster_machines import processes_below
from tests.campaigns.cuts import leftovers

__all__ = ["campaign", "is_running"]

_KINDS = {
    "worker": ("ray::unrender", "ray::IDLE"),
    "node": ("raylet/raylet",),
    "store": ("gcs_server",),
    "command": ("-m unrender",),
}
"""What is killed, and words of which its command line holds one."""
_SWEEP = ["sweep", "exponential", "-m", "plain", "--over", "learning_rate=0.001,0.003,0.01,0.03", "--steps", 1500]
_SWEEP += ["--final-spp", 1, "--threads", 1, "--workers", 2, "--out", "sweep"]


def _start(place: Path, *words: object) -> subprocess.Popen[str]:
    path = os.pathsep.join([str(ROOT), str(ROOT / "src")])
    return subprocess.Popen(
        [sys.executable, "-m", "unrender", *map(str, words)],
        cwd=place,
        env={**os.environ, "PYTHONPATH": path, "RAY_worker_niceness": "0"},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )


def _trials(place: Path) -> list[tuple[Any, ...]]:
    record = json.loads((place / "sweep" / "sweep.json").read_text())
    return [(trial["number"], trial["settings"], trial["error"]) for trial in record["trials"]]


def campaign(folder: Path, number: int, dice: random.Random) -> list[dict[str, Any]]:
    """Kill a process of so many sweeps; a row for each with what was killed, when, and what is wrong ("" for nothing)."""
    whole = folder / "whole"
    whole.mkdir(parents=True)
    begun = time.monotonic()
    process = _start(whole, *_SWEEP)
    if process.communicate()[1] or process.returncode:
        raise RuntimeError(f"exit status {process.returncode}")
    seconds, expected = time.monotonic() - begun, _trials(whole)
    rows: list[dict[str, Any]] = []
    while len(rows) < number:
        kind = list(_KINDS)[len(rows) % len(_KINDS)]
        place = folder / f"{len(rows)}-{kind}"
        place.mkdir(exist_ok=True)
        process, moment = _start(place, *_SWEEP), dice.uniform(0, seconds)
        time.sleep(moment)
        found = [
            pid for pid, words in processes_below(process.pid).items() if any(word in words for word in _KINDS[kind])
        ]
        beside = sorted(set(processes_below(process.pid)) - {process.pid})
        if not found or process.poll() is not None:  # too early or too late for this kind
            process.kill()
            process.communicate()
            continue
        os.kill(process.pid if kind == "command" else dice.choice(found), signal.SIGKILL)
        said, status = process.communicate(timeout=300)[1], process.returncode
        rows.append({"kind": kind, "moment": round(moment, 2), "status": status, "said": said})
        rows[-1]["wrong"] = _judge(place, rows[-1], expected, beside)
        print(rows[-1], flush=True)
    return rows


def _judge(place: Path, row: dict[str, Any], expected: list[tuple[Any, ...]], beside: list[int]) -> str:
    """Return what is wrong after a kill, and after what the user would do then."""
    allowed = {"worker": (0,), "command": (-signal.SIGKILL,)}.get(row["kind"], (0, 2))
    lines = row["said"].splitlines()
    if row["status"] not in allowed or len(lines) != (row["status"] == 2):
        return "its end"
    if row["status"]:
        again = ["sweep", "sweep", "--workers", 2] if (place / "sweep" / "sweep.json").exists() else _SWEEP
        process = _start(place, *again)
        if process.communicate(timeout=300)[1] or process.returncode:
            return "does not go on"
    if _trials(place) != expected:
        return "other results"
    until = time.monotonic() + 30
    while (alive := [pid for pid in beside if is_running(pid)]) and time.monotonic() < until:
        time.sleep(0.2)
    return f"left over: {leftovers(place)} {alive}" if alive or leftovers(place) else ""


def is_running(pid: int) -> bool:
    """Return whether a process has not ended."""
    with contextlib.suppress(OSError):
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] not in "ZX"
    return False
