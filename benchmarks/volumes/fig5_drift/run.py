"""Bias of a descent that begins at the truth (RCV Figs 5 and 6): where image noise moves the parameters.

`three-bodies`, started at its truth, where every step is one away: L1 and L2, plain gradients at several samples per pixel and recursive
control variates, one learning rate for all. For L1, whose derivative noise biases, plain gradients at 2 spp whose bias is subtracted, too,
as 512 more renders at each step tell it (Eq. 14): an ablation. Reported is how far each parameter is from the truth, relative to it, in the
mean over the last third of the steps: signed, mean and standard error over seeds.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

import unrender as ur
from benchmarks import figures, markdown
from benchmarks.derivative_bias import DebiasedGradient
from benchmarks.internals import Estimator
from benchmarks.paths import descent
from benchmarks.runner.records import Record
from benchmarks.suite.scenes import LOSSES

RATE = 0.005
INDEPENDENT = 512
"""Renders for the expectations of Eq. 14."""
METHODS: dict[str, dict[str, Estimator]] = {
    loss: {
        **{f"plain, {spp} spp": ur.PathGradient(spp=spp) for spp in (2, 4, 16)},
        **({"debiased, 2 spp": DebiasedGradient(2, INDEPENDENT)} if loss == "L1" else {}),
        **{f"rcv, {spp} spp": ur.PathGradient(ur.images.RecursiveControlVariate(), spp=spp) for spp in (2, 4)},
    }
    for loss in ("L1", "L2")
}
MERGE = ("descents.*.methods",)
QUICK = {"steps": 6, "seeds": 2, "resolution": 8}


def drift(problem: ur.Problem, estimator: Estimator, steps: int, seed: int) -> np.ndarray:
    """How far the parameters are from the truth after each step, relative to it, (steps, parameters)."""
    path = descent(problem, estimator, RATE, steps + 1, seed)[1:]
    return np.array([[float(np.mean(np.array(at[key]) / x - 1)) for key, x in problem.truth.items()] for at in path])


def summarize(record: dict[str, Any]) -> dict[str, Any]:
    entry = record["descents"]["three-bodies"]
    names = [f"{loss}, {name}" for loss, methods in METHODS.items() for name in methods]
    methods = {name: entry["methods"][name] for name in names if name in entry["methods"]}
    return {"descents": {"three-bodies": {**entry, "methods": methods}}}


def run(steps: int = 600, seeds: int = 3, resolution: int = 32, only: tuple[str, ...] = ()) -> Iterator[dict[str, Any]]:
    """A part per loss and method.

    Args:
        only: methods to run, such as "L1, plain, 2 spp"; the others' figures stay where they are of the same sizes
    """
    made = ur.gallery.problem("three-bodies", resolution=resolution, reference_spp=4096)
    there = [ur.Parameter(p.key, initial=made.truth[p.key], bounds=p.bounds) for p in made.parameters]
    found: dict[str, Any] = {}
    for loss, methods in METHODS.items():
        problem = made.replaced(parameters=there, loss=LOSSES[loss])
        for label, estimator in ((f"{loss}, {name}", each) for name, each in methods.items()):
            if only and label not in only:
                continue
            rows = np.stack([drift(problem, estimator, steps, seed) for seed in range(seeds)])
            last = rows[:, -steps // 3 :].mean(axis=1)
            mean, error = last.mean(axis=0), last.std(axis=0, ddof=1) / np.sqrt(seeds)
            distance = {key: [float(m), float(e)] for key, m, e in zip(problem.truth, mean, error, strict=True)}
            found[label] = {"distance": distance, "curve": rows.mean(axis=0)[:: max(1, steps // 200)].tolist()}
            print(label, distance, flush=True)
            sizes = {"rate": RATE, "steps": steps, "seeds": seeds, "resolution": resolution}
            yield {"descents": {"three-bodies": {**sizes, "methods": dict(found)}}}


def table(record: Record) -> str:
    entry = record["descents"]["three-bodies"]
    keys = list(next(iter(entry["methods"].values()))["distance"])
    rows = [
        [name, *(f"{100 * mean:+.1f} ± {100 * error:.1f} %" for mean, error in found["distance"].values())]
        for name, found in entry["methods"].items()
    ]
    text = "`three-bodies`, {resolution}², {steps} steps, learning rate {rate:g}, {seeds} seeds.".format(**entry)
    return markdown.blocks(text, markdown.table(" | ".join(["loss, method", *keys]), rows))


def plot(record: Record) -> figures.Figure:
    """Distance over steps, a panel per loss and parameter."""
    entry = record["descents"]["three-bodies"]
    panels: dict[str, dict[str, figures.Curves]] = {}
    for name, found in entry["methods"].items():
        loss, _, method = name.partition(", ")
        for key, curve in zip(found["distance"], np.array(found["curve"]).T, strict=True):
            along = np.linspace(0, entry["steps"], len(curve))
            panels.setdefault(f"{loss}: {key}", {})[method] = [(along, curve)]
    return figures.curves(panels, "step", "relative distance from the truth", columns=3, log="", level=0.0)
