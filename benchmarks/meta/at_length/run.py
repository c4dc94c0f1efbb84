"""Meta-estimation at length (Meta Figs 1, 6 and 9): thousands of steps with falling rates, on `spiral`, `chalice` and `ajar`.

Every run has the processor time of as many steps of the paper's form (1 difference, 2 proportional samples) as `steps` says; how many steps
of its own that is, a trial of a few steps tells. Learning rates fall along half a cosine over the steps of a run, for Adam and MetaAdam
alike. They are chosen in two rounds: the best of two, and of more where it is at an end, on runs of a fifth of the time from a seed of
their own; then, since longer runs want lower rates, whole runs with that and with the next lower ones, for as long as their ends get
nearer, of which the best is kept. Other resolutions than 64² have entries of their own. β_F is 0.999, the loss the paper's mean relative
squared error. Raced are Adam on plain gradients at 16 and 64 samples per pixel, the paper's form at (1, 2), (12, 4) and (4, 16) difference
and proportional samples, and the coupled form at 3 samples on plain images and on a control variate's.
Error is each parameter's RMSE relative to where it began, averaged over parameters; seconds are the processor's, on one thread.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import drjit as dr

import unrender as ur
from benchmarks import figures, markdown
from benchmarks.internals import Estimator, Optimizer
from benchmarks.races import TUNING_SEED, Entrant, Points, follow, median_and_range, search
from benchmarks.runner.records import Record
from benchmarks.runner.timing import work_time
from unrender.schedules import Cosine

OPTIONS: dict[str, dict[str, Any]] = {
    "spiral": {},
    "chalice": {"texture_resolution": 32, "reference_spp": 16384},
    "ajar": {"reference_spp": 32768},
}
"""Noise of references is a part of the loss's minimum, which long descents reach: where it tells, they have 16 times the samples."""
BETA = 0.999
FLOOR = 0.02
TRIAL = 8
"""Steps that tell the cost of one."""
USUAL_RESOLUTION = 64
LOWER = 4
"""Lower rates that whole runs try at most."""
PAPER = "meta, 1 + 2"
MERGE = ("entries.*.methods",)
QUICK = {"problem": ("chalice",), "steps": 20, "seeds": 1, "resolution": 8, "only": ("Adam, 16 spp", "meta, 1 + 2")}
_SPIRAL = {
    "meta, 1 + 2": (0.0003, 0.001), "Adam, 16 spp": (0.01, 0.03), "Adam, 64 spp": (0.03, 0.06),
    "coupled on rcv": (0.001, 0.003), "meta, 4 + 16": (0.001, 0.003),
    "coupled": (0.0005, 0.0015), "meta, 12 + 4": (0.0005, 0.0015),
}  # fmt: skip
_AJAR = {
    "meta, 1 + 2": (0.0001, 0.0005), "Adam, 64 spp": (0.02, 0.06), "coupled on rcv": (0.0005, 0.0015),
    "meta, 4 + 16": (0.0003, 0.001), "coupled": (0.0003, 0.001),
    "meta, 12 + 4": (0.0003, 0.001),
}  # fmt: skip
RATES = {"spiral": _SPIRAL, "chalice": {**_SPIRAL, "Adam, 64 spp": (0.02, 0.06)}, "ajar": {**_SPIRAL, **_AJAR}}
"""Of each method, in the order of the race."""


def entrants(problem: str) -> dict[str, Entrant]:
    """Who races."""
    adam, meta, control = ur.optimizers.Adam, ur.optimizers.MetaAdam, ur.images.RecursiveControlVariate()
    made: dict[str, tuple[str, Estimator, Callable[..., Optimizer]]] = {
        "meta, 1 + 2": ("meta", ur.MetaEstimator(2, 1, beta_proportional=BETA), meta),
        "meta, 12 + 4": ("meta", ur.MetaEstimator(4, 12, beta_proportional=BETA), meta),
        "meta, 4 + 16": ("meta", ur.MetaEstimator(16, 4, beta_proportional=BETA), meta),
        "Adam, 16 spp": ("Adam", ur.PathGradient(spp=16), adam),
        "Adam, 64 spp": ("Adam", ur.PathGradient(spp=64), adam),
        "coupled": ("coupled", ur.MetaEstimator(coupled=True, spp=3, beta_proportional=BETA), meta),
        "coupled on rcv": (
            "coupled", ur.MetaEstimator(coupled=True, spp=3, image=control, beta_proportional=BETA), meta
        ),
    }  # fmt: skip
    return {name: Entrant(name, *made[name], rates) for name, rates in RATES[problem].items()}


def descend(problem: ur.Problem, entrant: Entrant, rate: float, seed: int, steps: int) -> Points:
    """One run with a falling rate."""
    falling = replace(entrant, optimizer=functools.partial(entrant.optimizer, schedule=Cosine(steps, FLOOR)))
    return follow(problem, falling, rate, seed, clock=work_time, steps=steps).points[""]


def cost(problem: ur.Problem, entrant: Entrant) -> float:
    """Processor seconds of a step; the first steps compile."""
    points = follow(
        problem, entrant, entrant.rates[0], TUNING_SEED, points=2 * TRIAL, clock=work_time, steps=TRIAL
    ).points[""]
    return (points[-1][0] - points[TRIAL // 2][0]) / (TRIAL - TRIAL // 2)


def measure(
    problem: ur.Problem, entrant: Entrant, name: str, steps: int, seeds: int, tuning_share: float
) -> dict[str, Any]:
    """One method, tuned, over seeds 0, 1, ..."""
    short = max(2, round(steps * tuning_share))

    def error(rate: float) -> float:
        found = descend(problem, entrant, rate, TUNING_SEED, short)[-1][2]
        print(f"{problem.name} {name} rate {rate:g}, {short} steps: {found:.4f}", flush=True)
        return found

    rate, tried = search(entrant.rates, error)
    whole: dict[float, list[Points]] = {}
    ends: dict[float, list[float]] = {}
    for lower in downward(rate, [entry["rate"] for entry in tried]):
        whole[lower] = [descend(problem, entrant, lower, seed, steps) for seed in range(seeds)]
        ends[lower] = median_and_range([run[-1][2] for run in whole[lower]])
        seconds = whole[lower][0][-1][0]
        print(f"{problem.name} {name} rate {lower:g}, {steps} steps, {seconds:.0f} s: {ends[lower][0]:.4f}", flush=True)
        if ends[lower][0] > min(end[0] for end in ends.values()):
            break
    rate = min(ends, key=lambda each: ends[each][0])
    return {
        "group": entrant.group, "rate": rate, "tried": tried, "steps": steps, "tuning_steps": short,
        "whole": [{"rate": each, "error": end[0]} for each, end in ends.items()],
        "runs": whole[rate], "final": ends[rate],
    }  # fmt: skip


def downward(rate: float, tried: list[float]) -> list[float]:
    """That rate and `LOWER` lower ones: of those tried, then at their distance."""
    below = sorted((each for each in tried if each < rate), reverse=True)
    factor = sorted(tried)[1] / sorted(tried)[0]
    while len(below) < LOWER:
        below.append((below[-1] if below else rate) / factor)
    return [rate, *below[:LOWER]]


def ratios(found: dict[str, Any]) -> dict[str, float]:
    """Final errors of each form of meta-estimation over Adam's."""
    of_adam = [name for name in found if found[name]["group"] == "Adam"]
    ours = [name for name in found if name not in of_adam]
    return {f"{own} / {other}": found[own]["final"][0] / found[other]["final"][0] for other in of_adam for own in ours}


def summarize(record: dict[str, Any]) -> dict[str, Any]:
    return {"entries": {n: {**entry, "summary": ratios(entry["methods"])} for n, entry in record["entries"].items()}}


def run(
    problem: tuple[str, ...] = tuple(OPTIONS),
    steps: int = 3000,
    seeds: int = 1,
    resolution: int = USUAL_RESOLUTION,
    only: tuple[str, ...] = (),
    tuning_share: float = 0.2,
) -> Iterator[dict[str, Any]]:
    """A part per problem and method.

    Args:
        steps: of the paper's form at 1 + 2 samples; the others have as much processor time
        tuning_share: of a run's steps, those of each run that a rate is chosen by
    """
    dr.set_thread_count(1)
    for name in problem:
        options = {"resolution": resolution, **OPTIONS[name]}
        made, racing = ur.gallery.problem(name, **options), entrants(name)
        seconds = steps * cost(made, racing[PAPER])
        for method in (m for m in racing if not only or m in only):
            own = steps if method == PAPER else max(2, round(seconds / cost(made, racing[method])))
            found = measure(made, racing[method], method, own, seeds, tuning_share)
            entry = {"options": options, "steps": steps, "seeds": seeds, "methods": {method: found}}
            label = name if resolution == USUAL_RESOLUTION else f"{name}, {resolution}²"
            yield {"entries": {label: entry}}


def table(record: Record) -> str:
    """Final errors, and those of each form over Adam's."""
    blocks = []
    head = "method | rate | steps | final error (median) | at other rates | processor seconds | million paths"
    for name, entry in record["entries"].items():
        rows = []
        for found in markdown.named(entry["methods"], "method"):
            seconds, paths, _ = found["runs"][0][-1]
            whole = (w for w in found.get("whole", []) if w["rate"] != found["rate"])
            others = ", ".join(f"{w['rate']:.3g}: {w['error']:.3f}" for w in whole)
            row = markdown.fill("{method} | {rate:.3g} | {steps} | {final[0]:.3f}", found)
            rows.append([row, others, f"{seconds:.0f}", f"{paths / 1e6:.1f}"])
        text = "**`{}`**, {}², the processor time of {} steps of `meta, 1 + 2`, {} seed{}."
        seeds, size = entry["seeds"], entry["options"]["resolution"]
        over = [[*pair.split(" / "), f"{ratio:.2f}"] for pair, ratio in entry["summary"].items()]
        blocks += [
            text.format(name.partition(", ")[0], size, entry["steps"], seeds, "s" if seeds > 1 else ""),
            markdown.table(head, rows),
            "Final error over that of the other:",
            markdown.table("method | other | error ratio", over),
        ]
    return markdown.blocks(*blocks)


def plot(record: Record) -> figures.Figure:
    """Error over seconds and over paths."""
    return figures.curves(figures.error_panels(record["entries"], "processor seconds"), "", columns=2)
