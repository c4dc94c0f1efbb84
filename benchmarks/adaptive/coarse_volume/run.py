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
from benchmarks import markdown
from benchmarks.pixel_schemes import pixels
from benchmarks.races import Entrant, over, race, reached, scaled
from benchmarks.runner.records import Record
from benchmarks.runner.timing import work_time
from benchmarks.timed_runs import ImageErrors

UNSEEN = 4
COARSEST = 8
POINTS = 12
RATES = (0.02, 0.04)
WAYS = {"uniform": ("uniform", True), "adaptive": ("adaptive", True), "uniform, finest": ("uniform", False)}
"""Of mini-batches, and whether the grid is coarse at first."""
MERGE = ("methods",)
QUICK = {"resolution": 16, "grid": 16, "views": 4, "every": 2, "after": 2, "count": 64, "seeds": 1, "reference_spp": 4}


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
        grid: voxels along a side in the end, 8 times a power of two; 256 in the paper
        views: that the descent sees
        every: steps between doublings
        after: steps at the finest resolution
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
    errors = ImageErrors(made, options, groups, 8)

    def problem(coarse: bool) -> ur.Problem:
        way = ur.scene.CoarseToFine(changes, states="carry") if coarse else None
        parameters = [replace(parameter, coarse_to_fine=way) for parameter in made.parameters]
        return made.replaced(parameters=parameters, views=[made.original_views[number] for number in seen])

    def ended(name: str, seed: int, result: ur.Result) -> None:
        if result.warnings:
            raise RuntimeError(f"{name}, seed {seed}: {result.warnings}")

    fall = ur.schedules.Cosine(after, 0.05)
    adam = scaled(ur.optimizers.Adam, lambda step: fall(max(step - changes[-1], 0.0)))
    conditions = {**options, "changes": changes, "steps": steps, "count": count, "seeds": seeds}
    for name in only:
        scheme, coarse = WAYS[name]
        entrant = Entrant(name, name, ur.PathGradient(pixels=pixels(scheme, count), spp=2), adam, RATES)
        budget = {"steps": steps, "clock": work_time, "points": POINTS}
        methods = race(problem(coarse), [entrant], seeds, measure=errors, by="seen", ended=ended, **budget)
        yield {"conditions": conditions, "methods": methods}


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


def table(record: Record) -> str:
    """Per entrant: errors, seconds, and what these are over uniform mini-batches'."""
    rows = []
    for entry in markdown.named(record["methods"], "name"):
        seconds, time = sorted(run[-1][0] for run in entry["runs"]["seen"]), record.get("time", {}).get(entry["name"])
        over = record.get("over uniform", {}).get("time", {}).get(entry["name"], [])
        row = markdown.fill("{name} | {rate:g} | {final[seen]!m} | {final[unseen]!m}", entry)
        at_end = "" if time is None else f"{time:.2f}"
        rows.append([row, f"{seconds[len(seconds) // 2]:.1f}", at_end, " ".join(f"{x:.2f}" for x in over)])
    head = "pixels | rate | error, views seen | unseen | processor seconds | time to the worse of both ends, over uniform's"
    head += " | error over uniform's, at tenths of the time"
    c = record["conditions"]
    text = (
        f"8³ to {c['grid_resolution']}³, doubled before steps {', '.join(map(str, c['changes']))}; {c['views'] - 4} views of "
        f"{c['resolution']}², {c['count']} pixels and {c['steps']} steps; medians and ranges of {c['seeds']} seeds."
    )
    return markdown.blocks(text, markdown.table(head, rows))
