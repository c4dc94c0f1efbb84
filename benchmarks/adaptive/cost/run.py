"""What drawn pixels cost: the share of a run that goes into probabilities, a step's time by the size of the pictures, and memory.

    python benchmarks/adaptive/cost/run.py [--count 16384] [--largest 4096]

Share: wall time of `Adaptive` with its probabilities refreshed every 20 steps over that with the same ones kept, steps in turns. Sizes:
one view of `plain-and-textured` from 256² to 4096² pixels, refreshes included, against black references (their values do not change the
work). Memory: 16 views of 4 megapixels of `two-planets`, in a process of its own, its greatest resident size.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import drjit as dr
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
from common import mitsuba_renderer, write

import unrender as ur
from unrender.core.random import Key

HERE = Path(__file__).resolve().parent
REFRESH = 20


class Steps:
    """Steps of one estimator at a standstill, timed in rounds of `REFRESH`."""

    def __init__(self, problem: ur.Problem, pixels: Any):
        self.problem, self.estimator = problem, ur.PathGradient(pixels=pixels, spp=2)
        self.at = problem.initial()
        self.state = self.estimator.init(problem, self.at)
        self.step = 0
        self.times: list[float] = []

    def round(self, keep: bool = True) -> None:
        """`REFRESH` steps."""
        dr.sync_thread()
        began = time.perf_counter()
        for _ in range(REFRESH):
            found, self.state = self.estimator.estimate(self.problem, self.at, self.state, Key(0, self.step))
            self.step += 1
        dr.eval(found.gradient)  # pyright: ignore[reportPossiblyUnboundVariable]
        dr.sync_thread()
        if keep:
            self.times.append((time.perf_counter() - began) / REFRESH)

    def milliseconds(self) -> float:
        """Median of a step."""
        return 1e3 * float(np.median(self.times))


def in_turns(runs: dict[str, Steps], rounds: int) -> dict[str, float]:
    """Median milliseconds of a step of each, their rounds in turns."""
    for steps in runs.values():
        steps.round(keep=False)
        steps.round(keep=False)
    for _ in range(rounds):
        for steps in runs.values():
            steps.round()
    return {name: steps.milliseconds() for name, steps in runs.items()}


def at_size(name: str, size: int, views: int = 1) -> ur.Problem:
    """The gallery's problem with films of another size and black references."""
    small = ur.gallery.problem(name, resolution=16, **({"views": views} if views > 1 else {}))
    description = mitsuba_renderer(small).pair.description
    assert callable(description)

    def scene() -> dict[str, Any]:
        found = dict(description())
        for key, value in found.items():
            if isinstance(value, dict) and "film" in value:
                found[key] = dict(value, film=dict(value["film"], width=size, height=size))
        return found

    black = np.zeros((size, size, 3), np.float32)
    return ur.Problem(
        scene, small.parameters, [ur.View(black, sensor=view.sensor) for view in small.views], max_depth=small.max_depth
    )


def memory(size: int) -> None:
    """In a process of its own: 16 views, forty steps; prints the greatest resident size in GB."""
    problem = at_size("two-planets", size, views=16)
    result = ur.optimize(
        problem, ur.PathGradient(pixels=ur.pixels.Adaptive(4096), spp=2), ur.optimizers.Adam(), steps=40
    )
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    print(json.dumps({"peak_gb": peak, "steps": result.steps, "host": problem.references.in_host_memory}))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=16384, help="pixels a step")
    parser.add_argument("--rounds", type=int, default=9)
    parser.add_argument("--largest", type=int, default=4096)
    parser.add_argument("--memory", type=int, metavar="SIZE", help="only this part, of films of SIZE² pixels")
    asked = parser.parse_args()
    ur.use()
    if asked.memory:
        return memory(asked.memory)
    shares = {}
    for name in ("mirror-trio", "sun-glossy", "plain-and-textured", "two-planets"):
        problem = ur.gallery.problem(name)
        refreshed = Steps(problem, ur.pixels.Adaptive(asked.count))
        for _ in range(4):
            refreshed.round(keep=False)
        cells = len(refreshed.state.pixels.shares)
        kept = Steps(problem, ur.pixels.Adaptive(asked.count, refresh=10**9, samples=cells))
        kept.state = refreshed.state  # the same pixels, which may be dearer than those of a first estimate
        runs = {"refreshed": refreshed, "kept": kept, "uniform": Steps(problem, ur.pixels.Uniform(asked.count))}
        found = in_turns(runs, asked.rounds)
        shares[name] = {**found, "share": 1 - found["kept"] / found["refreshed"]}
        print(name, shares[name], flush=True)
    sizes = [s for s in (256, 512, 1024, 2048, 4096) if s <= asked.largest]
    films = {str(size): Steps(at_size("plain-and-textured", size), ur.pixels.Adaptive(asked.count)) for size in sizes}
    steps = in_turns(films, asked.rounds)
    print(steps, flush=True)
    command = [sys.executable, str(Path(__file__)), "--memory", "2048"]
    told = subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip().splitlines()[-1]
    print(told)
    write(HERE, {"settings": vars(asked), "refresh": shares, "step_ms": steps, "memory": json.loads(told)})


if __name__ == "__main__":
    main()
