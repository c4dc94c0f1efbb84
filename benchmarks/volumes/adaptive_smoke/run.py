"""Pixel mini-batches of smoke (Adaptive, its last figure): uniform, by the loss derivative, adaptive. `smoke`, L2.

Two paths per pixel, as many pixels for all, Adam, its learning rates tuned per scheme on a seed of its own for the whole budget: the
albedo's, extinction's being 10 times that. Errors as in `volumes.fig11_smoke`: root mean squares relative to the start, of extinction and
of extinction times albedo, averaged. At equal time; ratios to uniform at ten checkpoints, by time and by samples.
"""

from __future__ import annotations

from typing import Any

import unrender as ur
from benchmarks import figures, markdown
from benchmarks.pixel_schemes import SCHEMES, pixels
from benchmarks.races import Entrant, over, race, scaled
from benchmarks.runner.records import Record
from benchmarks.volumes.fig11_smoke.scenes import measure

RATES = (0.003, 0.01)
QUICK = {"seconds": 0.5, "seeds": 2, "count": 32, "resolution": 8, "grid": 8}


def run(
    seconds: float = 8.0, seeds: int = 3, count: int = 1024, resolution: int = 64, grid: int = 32
) -> dict[str, Any]:
    """The race of the three schemes."""
    size = {"resolution": resolution, "grid_resolution": grid}
    problem = ur.gallery.problem("smoke", **size, loss="L2", reference_spp=1024)
    adam, entrants = scaled(ur.optimizers.Adam), []
    for scheme in SCHEMES:
        estimator = ur.PathGradient(pixels=pixels(scheme, count), spp=2)
        entrants.append(Entrant(scheme, scheme, estimator, adam, RATES))
    methods = race(problem, entrants, seeds, measure=measure(problem), by="both", seconds=seconds)
    return {"methods": methods, "over uniform": over({n: e["runs"]["both"] for n, e in methods.items()}, "uniform")}


def table(record: Record) -> str:
    """Final errors, and ratios to uniform draws."""
    over = record["over uniform"]
    rows = [
        [
            markdown.fill("{name} | {rate:g} | {final[both]!m}", entry),
            *(" ".join(f"{x:.3f}" for x in ratios[entry["name"]][1::3]) for ratios in over.values()),
        ]
        for entry in markdown.named(record["methods"], "name")
    ]
    head = ["pixels | learning rate | final error", *(f"over uniform, at .2 .5 .8 of the {by}" for by in over)]
    text = "`smoke`, {resolution}², grids of {grid}³, {count} pixels a step, L2, {seconds:g} s, {seeds} seeds."
    return markdown.blocks(text.format(**record["settings"]), markdown.table(" | ".join(head), rows))


def plot(record: Record) -> figures.Figure:
    """Error over seconds and over paths."""
    panels = {
        f"over {unit}": figures.race_curves(record["methods"], "both", column)
        for column, unit in enumerate(("seconds", "paths"))
    }
    return figures.curves(panels, "")
