"""Samples that a control variate of the image saves (RCV Fig. 11): three volumes, L1.

The gallery's `smoke`, under a bright sky; the same smoke with a lamp inside it, under a dim one; and the volume of
Mitsuba's tutorials under the bright sky, which is left out where the assets are not there (`scenes.py`).

Differential ratio tracking with 1 adjoint path per pixel throughout; the image with 1 to 32 paths per pixel without a control variate, 1
and 2 with one. Adam, its learning rates tuned per method on a seed of its own for the whole budget: the albedo's, extinction's being 10
times that. At equal steps, and of `smoke` some of them at equal time. Grids of other sizes than 16³ have entries of their own, and
gradients smoothed by `Sobolev`, for all methods alike and at ten times the rates: of single voxels of 64³ an image tells too little.

Errors are root mean squares relative to where the descent began, of extinction and of the scattering coefficient
(extinction times albedo), averaged: the albedo of empty voxels shows in no image. "needs" says how many samples a plain
image needs for the error that a control variate leaves: between the two neighbours in spp, along a line in logarithms.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

import unrender as ur
from benchmarks import figures, markdown
from benchmarks.races import Entrant, race, scaled
from benchmarks.runner.records import Record
from benchmarks.volumes.fig11_smoke.scenes import FILE, measure, problem, smoothed

PLAIN = {"steps": (1, 2, 4, 8, 16, 32), "time": (1, 4, 16), "lit inside": (1, 4, 16), "tutorial": (1, 4, 16)}
WITH = {"steps": (1, 2), "time": (1, 2), "lit inside": (1,), "tutorial": (1,)}
RATES = {
    "steps": (0.001, 0.0018, 0.003),
    "time": (0.001, 0.003),
    "lit inside": (0.001, 0.002, 0.004),
    "tutorial": (0.002, 0.004, 0.008),
}
SMOOTHED_RATES = (0.01, 0.03, 0.1)
"""Where gradients are smoothed."""
OTHERS = ("lit inside", "tutorial")
"""Volumes beside `smoke`, at equal steps."""
USUAL_GRID = 16
MERGE = ("budgets.*.methods",)
QUICK = {"budget": ("steps", "lit inside"), "steps": 2, "seconds": 0.3, "seeds": 2, "resolution": 8, "grid": 8}


def entrants(budget: str, fine: bool = False) -> list[Entrant]:
    """Who races, on a grid of the usual size or on a fine one: the image's samples differ, the derivative's do not."""
    adam, cv = scaled(ur.optimizers.Adam), ur.images.RecursiveControlVariate
    rates = SMOOTHED_RATES if fine else RATES[budget]
    plain = [Entrant(f"plain, {n}", "plain", ur.PathGradient(spp=n, adjoint_spp=1), adam, rates) for n in PLAIN[budget]]
    return plain + [
        Entrant(f"rcv, {n}", "rcv", ur.PathGradient(cv(), spp=n, adjoint_spp=1), adam, rates) for n in WITH[budget]
    ]


def kind(entry: str) -> str:
    """The budget of an entry of the record: "steps" of "steps, 64³"."""
    return entry.partition(", ")[0]


def needs(found: dict[str, Any], name: str) -> dict[str, Any]:
    """Plain samples for the final error of "rcv, n": {"spp": ..., "times": spp / n}; "more_than" where no plain one reaches it."""
    spp = sorted(int(other.split(", ")[1]) for other in found if other.startswith("plain"))
    errors = [found[f"plain, {n}"]["final"]["both"][0] for n in spp]
    goal, own = found[name]["final"]["both"][0], int(name.split(", ")[1])
    first = next((i for i, error in enumerate(errors) if error <= goal), None)
    if first is None:
        return {"more_than": spp[-1], "times": spp[-1] / own}
    if first == 0:
        return {"spp": spp[0], "times": spp[0] / own}
    low, high = np.log(errors[first - 1]), np.log(errors[first])
    share = (low - np.log(goal)) / (low - high)
    between = float(np.exp(np.log(spp[first - 1]) + share * np.log(spp[first] / spp[first - 1])))
    return {"spp": between, "least": spp[first], "times": between / own}


def summarize(record: dict[str, Any]) -> dict[str, Any]:
    """Methods in order, and what plain images need at equal steps."""
    budgets: dict[str, Any] = {}
    for budget, entry in sorted(record["budgets"].items(), key=lambda item: list(PLAIN).index(kind(item[0]))):
        names = [entrant.name for entrant in entrants(kind(budget))]
        budgets[budget] = {**entry, "methods": {n: entry["methods"][n] for n in names if n in entry["methods"]}}
    found: dict[str, Any] = {"budgets": budgets, "needs": {}}
    for budget, entry in budgets.items():
        methods = entry["methods"]
        with_control = [name for name in methods if name.startswith("rcv") and kind(budget) != "time"]
        if with_control and len(methods) > len(with_control):
            found["needs"][budget] = {name: needs(methods, name) for name in with_control}
    return found


def run(
    budget: tuple[str, ...] = tuple(PLAIN),
    seconds: float = 10.0,
    steps: int = 300,
    seeds: int = 2,
    only: tuple[str, ...] = (),
    resolution: int = 24,
    grid: int = USUAL_GRID,
    assets: Path = Path("../shared/assets"),
) -> Iterator[dict[str, Any]]:
    """A part per budget.

    Args:
        budget: those to race, steps and time of smoke, or another volume at equal steps; the others' figures stay
        seconds: of every run at equal time
        steps: of every run at equal steps
        assets: folder with tutorials/volume.vol
    """
    for by in budget:
        made = problem(by if by in OTHERS else "smoke", resolution, grid, 4096, assets)
        if made is None:
            print(f"{by}: no {FILE} below {assets}: left out", flush=True)
            continue
        fine = grid != USUAL_GRID
        if fine:
            made = smoothed(made)
        limit: dict[str, Any] = {"seconds": seconds} if by == "time" else {"steps": steps}
        chosen = [entrant for entrant in entrants(by, fine) if not only or entrant.name in only]
        methods = race(made, chosen, seeds, measure=measure(made), by="both", **limit)
        label = f"{by}, {grid}³" if fine else by
        yield {
            "budgets": {label: {**limit, "seeds": seeds, "resolution": resolution, "grid": grid, "methods": methods}}
        }


def table(record: Record) -> str:
    """Final errors by samples of the image, and how many a control variate is worth."""
    of_smoke = {name: budget for name, budget in record["budgets"].items() if name in ("steps", "time")}
    others = {name: {name: budget} for name, budget in record["budgets"].items() if name not in of_smoke}
    parts = ["Learning rate of the albedo, error over the initial one: median (range); of `smoke`, seconds of a run."]
    for title, budgets in {"`smoke`": of_smoke, **others}.items():
        if not budgets:
            continue
        heads = (f"{b['steps']} steps" if "steps" in b else f"{b['seconds']:g} s" for b in budgets.values())
        first = next(iter(budgets.values()))
        rows = [
            [name, *(_summary(budget["methods"].get(name), by in of_smoke) for by, budget in budgets.items())]
            for name in first["methods"]
        ]
        told = [
            title.replace("steps, ", "`smoke`, ") + ", {resolution}², grids of {grid}³, {seeds} seeds.".format(**first)
        ]
        for need in (
            need for budget in budgets for need in markdown.named(record.get("needs", {}).get(budget, {}), "name")
        ):
            more = "more than " if "more_than" in need else ""
            plain = f"more than {need['more_than']}" if more else f"{need['spp']:.1f}"
            told.append(f"For the error of {need['name']} spp a plain image needs {plain} spp at equal steps:")
            told.append(f"{more}{need['times']:.1f} times the samples.")
        parts += [" ".join(told), markdown.table(" | ".join(["image, paths per pixel", *heads]), rows)]
    return markdown.blocks(*parts)


def _summary(entry: dict[str, Any] | None, timed: bool) -> str:
    if entry is None:
        return ""
    return markdown.fill("{rate:g}: {final[both]!m}" + (", {runs[both][0][-1][0]:.0f} s" if timed else ""), entry)


def plot(record: Record) -> figures.Figure:
    """Error over seconds where a race is of smoke, else over paths."""
    panels = {}
    for budget, entry in record["budgets"].items():
        by_paths = budget not in ("steps", "time")
        title = f"{budget}, over {'paths' if by_paths else 'seconds'}"
        panels[title] = figures.race_curves(entry["methods"], "both", int(by_paths))
    return figures.curves(panels, "", log="")
