"""What is left of runs and exports after power cuts and kills, and what it costs to leave that.

Power cuts: runs by four methods on an ext4 file system in a file, which is shut down without a flush
(EXT4_IOC_SHUTDOWN) at a random instant, and right after the end; then mounted again and resumed. Only root can do that.
Each must end with the same bits as the run without a cut, and go on from the last checkpoint that was complete before the
cut, or a later one. The problems are a toy without a renderer, and for one cut of each method and the one after the end a
room of 8x8 pixels.

Kills: `run`, `resume`, `compare` and `export`, each killed (SIGKILL) at file operations spread evenly over all that it
does, then done again or resumed. Run folders must end with the same bits, exports must be the old or the new one at the
instant of the kill, and nothing may be left over.

Cost: the time that flushing takes in a run, from its folder's first file to its last, as a share of the time of
optimization.
"""

from __future__ import annotations

import os
import random
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from benchmarks.durability import cost, cuts, kills
from benchmarks.durability.machine import Victims
from benchmarks.runner.records import scratch

RENDERS = False
MERGE = ("cuts", "kills", "cost")
METHODS = cuts.METHODS
COMMANDS = kills.COMMANDS
PARTS = ("cuts", "kills", "cost")
QUICK = {"part": ("kills",), "number_of_kills": 4, "command": ("run", "resume")}


def run(
    part: tuple[str, ...] = PARTS,
    method: tuple[str, ...] = tuple(METHODS),
    command: tuple[str, ...] = tuple(COMMANDS),
    number_of_cuts: int = 5,
    number_of_kills: int = 50,
    seed: int = 0,
) -> Iterator[dict[str, Any]]:
    """All of it.

    Args:
        part: of the benchmark
        method: by which runs are made that the power is cut of, and whose cost is measured
        command: that is killed
        number_of_cuts: at random instants, of each method; one more comes right after the end
        number_of_kills: of each command
        seed: of the instants
    """
    folder = Path(os.environ.get("UNRENDER_DURABILITY", scratch("durability")))
    dice = random.Random(seed)
    found: dict[str, Any] = {"cuts": {}, "kills": {}, "cost": {}}
    with Victims() as victims:
        if "cuts" in part:
            if os.geteuid() != 0:
                sys.exit("durability: power cuts need root, to mount a file system; --part kills cost does without")
            for name in method:
                found["cuts"][name] = cuts.campaign(victims, folder, name, number_of_cuts, dice)
                print(name, found["cuts"][name], flush=True)
                yield found
        if "kills" in part:
            for name in command:
                found["kills"][name] = kills.campaign(victims, folder, name, number_of_kills)
                print(name, found["kills"][name], flush=True)
                yield found
    if "cost" in part:
        for name in method:
            found["cost"][name] = cost.measure(name)
            print(name, found["cost"][name], flush=True)
            yield found
