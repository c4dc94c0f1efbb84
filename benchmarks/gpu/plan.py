"""The slices of plan.toml, and what became of each: one JSON file a slice, beside the records of its benchmarks."""

from __future__ import annotations

import json
import os
import shlex
import subprocess
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks.runner.catalogue import PACKAGE, ROOT
from unrender.io import toml_lines

_TOY_TESTS = {"unit": "losses", "contract": "tolerance", "render": "grids", "statistical": "grey_box_chain_rule"}


@dataclass(frozen=True)
class Command:
    """One process. A command that has ended is not run again.

    Attributes:
        words: "doctor", "tests" with a folder, or a benchmark with its options.
        minutes: expected on a GPU; an estimate.
    """

    words: str
    minutes: float

    @property
    def name(self) -> str:
        """What runs: "doctor", "tests" or a benchmark."""
        return shlex.split(self.words)[0]

    def arguments(self, toy: bool) -> list[str]:
        """Return the words after the name.

        Args:
            toy: benchmarks take the sizes of their `QUICK` and keep the options that are names; tests are those of one file.
        """
        given = shlex.split(self.words)[1:]
        if self.name == "tests":
            file = f"/test_{_TOY_TESTS[given[0]]}.py" if toy else ""
            return ["-m", "mitsuba and not slow", f"tests/{given[0]}{file}"]
        if not toy or self.name == "doctor":
            return given
        kept, option = ["--quick"], ""
        for word in given:
            if word.startswith("--"):
                option = word
            elif not word.replace(".", "", 1).isdigit():
                kept += [option, word] if option else [word]
                option = ""
        return kept


@dataclass(frozen=True)
class Slice:
    """A part of the plan.

    Attributes:
        name: on the command line.
        what: it shows; with the paper's figure where it is one's.
        commands: run in this order.
    """

    name: str
    what: str
    commands: tuple[Command, ...]

    @property
    def minutes(self) -> float:
        """Expected in all."""
        return sum(command.minutes for command in self.commands)


def _slices(file: Path) -> tuple[Slice, ...]:
    found = []
    for name, (what, *lines) in toml_lines.parse(file.read_text(encoding="utf-8"), str(file)).items():
        pairs = (line.split(" ", 1) for line in lines)
        found.append(Slice(name, what, tuple(Command(words, float(minutes)) for minutes, words in pairs)))
    return tuple(found)


SLICES = _slices(Path(__file__).with_name("plan.toml"))

State = dict[str, Any]


def device(on_gpu: bool) -> State:
    """The GPU as the driver names it, its memory and the driver's version; the processor where the plan runs without one."""
    if not on_gpu:
        from benchmarks.internals import hardware

        return {"name": hardware()["processor"], "variant": "llvm_ad_rgb"}
    asked = ["nvidia-smi", "--query-gpu=name,memory.total,driver_version", "--format=csv,noheader"]
    try:
        first = subprocess.run(asked, capture_output=True, text=True, timeout=30, check=True).stdout.splitlines()[0]
        name, memory, driver = (part.strip() for part in first.split(","))
    except (OSError, subprocess.SubprocessError, ValueError, IndexError):
        name, memory, driver = "GPU", "", ""
    return {"name": name, "memory": memory, "driver": driver, "variant": "cuda_ad_rgb"}


@dataclass(frozen=True)
class Folder:
    """Where states and records are.

    Attributes:
        path: with `<slice>.json` and `<slice>/<benchmark>/results.json`.
        is_toy: of toy sizes.
    """

    path: Path
    is_toy: bool = False

    def read(self, part: Slice) -> State:
        """The slice's state; empty where it never ran."""
        file = self.path / f"{part.name}.json"
        return json.loads(file.read_text()) if file.is_file() else {}

    def forget(self, part: Slice) -> None:
        """Make the slice one that never ran. Records of benchmarks stay until they are written anew."""
        (self.path / f"{part.name}.json").unlink(missing_ok=True)

    def note(self, part: Slice, command: Command, where: State, entry: State) -> None:
        """Write what became of a command."""
        state = self.read(part)
        commands = {**state.get("commands", {}), command.words: entry}
        self.path.mkdir(parents=True, exist_ok=True)
        new = {"slice": part.name, "date": time.strftime("%Y-%m-%d %H:%M"), "device": where, "commands": commands}
        file = self.path / f"{part.name}.json"
        beside = file.with_suffix(".part")
        beside.write_text(json.dumps(new, indent=1, ensure_ascii=False) + "\n")
        os.replace(beside, file)

    def ended(self, part: Slice, command: Command) -> str:
        """ "done", "failed", "cut short", or "" where it never ran."""
        return self.read(part).get("commands", {}).get(command.words, {}).get("ended", "")

    def summary(self, part: Slice) -> str:
        """One word or two of the slice: "not run", "done", "failed", "cut short", "2 of 3 done"."""
        ends = [self.ended(part, command) for command in part.commands]
        for word in ("cut short", "failed"):
            if word in ends:
                return word
        done = ends.count("done")
        if done in (0, len(ends)):
            return "done" if done else "not run"
        return f"{done} of {len(ends)} done"

    def is_next(self, part: Slice) -> bool:
        """Whether `--next` runs it: what failed is left for those who look into it."""
        return any(self.ended(part, command) in ("", "cut short") for command in part.commands)


FULL = Folder(PACKAGE / "gpu" / "records")
TOY = Folder(ROOT / "out" / "benchmarks" / "gpu-toy", is_toy=True)
