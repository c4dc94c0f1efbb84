"""Ablations of meta-estimation (Meta Fig. 5): `ajar`, one part left out at a time, each tuned; and `indirect-room`, at length.

Left out: the zero-centred moments (variances about the mean instead), the bound of alpha, the shared samples (statistics from independent
ones, at twice the cost), the decoupling of the difference's variance from the step. Both forms. The race on `ajar` is one of equal seconds.
At length, on a small `indirect-room` with the paper's loss, every form takes as many steps at one rate that is not tuned; a descent has
diverged where it ends further from the truth than half of its start.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import unrender as ur
from benchmarks import figures, markdown
from benchmarks.races import Entrant, race
from benchmarks.runner.records import Record

RATES = (0.0003, 0.001)
LONG_RATE = 0.001
"""Of the descents at length."""
ABLATIONS: dict[str, dict[str, Any]] = {
    "whole": {},
    "centred variances": {"centred": True},
    "alpha not bounded": {"clip": False},
    "independent statistics": {"statistics": "independent"},
    "not decoupled": {"decouple": False},
}
FORMS = {"meta": {}, "coupled": {"coupled": True, "spp": 3}}
DIVERGED = 0.5
MERGE = ("methods", "at length.methods")
QUICK = {"seconds": 0.1, "seeds": 2, "resolution": 8, "steps": 4, "long_seeds": 1, "long_resolution": 8}


def entrants() -> list[Entrant]:
    """Both forms, whole and with each part left out."""
    return [
        Entrant(f"{form}, {name}", name, ur.MetaEstimator(**kind, **options), ur.optimizers.MetaAdam, RATES)
        for form, kind in FORMS.items()
        for name, options in ABLATIONS.items()
    ]


def run(
    seconds: float = 5.0,
    seeds: int = 2,
    resolution: int = 48,
    part: tuple[str, ...] = ("tuned", "at length"),
    steps: int = 1500,
    long_seeds: int = 5,
    long_resolution: int = 16,
) -> Iterator[dict[str, Any]]:
    """The race of all forms, and their descents at one rate.

    Args:
        seconds: budget of every run of the race
        steps: of every descent at length
        long_seeds: of the descents at length
        long_resolution: of the descents at length
    """
    if "tuned" in part:
        problem = ur.gallery.problem("ajar", resolution=resolution)
        yield {"methods": race(problem, entrants(), seeds, seconds=seconds)}
    if "at length" in part:
        size = {"resolution": long_resolution, "texture_resolution": 8}
        problem = ur.gallery.problem("indirect-room", loss="RelativeL2", **size)
        conditions = {**size, "steps": steps, "seeds": long_seeds, "rate": LONG_RATE}
        for entrant in entrants():
            found = race(problem, [replace(entrant, rates=(LONG_RATE,))], long_seeds, steps=steps)
            yield {"at length": {**conditions, "methods": found}}


def table(record: Record) -> str:
    blocks = [
        "`ajar`, {resolution}², {seconds:g} s, {seeds} seeds, each tuned.".format(**record["settings"]),
        markdown.records(
            "form, and what is left out | rate | final error: median (range)",
            "{name} | {rate:g} | {final!m}",
            markdown.named(record["methods"], "name"),
        ),
    ]
    if long := record.get("at length"):
        head = (
            "form, and what is left out | final error: median (range) | highest along a run: median (range) | diverged"
        )
        rows = []
        for found in markdown.named(long["methods"], "name"):
            highest = [max(point[2] for point in run) for run in found["runs"]]
            diverged = sum(run[-1][2] > DIVERGED for run in found["runs"])
            row = markdown.fill("{name} | {final!m} | {highest!v}", found, {"highest": highest})
            rows.append([row, f"{diverged} of {len(highest)}"])
        text = "`indirect-room`, {resolution}², {steps} steps at the rate {rate:g}, {seeds} seeds.".format(**long)
        blocks += [text, markdown.table(head, rows)]
    return markdown.blocks(*blocks)


def plot(record: Record) -> figures.Figure:
    """Error over the race's seconds, and over the paths of the descents at length; a panel per form."""
    parts = [("ajar, over seconds", record["methods"], 0)]
    if "at length" in record:
        parts.append(("indirect-room, at length, over paths", record["at length"]["methods"], 1))
    panels = {
        f"{title}, {form}": {
            f"{name.partition(', ')[2]}: {found['final'][0]:.3f}": figures.points(found["runs"], column)
            for name, found in methods.items()
            if name.startswith(f"{form}, ")
        }
        for title, methods, column in parts
        for form in FORMS
    }
    return figures.curves(panels, "", columns=2)
