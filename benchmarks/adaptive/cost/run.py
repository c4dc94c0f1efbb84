"""The cost of adaptive pixel mini-batches: importance-map updates, image sizes, memory.

Updates: wall time of `Adaptive` with its probabilities updated every 20 steps over that with the same ones kept, steps
in turns. Sizes: one view of `plain-and-textured` from 256² to 4096² pixels, updates included, against black references
(their values do not change the work). Memory: 16 views of 4 megapixels of `two-planets`, in a process of its own, its
greatest resident size.
"""

from __future__ import annotations

import resource
from typing import Any

import numpy as np

import unrender as ur
from benchmarks.internals import Key, dr, scene_description
from benchmarks.runner.timing import in_new_process, medians, turns

UPDATE = 20
PROBLEMS = ("mirror-trio", "sun-glossy", "plain-and-textured", "two-planets")
QUICK = {"problem": ("mirror-trio",), "count": 64, "rounds": 1, "largest": 256, "memory_size": 64}


class Steps:
    """Steps of one estimator at constant parameters, in rounds of `UPDATE`."""

    def __init__(self, problem: ur.Problem, pixels: Any):
        self.problem, self.estimator = problem, ur.PathGradient(pixels=pixels, spp=2)
        self.at = problem.initial()
        self.state = self.estimator.init(problem, self.at)
        self.step = 0

    def __call__(self, number: int = 0) -> None:
        """`UPDATE` steps."""
        gradient: Any = None
        for _ in range(UPDATE):
            found, self.state = self.estimator.estimate(self.problem, self.at, self.state, Key(0, self.step))
            gradient = found.gradient
            self.step += 1
        dr.eval(gradient)


def milliseconds(contenders: dict[str, Steps], rounds: int) -> dict[str, float]:
    """Median of a step of each, their rounds in turns."""
    return {name: ms / UPDATE for name, ms in medians(turns(contenders, rounds, warm=2)).items()}


def at_size(name: str, size: int, views: int = 1) -> ur.Problem:
    """The gallery's problem with films of another size and black references."""
    small = ur.gallery.problem(name, resolution=16, **({"views": views} if views > 1 else {}))

    def scene() -> dict[str, Any]:
        found = dict(scene_description(small))
        for key, value in found.items():
            if isinstance(value, dict) and "film" in value:
                found[key] = dict(value, film=dict(value["film"], width=size, height=size))
        return found

    black = np.zeros((size, size, 3), np.float32)
    references = [ur.View(black, sensor=view.sensor) for view in small.views]
    return ur.Problem(scene, small.parameters, references, max_depth=small.max_depth)


def memory(size: int) -> dict[str, Any]:
    """16 views of size² pixels, forty steps: the greatest resident size of this process."""
    ur.use()
    problem, estimator = at_size("two-planets", size, views=16), ur.PathGradient(pixels=ur.pixels.Adaptive(4096), spp=2)
    result = ur.optimize(problem, estimator, ur.optimizers.Adam(), steps=40)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    return {"peak_gb": peak, "steps": len(result.history), "host": problem.references.in_host_memory}


def updates(problem: ur.Problem, count: int, rounds: int) -> dict[str, float]:
    """Milliseconds of a step with uniform pixels, with adaptive ones kept, and updated; the share of updates."""
    updated = Steps(problem, ur.pixels.Adaptive(count))
    for _ in range(4):
        updated()
    tiles = len(updated.state.pixels.shares)
    kept = Steps(problem, ur.pixels.Adaptive(count, refresh=10**9, samples=tiles))
    kept.state = updated.state  # the same pixels, which may cost more than those of a first estimate
    uniform = Steps(problem, ur.pixels.Uniform(count))
    found = milliseconds({"refreshed": updated, "kept": kept, "uniform": uniform}, rounds)
    return {**found, "share": 1 - found["kept"] / found["refreshed"]}


def run(
    problem: tuple[str, ...] = PROBLEMS,
    count: int = 16384,
    rounds: int = 9,
    largest: int = 4096,
    memory_size: int = 2048,
) -> dict[str, Any]:
    """All three parts.

    Args:
        count: pixels a step
        rounds: of turns
        largest: film
        memory_size: films of the measurement of memory, pixels along a side
    """
    shares = {name: updates(ur.gallery.problem(name), count, rounds) for name in problem}
    sizes = [size for size in (256, 512, 1024, 2048, 4096) if size <= largest]
    films = {str(size): Steps(at_size("plain-and-textured", size), ur.pixels.Adaptive(count)) for size in sizes}
    steps = milliseconds(films, rounds)
    return {"refresh": shares, "step_ms": steps, "memory": in_new_process(memory, memory_size)}
