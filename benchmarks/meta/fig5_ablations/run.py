"""Ablations of meta-estimation (Meta Fig. 5): `ajar`, one part left out at a time, each tuned; and `indirect-room`, at length.

Left out: the zero-centred moments (variances about the mean instead), the bound of alpha, the shared samples (statistics from independent
ones, at twice the cost), the decoupling of the difference's variance from the step. Both forms. The race on `ajar` is one of equal seconds.
At length, on a small `indirect-room` with the paper's loss, every form takes as many steps at one rate that is not tuned; a descent has
diverged where it ends further from the truth than half of its start.

Centring: of plain gradients at the start of `ajar`, the squared mean over the mean square, summed over elements, free of
the noise of the mean. It is the share by which centred variances differ from moments about zero. Where it is large, at
16 samples, the coupled form and its centred variances race over equal steps.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np

import unrender as ur
from benchmarks import markdown, pixel_schemes
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
MERGE = ("methods", "at length.methods", "centring")
QUICK = {
    "seconds": 0.1, "seeds": 2, "resolution": 8, "steps": 4, "long_seeds": 1, "long_resolution": 8, "gradients": 8,
    "short_steps": 4,
}  # fmt: skip


def entrants(forms: dict[str, dict[str, Any]] = FORMS) -> list[Entrant]:
    """The forms, whole and with each part left out."""
    return [
        Entrant(f"{form}, {name}", name, ur.MetaEstimator(**kind, **options), ur.optimizers.MetaAdam, RATES)
        for form, kind in forms.items()
        for name, options in ABLATIONS.items()
    ]


def centring(problem: ur.Problem, spp: int, count: int) -> list[float]:
    """Return the squared mean over the mean square of an element, summed over elements, and its standard error."""
    rows = pixel_schemes.gradients(problem, ur.PathGradient(spp=spp), count)[0].astype(np.float64)
    shares = []
    for part in np.array_split(rows, 4):
        squared = part.mean(axis=0) ** 2 - part.var(axis=0, ddof=1) / len(part)
        shares.append(squared.sum() / (part**2).mean(axis=0).sum())
    return [float(np.mean(shares)), float(np.std(shares, ddof=1) / 2)]


def run(
    seconds: float = 5.0,
    seeds: int = 2,
    resolution: int = 48,
    part: tuple[str, ...] = ("tuned", "at length", "centring"),
    steps: int = 1500,
    long_seeds: int = 5,
    long_resolution: int = 16,
    gradients: int = 96,
    short_steps: int = 150,
) -> Iterator[dict[str, Any]]:
    """The race of all forms, and their descents at one rate.

    Args:
        seconds: budget of every run of the race
        steps: of every descent at length
        long_seeds: of the descents at length
        long_resolution: of the descents at length
        gradients: that the moments are of
        short_steps: of descents at 16 samples
    """
    if "tuned" in part:
        problem = ur.gallery.problem("ajar", resolution=resolution)
        yield {"methods": race(problem, entrants(), seeds, seconds=seconds)}
    if "centring" in part:
        made = ur.gallery.problem("ajar", resolution=resolution)
        found: dict[str, Any] = {f"{spp} spp": centring(made, spp, gradients) for spp in (2, 16)}
        given = entrants({"coupled at 16 spp": {"coupled": True, "spp": 16}})[:2]
        yield {"centring": found, "methods": race(made, given, seeds, steps=short_steps)}
    if "at length" in part:
        size = {"resolution": long_resolution, "texture_resolution": 8}
        problem = ur.gallery.problem("indirect-room", loss="RelativeL2", **size)
        conditions = {**size, "steps": steps, "seeds": long_seeds, "rate": LONG_RATE}
        for entrant in entrants():
            found = race(problem, [replace(entrant, rates=(LONG_RATE,))], long_seeds, steps=steps)
            yield {"at length": {**conditions, "methods": found}}


def table(record: Record) -> str:
    text = "`ajar`, {resolution}², {seconds:g} s, at 16 spp over equal steps, {seeds} seeds, each tuned."
    blocks = [
        text.format(**record["settings"]),
        markdown.records(
            "form, and what is left out | rate | final error: median (range)",
            "{name} | {rate:g} | {final!m}",
            markdown.named(record["methods"], "name"),
        ),
    ]
    rows = [[name, f"{share:.4f} ± {error:.4f}"] for name, (share, error) in record["centring"].items()]
    blocks.append(markdown.table("gradients of `ajar` | squared mean over mean square", rows))
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
