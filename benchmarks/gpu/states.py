"""What became of each slice: one JSON file a slice, beside the records of its benchmarks."""

from __future__ import annotations

import json
import os
import subprocess
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks.gpu.plan import Command, Slice
from benchmarks.runner.catalogue import PACKAGE, ROOT

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
        path: with `<slice>.json`, `<slice>/<benchmark>/results.json`, and, of tests, `<slice>/tests.jsonl`.
        is_toy: of toy sizes.
    """

    path: Path
    is_toy: bool = False

    def read(self, part: Slice) -> State:
        """The slice's state; empty where it never ran."""
        file = self.path / f"{part.name}.json"
        return json.loads(file.read_text()) if file.is_file() else {}

    def forget(self, part: Slice) -> None:
        """Make the slice one that never ran. Records of benchmarks stay until they are written anew; those of tests are removed."""
        (self.path / f"{part.name}.json").unlink(missing_ok=True)
        (self.path / part.name / "tests.jsonl").unlink(missing_ok=True)

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
