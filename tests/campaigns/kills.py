"""Kills at enumerated file operations."""

from __future__ import annotations

import hashlib
import json
import shutil
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from tests.campaigns.cuts import final_state, leftovers
from tests.campaigns.machine import KILLED, Victims
from unrender.app.cli.signals import DOUBTFUL
from unrender.runs.folder.schema import ENDED

__all__ = ["COMMANDS", "METHODS", "campaign", "digest"]

_COMMON = ["--threads", 1, "--variant", "llvm_ad_rgb", "--final-spp", 1, "--checkpoint-every", 4]
_ROOM = ["indirect-room", "-p", "resolution=8", "-p", "texture_resolution=4", "-p", "reference_spp=8"]
_SCENE = [*_ROOM, "--method", "plain", "--steps", 4, *_COMMON]
METHODS: dict[str, list[Any]] = {
    "plain": ["exponential", "--method", "plain", "--set", "spp=2", "--steps", 12, *_COMMON],
    "rcv": [*_ROOM, "--method", "rcv", "--steps", 12, *_COMMON],
    "coupled": [*_ROOM, "--method", "coupled", "--steps", 12, *_COMMON],
}
"""Run that is killed, by method."""


class _Case:
    """A command that is killed.

    Args:
        victims: carry it out.
        home: a folder for it.
        method: of the runs, one of `METHODS`.
    """

    def __init__(self, victims: Victims, home: Path, method: str):
        self.victims, self.home, self.options = victims, home, METHODS[method]
        shutil.rmtree(home, ignore_errors=True)
        home.mkdir(parents=True)
        self.prepare()

    def prepare(self) -> None:
        """Once, before the first kill."""

    def begin(self, folder: Path) -> None:
        """Before each."""

    def words(self, folder: Path) -> Sequence[object]:
        """The command, all of whose files lie below `folder`."""
        raise NotImplementedError

    def judge(self, folder: Path) -> str:
        """What is wrong after a kill, and after what its user would do then; "" for nothing."""
        raise NotImplementedError

    def must(self, *words: object) -> None:
        """A command that must succeed."""
        if (status := self.victims.carry_out(*words)) not in (0, DOUBTFUL):
            raise RuntimeError(f"{words}: exit status {status}")

    def go_on(self, run: Path, whole: dict[str, bytes], anew: Sequence[object]) -> str:
        """Resume a run, or begin it anew where it had not begun."""
        if (run / "run.json").exists():
            finished = json.loads((run / "run.json").read_text())["status"] in ENDED
            self.must("report" if finished else "resume", run)
        else:
            self.must(*anew)
        return "" if final_state(run) == whole else "other numbers"


class _Run(_Case):
    def prepare(self) -> None:
        self.must("run", *self.options, "--out", self.home / "whole")
        self.whole = final_state(self.home / "whole")

    def words(self, folder: Path) -> Sequence[object]:
        return "run", *self.options, "--out", folder / "run"

    def judge(self, folder: Path) -> str:
        return self.go_on(folder / "run", self.whole, (*self.words(folder), "--overwrite"))


class _Resume(_Run):
    """Of a run that was killed in its middle."""

    def prepare(self) -> None:
        super().prepare()
        begun = self.home / "begun"
        self.victims.carry_out("run", *self.options, "--out", begun / "run", watch=str(begun), at=110)
        shutil.rmtree(begun / "run" / "live", ignore_errors=True)

    def begin(self, folder: Path) -> None:
        shutil.copytree(self.home / "begun", folder)

    def words(self, folder: Path) -> Sequence[object]:
        return "resume", folder / "run"


class _Compare(_Case):
    """Two methods, made and compared; the folder must be readable, and the command must succeed when it is given again."""

    def words(self, folder: Path) -> Sequence[object]:
        common = ["--variant", "llvm_ad_rgb", "--final-spp", 1, "--seconds", 0.01]
        return "compare", "exponential", "--methods", "plain,rcv", *common, "--out", folder / "both"

    def judge(self, folder: Path) -> str:
        both = folder / "both"
        for record in both.glob("*/run.json"):
            json.loads(record.read_text())
        again = ["--overwrite"] if both.exists() and any(both.iterdir()) else []
        self.must(*self.words(folder), *again)
        expected = {"compare.html", "compare.json", "plain-seed0", "rcv-seed0"}
        return "" if expected <= {path.name for path in both.iterdir()} else "not all is there"


class _Export(_Case):
    """In place of an earlier export of other values."""

    def prepare(self) -> None:
        self.run, self.old, self.new = (self.home / name for name in ("run", "old", "new"))
        self.must("run", *_SCENE, "--out", self.run)
        self.must("export", self.run, "--out", self.old, "--variant", "llvm_ad_rgb")
        self.must("resume", self.run, "--steps", 8)
        self.must("export", self.run, "--out", self.new, "--variant", "llvm_ad_rgb")
        self.digests = {digest(self.old): "old", digest(self.new): "new"}
        if len(self.digests) != 2:
            raise RuntimeError("both exports are the same")

    def begin(self, folder: Path) -> None:
        shutil.copytree(self.old, folder / "scene")

    def words(self, folder: Path) -> Sequence[object]:
        return "export", self.run, "--out", folder / "scene", "--overwrite", "--variant", "llvm_ad_rgb"

    def judge(self, folder: Path) -> str:
        if digest(folder / "scene") not in self.digests:
            return "neither the old export nor the new one"
        self.must(*self.words(folder))
        return "" if self.digests.get(digest(folder / "scene")) == "new" else "not the new export"


def digest(folder: Path) -> str:
    """Return a hash of the names and contents of all files of a folder."""
    state = hashlib.sha256()
    for path in sorted(folder.rglob("*")):
        state.update(f"{path.relative_to(folder)}\0".encode())
        state.update(path.read_bytes() if path.is_file() else b"")
    return state.hexdigest()


COMMANDS: dict[str, Callable[[Victims, Path, str], _Case]] = {
    "run": _Run,
    "resume": _Resume,
    "compare": _Compare,
    "export": _Export,
}


def campaign(victims: Victims, folder: Path, command: str, number: int, method: str = "plain") -> dict[str, Any]:
    """So many kills of a command, at file operations spread evenly over it; runs are by a method."""
    case = COMMANDS[command](victims, folder / command, method)
    counted, seen = folder / command / "counted", folder / command / "operations"
    case.begin(counted)
    status = victims.carry_out(*case.words(counted), watch=str(counted), count=str(seen))
    if status not in (0, DOUBTFUL):
        raise RuntimeError(f"{command}: exit status {status}")
    names = seen.read_text().splitlines()
    wrong: list[str] = []
    at: Counter[str] = Counter()
    killed = 0
    for index in range(number):
        operation = index * len(names) // number
        place = folder / command / "killed"
        shutil.rmtree(place, ignore_errors=True)
        case.begin(place)
        if victims.carry_out(*case.words(place), watch=str(place), at=operation) == KILLED:
            killed += 1
            at[names[operation].split()[0]] += 1
            try:
                reason = case.judge(place)
            except (RuntimeError, OSError, ValueError) as error:
                reason = str(error)
            left = leftovers(place)
            if reason or left:
                wrong.append(f"operation {operation}, {names[operation]}: {reason} {left}")
    return {"operations": len(names), "killed": killed, "right": killed - len(wrong), "at": dict(at), "wrong": wrong}
