"""One run over many workers: whether results stay the same, what it costs, and what is left of runs whose workers are killed.

Same: `two-planets`, 16 views, by method rcv; the parameters after a number of steps by 1, 2 and 4 workers of one thread
each against those of one process, and two runs of 2 workers against one another.

Efficiency: seconds a step of n workers with one thread each, against one process with n threads and with one.

Link: two nodes of Ray in two network namespaces, joined by a link of limited rate and delay; bytes of arrays a step, sent
and received, and the share of the step's time that is not the slowest worker's own, with and without compression. Needs
root.

Kills: two such nodes without a limit. Workers (SIGKILL), a node with all that it runs, the driver, which is then resumed,
and the driver with the head node, which is then resumed at another address, in turn, each at a random step of a run. Every run
must end with the bits of the run without a kill. And of each method a run one of whose workers has a tenth of its speed from some step
on. Needs root.
"""

from __future__ import annotations

import json
import os
import random
import subprocess
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.runner.catalogue import ROOT
from benchmarks.runner.records import scratch
from benchmarks.workers import kills
from benchmarks.workers.machines import Link, Machines

RENDERS = False
MERGE = ("same", "efficiency", "link", "kills", "stragglers")
PARTS = ("same", "efficiency", "link", "kills")
METHODS = tuple(kills.METHODS)
QUICK = {"part": ("same",), "steps": 4, "workers": (2,), "resolution": 16, "texture": 16}


def run(
    part: tuple[str, ...] = PARTS,
    workers: tuple[int, ...] = (1, 2, 4),
    steps: int = 200,
    resolution: int = 32,
    texture: int = 128,
    loss: str = "L2",
    link_texture: int = 256,
    link_steps: int = 20,
    megabits: float = 100.0,
    milliseconds: float = 20.0,
    method: tuple[str, ...] = METHODS,
    number_of_kills: int = 17,
    kill_steps: int = 60,
    seed: int = 0,
) -> Iterator[dict[str, Any]]:
    """All of it.

    Args:
        part: of the benchmark
        workers: how many
        steps: of the runs that are compared
        resolution: of the views
        texture: texels along a side of each of the two textures
        loss: of the runs that are compared; L1 turns rounding into flipped signs
        link_texture: likewise of runs over the link
        link_steps: of runs over the link
        megabits: a second, of the link
        milliseconds: of delay there and back
        method: whose runs are killed
        number_of_kills: of each method, of workers, nodes, drivers and heads in turn
        kill_steps: of each of these runs
        seed: of the instants
    """
    if os.geteuid() != 0 and {"link", "kills"} & set(part):
        sys.exit("workers: network namespaces need root; --part same efficiency does without")
    folder = scratch("workers")
    found: dict[str, Any] = {"same": {}, "efficiency": {}, "link": {}, "kills": {}, "stragglers": {}}
    problem = {"problem": "two-planets", "method": "rcv", "settings": {"spp": 2}, "seed": 0, "compress": False}
    options = {"resolution": resolution, "texture_resolution": texture, "reference_spp": 32, "loss": loss}
    base = {**problem, "options": options, "steps": steps}
    if "same" in part:
        found["same"] = _same(folder, base, workers)
        yield found
    if "efficiency" in part:
        for count in workers:
            alone = _measured(folder, {**base, "workers": "", "threads": count, "steps": min(steps, 40)})
            many = _measured(folder, {**base, "workers": str(count), "threads": 1, "steps": min(steps, 40)})
            found["efficiency"][str(count)] = {
                "one_process": alone["seconds"],
                "workers": many["seconds"],
                "busy": many["busy"],
            }
            print(count, found["efficiency"][str(count)], flush=True)
            yield found
    if "link" in part:
        with Link(megabits, milliseconds) as link, Machines(link) as machines:
            over = {
                **base,
                "options": {**options, "texture_resolution": link_texture},
                "steps": link_steps,
                "threads": 1,
            }
            for compress in (False, True):
                order = {**over, "workers": f"2@{machines.address}", "compress": compress}
                before = link.carried()
                row = _measured(folder, order, machines)
                row["carried"] = (link.carried() - before) / link_steps
                row["wire_share"] = 1 - row["busy"] / row["waited"]
                found["link"]["compressed" if compress else "whole"] = row
                print(row, flush=True)
                yield found
    if "kills" in part:
        dice = random.Random(seed)
        with Link() as link, Machines(link) as machines:
            for name in method:
                for rows in kills.campaign(machines, folder / name, name, number_of_kills, kill_steps, dice):
                    found["kills"][name] = rows
                    yield found
                found["stragglers"][name] = kills.straggler(machines, folder / name, name, kill_steps, dice)
                print(name, found["stragglers"][name], flush=True)
                yield found


def _same(folder: Path, base: Mapping[str, Any], workers: tuple[int, ...]) -> dict[str, Any]:
    """Relative differences of the parameters, in the Euclidean norm."""
    _measured(folder, {**base, "workers": "", "threads": 1})
    alone, rows = _parameters(folder), {}
    for count in workers:
        _measured(folder, {**base, "workers": str(count), "threads": 1})
        rows[str(count)] = {"relative": float(np.linalg.norm(_parameters(folder) - alone) / np.linalg.norm(alone))}
        print(count, rows[str(count)], flush=True)
    first = None
    for _ in range(2):
        _measured(folder, {**base, "workers": "2", "threads": 1})
        again = _parameters(folder)
        rows["two of 2"] = {"relative": 0.0 if first is None else float(np.abs(again - first).max())}
        first = again
    print("two of 2", rows["two of 2"], flush=True)
    return rows


def _measured(folder: Path, order: Mapping[str, Any], machines: Machines | None = None) -> dict[str, float]:
    """What `driver` answers."""
    file = folder / "order.json"
    file.write_text(json.dumps({**order, "parameters": str(folder / "parameters.npz")}))
    words: list[object] = [sys.executable, "-m", "benchmarks.workers.driver", file]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), str(ROOT / "src")])}
    if machines is not None:
        words, environment = list[object](machines.link.words(machines.head, *words)), machines.environment
    told = subprocess.run(
        [str(word) for word in words], check=True, stdout=subprocess.PIPE, text=True, env=environment, cwd=ROOT
    ).stdout
    return json.loads(told.splitlines()[-1])


def _parameters(folder: Path) -> np.ndarray:
    with np.load(folder / "parameters.npz", allow_pickle=False) as stored:
        return np.concatenate([stored[key].ravel() for key in sorted(stored)]).astype(np.float64)
