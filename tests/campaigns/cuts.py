"""Power cuts."""

from __future__ import annotations

import json
import random
import shutil
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tests.campaigns.machine import KILLED, Disk, Victims
from unrender.runs.folder.schema import ENDED

__all__ = ["METHODS", "campaign", "final_state", "leftovers"]

_TINY = ["-p", "resolution=8", "-p", "texture_resolution=4", "-p", "reference_spp=8"]
_COMMON = ["--threads", 1, "--variant", "llvm_ad_rgb", "--final-spp", 1]


@dataclass(frozen=True)
class _Runs:
    """What is run.

    Attributes:
        words: problem and method.
        steps, every: of the run, and between checkpoints.
    """

    words: list[Any]
    steps: int
    every: int

    @property
    def options(self) -> list[Any]:
        """Of `unrender run`, but for the folder."""
        return [*self.words, *_COMMON, "--steps", self.steps, "--checkpoint-every", self.every]


_ROOM = ["indirect-room", *_TINY]
_BOX = ["box2", "-p", "resolution=8", "-p", "reference_spp=8"]
METHODS: dict[str, tuple[_Runs, _Runs]] = {
    "rcv": (_Runs(["exponential", "-m", "rcv"], 600, 40), _Runs([*_ROOM, "-m", "rcv"], 60, 10)),
    "meta": (_Runs(["exponential", "-m", "meta"], 600, 40), _Runs([*_ROOM, "-m", "meta"], 60, 10)),
    "coupled": (_Runs(["exponential", "-m", "coupled"], 600, 40), _Runs([*_ROOM, "-m", "coupled"], 60, 10)),
    "smoothed": (
        _Runs(["quad", "-m", "smoothed"], 400, 40),
        _Runs([*_BOX, "-m", "smoothed", "-s", "samples=4"], 60, 10),
    ),
}
"""For each: what most cuts are made of, a toy, and what one and the one after the end are."""


def campaign(victims: Victims, folder: Path, method: str, number: int, dice: random.Random) -> dict[str, Any]:
    """So many cuts at random instants of runs by a method, and one right after the end.

    Returns:
        counts, and for each cut the step of the last checkpoint that was complete when it came and the one that was resumed from.
    """
    disk, rows = Disk(folder), []
    toy, room = METHODS[method]
    for runs, cuts in ((toy, number - 1), (room, number)):
        whole = folder / "whole"
        shutil.rmtree(whole, ignore_errors=True)
        if status := victims.carry_out("run", *runs.options, "--out", whole):
            raise RuntimeError(f"{method}: exit status {status}")
        expected = final_state(whole)
        while len(rows) < cuts:
            row = _cut(victims, disk, runs, expected, dice)
            if row is not None:  # it had not ended before
                rows.append(row)
        if runs is room:
            rows.append(_cut_after_the_end(victims, disk, runs, expected))
    return {
        "cuts": len(rows),
        "resumed": sum(row["ended"] for row in rows),
        "same_bits": sum(row["same_bits"] for row in rows),
        "from_the_last_checkpoint": sum(row["from"] >= row["promised"] for row in rows),
        "nothing_left_over": sum(not row["left_over"] for row in rows),
        "rows": rows,
    }


def _cut(victims: Victims, disk: Disk, runs: _Runs, expected: Any, dice: random.Random) -> dict[str, Any] | None:
    disk.make()
    with disk.mounted() as place:
        run = place / "run"
        pid = victims.begin("run", *runs.options, "--out", run)
        _wait_for_steps(run, pid, dice.randint(-runs.steps // 8, runs.steps - 1))
        time.sleep(dice.uniform(0, 0.05))
        promised = _complete(run)  # a little before the cut: what comes between is more than was promised
        disk.cut()
        victims.kill(pid)
        if victims.end() != KILLED:
            return None
    with disk.mounted() as place:
        return _go_on(victims, place / "run", runs, expected, promised)


def _wait_for_steps(run: Path, pid: int, steps: int) -> None:
    """Until the run has come so far; below 0, until its folder is there; or until it has ended."""
    history = run / "history.jsonl"
    while Path(f"/proc/{pid}").exists() and "\nState:\tZ" not in Path(f"/proc/{pid}/status").read_text():
        if run.exists() and (steps < 0 or (history.exists() and history.read_bytes().count(b"\n") >= steps)):
            return
        time.sleep(0.002)


def _cut_after_the_end(victims: Victims, disk: Disk, runs: _Runs, expected: Any) -> dict[str, Any]:
    """The run must be found finished, with all that belongs to it."""
    disk.make()
    with disk.mounted() as place:
        status = victims.carry_out("run", *runs.options, "--out", place / "run")
        disk.cut()
    if status:
        raise RuntimeError(f"exit status {status}")
    with disk.mounted() as place:
        run = place / "run"
        record = json.loads((run / "run.json").read_text())
        same = record["status"] in ENDED and final_state(run) == expected
        empty = [path.name for path in run.rglob("*") if path.is_file() and path.stat().st_size == 0]
        status = victims.carry_out("resume", run, "--steps", runs.steps + 1)
        resumed = json.loads((run / "run.json").read_text())["resumed"]
        ended = status == 0 and not empty
        return {
            "ended": ended,
            "same_bits": same,
            "promised": runs.steps,
            "from": resumed[0],
            "left_over": leftovers(run),
        }


def _go_on(victims: Victims, run: Path, runs: _Runs, expected: Any, promised: int) -> dict[str, Any]:
    if (run / "run.json").exists():
        finished = json.loads((run / "run.json").read_text())["status"] in ENDED
        status = 0 if finished else victims.carry_out("resume", run)
        since = ([runs.steps] if finished else json.loads((run / "run.json").read_text())["resumed"])[-1]
    else:  # it had not begun
        status, since = victims.carry_out("run", *runs.options, "--out", run, "--overwrite"), 0
    same = status == 0 and final_state(run) == expected
    return {"ended": status == 0, "same_bits": same, "promised": promised, "from": since, "left_over": leftovers(run)}


def _complete(run: Path) -> int:
    """The step of the last checkpoint that has its name."""
    return max((int(path.name) for path in run.glob("checkpoints/[0-9]*")), default=0)


def final_state(run: Path) -> dict[str, bytes]:
    """Every number of the last checkpoint."""
    last = max(run.glob("checkpoints/[0-9]*"))
    return {last.name: (last / "state.safetensors").read_bytes()}


def leftovers(folder: Path) -> list[str]:
    """What no process that ended leaves."""
    found = [path for end in ("part", "old") for path in folder.rglob(f"*.{end}")]
    found += [path for path in folder.glob("**/checkpoints/*") if not (path / "manifest.json").exists()]
    return sorted(str(path.relative_to(folder)) for path in found)
