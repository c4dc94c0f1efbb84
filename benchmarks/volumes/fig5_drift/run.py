"""Bias of a descent that begins at the truth (RCV Figs 5 and 6): where image noise moves the parameters.

`three-bodies`, started at its truth, where every step is one away: L1 and L2, plain gradients at several samples per
pixel and recursive control variates, one learning rate for all. Reported is how far each parameter is from the truth,
relative to it, in the mean over the last third of the steps: signed, mean and standard error over seeds.
"""

from __future__ import annotations

from typing import Any

import numpy as np

import unrender as ur

RATE = 0.005
METHODS: dict[str, ur.PathGradient] = {
    **{f"plain, {spp} spp": ur.PathGradient(spp=spp) for spp in (2, 4, 16)},
    **{f"rcv, {spp} spp": ur.PathGradient(ur.images.RecursiveControlVariate(), spp=spp) for spp in (2, 4)},
}
LOSSES = {"L1": ur.losses.L1(), "L2": ur.losses.L2()}
QUICK = {"steps": 6, "seeds": 2, "resolution": 8}


class Distance(ur.Callback):
    """Keeps how far the parameters are from the truth."""

    def __init__(self, truth: dict[str, np.ndarray]):
        self.truth = truth
        self.rows: list[list[float]] = []

    def on_step(self, run: Any, record: dict[str, Any]) -> None:
        """See `Callback.on_step`."""
        del record
        self.rows.append([float(np.mean(np.array(run.parameters[key]) / x - 1)) for key, x in self.truth.items()])


def drift(problem: ur.Problem, estimator: ur.PathGradient, steps: int, seed: int) -> np.ndarray:
    """(steps, parameters)."""
    distance = Distance(problem.truth)
    ur.optimize(problem, estimator, ur.optimizers.Adam(RATE), steps=steps, seed=seed, callbacks=[distance])
    return np.array(distance.rows)


def run(steps: int = 600, seeds: int = 3, resolution: int = 32) -> dict[str, Any]:
    """Every loss and method."""
    made = ur.gallery.problem("three-bodies", resolution=resolution, reference_spp=4096)
    there = [ur.Parameter(p.key, initial=made.truth[p.key], bounds=p.bounds) for p in made.parameters]
    found: dict[str, Any] = {}
    curves: dict[str, Any] = {}
    for loss_name, loss in LOSSES.items():
        problem = ur.Problem(
            made.renderer, there, made.given_views, loss, made.max_depth, truth=made.truth, name="three-bodies"
        )
        for name, estimator in METHODS.items():
            rows = np.stack([drift(problem, estimator, steps, seed) for seed in range(seeds)])
            last = rows[:, -steps // 3 :].mean(axis=1)
            mean, error = last.mean(axis=0), last.std(axis=0, ddof=1) / np.sqrt(seeds)
            label = f"{loss_name}, {name}"
            found[label] = {key: [float(m), float(e)] for key, m, e in zip(problem.truth, mean, error, strict=True)}
            curves[label] = rows.mean(axis=0)[:: max(1, steps // 200)].tolist()
            print(label, found[label], flush=True)
    return {"rate": RATE, "drift": found, "curves": curves}
