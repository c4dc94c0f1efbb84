"""Where the noise of pictures pushes a descent that begins at the truth (Figs 5 and 6 of the recursive control variates).

    python benchmarks/volumes/fig5_drift/run.py [--steps 600] [--seeds 3] [--resolution 32]

`three-bodies`, started at its truth, where every step is one away: L1 and L2, plain gradients at several samples per pixel and recursive
control variates, one learning rate for all. What is told is how far each parameter stands from the truth, relative to it, in the mean
over the last third of the steps: signed, mean and standard error over seeds.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
from common import read, write

import unrender as ur

HERE = Path(__file__).resolve().parent
RATE = 0.005
METHODS: dict[str, ur.PathGradient] = {
    **{f"plain, {spp} spp": ur.PathGradient(spp=spp) for spp in (2, 4, 16)},
    **{f"rcv, {spp} spp": ur.PathGradient(ur.images.RecursiveControlVariate(), spp=spp) for spp in (2, 4)},
}
LOSSES = {"L1": ur.losses.L1(), "L2": ur.losses.L2()}


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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=600)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--resolution", type=int, default=32)
    asked = parser.parse_args()
    ur.use()
    made = ur.gallery.problem("three-bodies", resolution=asked.resolution, reference_spp=4096)
    there = [ur.Parameter(p.key, initial=made.truth[p.key], bounds=p.bounds) for p in made.parameters]
    found: dict[str, Any] = {}
    curves: dict[str, Any] = {}
    for loss_name, loss in LOSSES.items():
        problem = ur.Problem(
            made.renderer, there, made.given_views, loss, made.max_depth, truth=made.truth, name="three-bodies"
        )
        for name, estimator in METHODS.items():
            rows = np.stack([drift(problem, estimator, asked.steps, seed) for seed in range(asked.seeds)])
            last = rows[:, -asked.steps // 3 :].mean(axis=1)
            error = last.std(axis=0, ddof=1) / np.sqrt(asked.seeds)
            label = f"{loss_name}, {name}"
            found[label] = {
                key: [float(m), float(e)] for key, m, e in zip(problem.truth, last.mean(axis=0), error, strict=True)
            }
            curves[label] = rows.mean(axis=0)[:: max(1, asked.steps // 200)].tolist()
            print(label, found[label], flush=True)
    write(HERE, {"settings": vars(asked), "rate": RATE, "drift": found, "curves": curves})
    plot(read(HERE))


def plot(results: dict[str, Any]) -> None:
    """Distance over steps, a panel per loss and parameter."""
    keys = list(next(iter(results["drift"].values())))
    figure, axes = plt.subplots(len(LOSSES), len(keys), figsize=(5 * len(keys), 6), sharex=True, layout="constrained")
    for row, loss in zip(axes, LOSSES, strict=True):
        for number, (axis, key) in enumerate(zip(row, keys, strict=True)):
            for name in METHODS:
                curve = np.array(results["curves"][f"{loss}, {name}"])[:, number]
                steps = np.linspace(0, results["settings"]["steps"], len(curve))
                axis.plot(steps, curve, label=name, ls="-" if name.startswith("rcv") else "--")
            axis.axhline(0, color="black", lw=0.5)
            axis.set(title=f"{loss}: {key}", xlabel="step", ylabel="relative distance from the truth")
    axes[0][0].legend(fontsize=7)
    figure.savefig(HERE / "figure.png", dpi=110)
    print(f"wrote {HERE / 'figure.png'}")


if __name__ == "__main__":
    main()
