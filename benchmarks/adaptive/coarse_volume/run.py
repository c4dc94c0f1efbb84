"""Pixel mini-batches of an emissive volume that is coarse at first (Adaptive Fig. 9, LEGO): `nerf-volume`, 8³ to 64³ or finer.

Extinction and emission, 32 views of a toy, the resolution doubled every so many steps as in the paper, from 8³ to `grid`³ (256 is the
paper's, for GPUs), two paths per pixel. Uniform and adaptive mini-batches of as many pixels; "uniform, finest" has the finest grid from the
start. Adam, its learning rate of the emission tuned per entrant on a seed of its own by the pictures that are seen, that of the extinction
20 times it. After the last doubling rates fall along half a cosine.

The volume has no truth, so errors are of pictures, root mean square over a few of the views that the descent sees and over 4 between them
that it does not, relative to the start's: products of two independent renders' differences, free of the renders' noise, not of that of the
references. Seconds are of the processor, maps included. Equal time: when an entrant first reaches the worse of its own and uniform
mini-batches' last error, over when these do.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np

import unrender as ur
from benchmarks.internals import Key, SampleRequest, Tree, arrays, prepare
from benchmarks.measured_races import UNIT, Scaled
from benchmarks.pixel_schemes import pixels
from benchmarks.races import TUNING_SEED, median_and_range, over, reached, search
from benchmarks.runner.timing import work_time

UNSEEN = 4
COARSEST = 8
POINTS = 12
RATES = (0.02, 0.04)
WAYS = {"uniform": ("uniform", True), "adaptive": ("adaptive", True), "uniform, finest": ("uniform", False)}
"""Of mini-batches, and whether the grid is coarse at first."""
MERGE = ("methods",)
QUICK = {"resolution": 16, "grid": 16, "views": 4, "every": 2, "after": 2, "count": 64, "seeds": 1, "reference_spp": 4}


class Falling:
    """1 until a step, from there half a cosine down to a twentieth."""

    def __init__(self, start: int, end: int):
        self.start, self.end = start, end

    def __call__(self, step: float) -> float:
        share = min(max((step - self.start) / max(self.end - self.start, 1), 0.0), 1.0)
        return 0.05 + 0.95 * (1 + float(np.cos(np.pi * share))) / 2


class PictureErrors:
    """How far renders of some views are from their references, relative to the start."""

    def __init__(self, made: ur.Problem, options: dict[str, Any], groups: dict[str, list[int]], spp: int = 8):
        own = ur.gallery.problem("nerf-volume", **{**options, "reference_spp": 1})
        self.session, self.groups, self.spp = prepare(own, made.initial()), groups, spp
        self.views = made.views
        self.start = self.errors(made.initial())

    def __call__(self, parameters: Tree) -> dict[str, float]:
        return {name: error / self.start[name] for name, error in self.errors(parameters).items()}

    def errors(self, parameters: Tree) -> dict[str, float]:
        """Root mean square over each group's views."""
        found = {}
        for name, group in self.groups.items():
            squares = []
            for number in group:
                request = SampleRequest(self.views[number].sensor, self.spp, Key(424_242, number).uint32(), 2)
                images = arrays.numpy(self.session.image(parameters, request).images).astype(np.float64)
                a, b = images - np.asarray(self.views[number].reference, np.float64)
                squares.append(float(np.mean(a * b)))
            found[name] = max(float(np.mean(squares)), 0.0) ** 0.5
        return found


class Recorder(ur.protocols.Callback):
    """(processor seconds, paths, error) along a run, for each error; its own time is not the run's."""

    def __init__(self, errors: PictureErrors, array: Any, every: int):
        self.errors, self.array, self.every, self.clock = errors, array, every, 0.0
        self.points: dict[str, list[tuple[float, float, float]]] = {name: [(0.0, 0.0, 1.0)] for name in errors.start}
        self.since = work_time()

    def on_step(self, run: Any, record: dict[str, Any]) -> None:
        """See `Callback.on_step`."""
        self.clock += work_time() - self.since
        if run.step % self.every == 0:
            full = {key: self.array(value) for key, value in run.full().items()}
            for name, error in self.errors(full).items():
                self.points[name].append((self.clock, float(record["samples"]), error))
        self.since = work_time()


def resolutions(grid: int, every: int) -> tuple[int, ...]:
    """The steps at which a grid of 8³ doubles until it is `grid`³."""
    return tuple(every * number for number in range(1, (grid // COARSEST).bit_length()))


def run(
    resolution: int = 128,
    grid: int = 64,
    views: int = 32,
    every: int = 200,
    after: int = 400,
    count: int = 4096,
    seeds: int = 2,
    reference_spp: int = 16,
    only: tuple[str, ...] = tuple(WAYS),
) -> Iterator[dict[str, Any]]:
    """A part per entrant.

    Args:
        resolution: film size
        grid: voxels along a side in the end, 8 times a power of two; 256 in the paper
        views: that the descent sees
        every: steps between doublings
        after: steps at the finest resolution
        count: pixels a step
        only: entrants to run; the others' figures stay
    """
    changes = resolutions(grid, every)
    steps = every * len(changes) + after
    options = {
        "resolution": resolution, "grid_resolution": grid, "views": views + UNSEEN, "reference_spp": reference_spp
    }  # fmt: skip
    made = ur.gallery.problem("nerf-volume", **options)
    unseen = [((2 * number + 1) * len(made.views)) // (2 * UNSEEN) for number in range(UNSEEN)]
    seen = [number for number in range(len(made.views)) if number not in unseen]
    groups = {"seen": seen[:: max(len(seen) // UNSEEN, 1)][:UNSEEN], "unseen": unseen}
    errors = PictureErrors(made, options, groups)

    def problem(coarse: bool) -> ur.Problem:
        way = ur.scene.CoarseToFine(changes, states="carry") if coarse else None
        parameters = [replace(parameter, coarse_to_fine=way) for parameter in made.parameters]
        return made.replaced(parameters=parameters, views=[made.given_views[number] for number in seen])

    def descend(name: str, rate: float, seed: int, points: int) -> dict[str, list[tuple[float, float, float]]]:
        scheme, coarse = WAYS[name]
        schedule = Scaled(rate / UNIT, Falling(changes[-1], steps))
        recorder = Recorder(errors, made.renderer.array, max(steps // points, 1))
        estimator = ur.PathGradient(pixels=pixels(scheme, count), spp=2)
        adam = ur.optimizers.Adam(UNIT, schedule=schedule)
        result = ur.optimize(problem(coarse), estimator, adam, steps=steps, seed=seed, callbacks=[recorder])
        if result.warnings:
            raise RuntimeError(f"{name}: {result.warnings}")
        return recorder.points

    for name in only:

        def final(rate: float, name: str = name) -> float:
            error = descend(name, rate, TUNING_SEED, 1)["seen"][-1][2]
            print(f"{name} rate {rate:g}: {error:.4f}", flush=True)
            return error

        rate, tried = search(RATES, final)
        runs: dict[str, list[Any]] = {group: [] for group in groups}
        for seed in range(seeds):
            for group, found in descend(name, rate, seed, POINTS).items():
                runs[group].append(found)
        last = {group: median_and_range([run[-1][2] for run in found]) for group, found in runs.items()}
        print(name, rate, last, flush=True)
        yield {
            "conditions": {**options, "changes": changes, "steps": steps, "count": count, "seeds": seeds},
            "methods": {name: {"rate": rate, "tried": tried, "runs": runs, "final": last}},
        }


def summarize(record: dict[str, Any]) -> dict[str, Any]:
    """Errors over uniform mini-batches' at equal time and paths, and times to the worse of both ends over theirs."""
    if "uniform" not in record["methods"]:
        return {}
    runs = {name: entry["runs"]["seen"] for name, entry in record["methods"].items()}
    times = {}
    for name, found in runs.items():
        level = max(float(np.median([run[-1][2] for run in each])) for each in (found, runs["uniform"]))
        one, other = reached(found, level, 0), reached(runs["uniform"], level, 0)
        times[name] = one / other if one and other else None
    return {"over uniform": over(runs, "uniform"), "time": times}
