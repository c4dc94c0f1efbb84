"""Meta-estimation against Adam (Meta Figs 1, 6 and 9): `spiral`, `ajar`, and the hard case `chalice`.

Adam gets plain gradients (leave-one-out sample groups) at several samples per pixel (the table `SPP`), and a control variate's at 2;
meta-estimation is the paper's form (1 difference, 2 proportional samples) with MetaAdam and, as the paper warns, with Adam; and the coupled
form at 3 and 8 samples, on plain images and on a control variate's. The learning rate of each is tuned for the whole budget on seeds of its
own. On `spiral`, as in the paper's figure, every run has as many steps, and the question is when the others reach what Adam ends with; on
`ajar` and `chalice` every run has as much time. Error is each parameter's RMSE relative to where it began, averaged over parameters.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import unrender as ur
from benchmarks import figures, markdown
from benchmarks.races import Entrant, race, reached
from benchmarks.runner.records import Record

OPTIONS: dict[str, dict[str, Any]] = {
    "spiral": {"resolution": 32},
    "ajar": {"resolution": 48},
    "chalice": {"resolution": 48, "texture_resolution": 32},
}
BUDGETS: dict[str, dict[str, Any]] = {"spiral": {"steps": 400}, "ajar": {"seconds": 8.0}, "chalice": {"seconds": 4.0}}
TUNING_SEEDS = {"spiral": 3, "ajar": 1, "chalice": 1}  # five numbers of one ribbon end in different places by seed
SPP = {"spiral": (4, 16, 32), "ajar": (1, 4, 16, 64), "chalice": (4, 16, 64)}
ADAM_RATES = (0.003, 0.01, 0.03)
META_RATES = (0.0003, 0.001, 0.003)
CV = ur.images.RecursiveControlVariate
MERGE = ("entries.*.methods",)
QUICK = {"problem": ("chalice",), "steps": 3, "seeds": 2, "resolution": 8, "only": ("adam 4 spp", "meta")}


def entrants(problem: str) -> list[Entrant]:
    """Who races."""
    adam, meta = ur.optimizers.Adam, ur.optimizers.MetaAdam
    return [
        *(Entrant(f"adam {n} spp", "adam", ur.PathGradient(spp=n), adam, ADAM_RATES) for n in SPP[problem]),
        Entrant("rcv 2 spp", "rcv", ur.PathGradient(CV(), spp=2), adam, ADAM_RATES),
        Entrant("meta", "meta", ur.MetaEstimator(), meta, META_RATES),
        Entrant("meta, naive", "meta, naive", ur.MetaEstimator(), adam, ADAM_RATES),
        Entrant("coupled 3 spp", "coupled", ur.MetaEstimator(coupled=True, spp=3), meta, META_RATES),
        Entrant("coupled 8 spp", "coupled", ur.MetaEstimator(coupled=True, spp=8), meta, META_RATES),
        Entrant(
            "coupled 3 spp, rcv", "coupled, rcv", ur.MetaEstimator(coupled=True, spp=3, image=CV()), meta, META_RATES
        ),
    ]


def ratios(found: dict[str, Any]) -> dict[str, Any]:
    """When meta-estimation reaches what Adam ends with, in time and samples."""
    rows: dict[str, Any] = {}
    for ours in (name for name in found if found[name]["group"] not in ("adam", "rcv")):
        for theirs in (name for name in found if found[name]["group"] in ("adam", "rcv")):
            target = found[theirs]["final"][0]
            row: dict[str, Any] = {}
            for column, unit in ((0, "seconds"), (1, "samples")):
                mine, its = reached(found[ours]["runs"], target, column), reached(found[theirs]["runs"], target, column)
                row[f"{unit}_ratio"] = its / mine if mine and its else None
            rows[f"{ours} / {theirs}"] = row
    return rows


def summarize(record: dict[str, Any]) -> dict[str, Any]:
    return {"entries": {n: {**entry, "summary": ratios(entry["methods"])} for n, entry in record["entries"].items()}}


def run(
    problem: tuple[str, ...] = tuple(OPTIONS),
    seconds: float | None = None,
    steps: int | None = None,
    seeds: int = 5,
    resolution: int | None = None,
    texture_resolution: int | None = None,
    only: tuple[str, ...] = (),
) -> Iterator[dict[str, Any]]:
    """A part per problem.

    Args:
        steps: budget of every run, in place of seconds
        resolution: film size, for GPUs
        texture_resolution: side of the unknown textures, for GPUs
    """
    for name in problem:
        sizes = {"resolution": resolution, "texture_resolution": texture_resolution}
        options = {**OPTIONS[name], **{key: value for key, value in sizes.items() if value}}
        chosen = [e for e in entrants(name) if not only or e.name in only]
        given = {"seconds": seconds, "steps": steps}
        budget = {k: v for k, v in given.items() if v is not None} or BUDGETS[name]
        methods = race(ur.gallery.problem(name, **options), chosen, seeds, TUNING_SEEDS[name], **budget)
        yield {"entries": {name: {"options": options, "budget": budget, "seeds": seeds, "methods": methods}}}


def table(record: Record) -> str:
    blocks = []
    for name, entry in record["entries"].items():
        methods, reach = entry["methods"], []
        rows = []
        for method, found in methods.items():
            seconds, paths, _ = found["runs"][0][-1]
            row = markdown.fill("{rate:g} | {final!m}", found)
            rows.append([method, row, f"{seconds:.1f}", f"{paths / 1e6:.2f}"])
        adam = [method for method, found in methods.items() if found["group"] == "adam"]
        for pair, found in entry["summary"].items():
            ours, theirs = pair.split(" / ")
            if theirs in adam[-2:] and ours in ("meta", "coupled 3 spp", "coupled 3 spp, rcv"):
                ratios = (found[unit] for unit in ("samples_ratio", "seconds_ratio"))
                reach.append([ours, theirs, *(f"{ratio:.1f}×" if ratio else "never" for ratio in ratios)])
        budget = ", ".join(f"{value:g} {unit}" for unit, value in entry["budget"].items())
        blocks += [
            f"**`{name}`**, {entry['options']['resolution']}², {budget}, {entry['seeds']} seeds.",
            markdown.table("method | rate | final error: median (range) | seconds | million paths", rows),
            "How many times fewer paths, and less time, until the final error of the other is reached (median run):",
            markdown.table("method | reaches the end of | fewer paths | less time", reach),
        ]
    return markdown.blocks(*blocks)


def plot(record: Record) -> figures.Figure:
    """Error over seconds and over paths."""
    return figures.curves(figures.error_panels(record["entries"]), "", columns=2)
