"""The toy problem of Balint et al. 2023, Fig. 2: the rate of an exponential distribution, 32 samples a step.

    python benchmarks/meta/fig2_exponential/run.py [--seeds 60]

Adam on plain gradients (32 crossed samples); the paper's form with MetaAdam, its samples split in half (16 proportional, 16
difference samples) and three to one, and with Adam as the paper warns; the coupled form (32 samples). Each is tuned by its RMSE
over other seeds, once for 200 steps and once for 400.
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
from unrender.rendering.numpy.exponential import RATE

HERE = Path(__file__).resolve().parent
HORIZONS = (200, 400)
TUNING_SEEDS = range(10_000, 10_016)
ADAM_RATES = tuple(float(r) for r in np.geomspace(0.002, 0.05, 9).round(5))
META_RATES = tuple(float(r) for r in np.geomspace(0.0003, 0.02, 10).round(5))
ADAM, META = ur.optimizers.Adam, ur.optimizers.MetaAdam
METHODS: dict[str, tuple[Any, Any, tuple[float, ...], str]] = {
    "adam": (ur.PathGradient(spp=32), ADAM, ADAM_RATES, "#d1782a"),
    "meta 24 + 8, naive": (ur.MetaEstimator(24, 8), ADAM, ADAM_RATES, "#7fb2dd"),
    "meta 16 + 16": (ur.MetaEstimator(16, 16), META, META_RATES, "#0b3c66"),
    "meta 24 + 8": (ur.MetaEstimator(24, 8), META, META_RATES, "#1f6fb4"),
    "coupled": (ur.MetaEstimator(coupled=True, spp=32), META, META_RATES, "#1a8f4c"),
}


class Trace(ur.Callback):
    """The rate after every step, and what the estimator said of it."""

    def __init__(self) -> None:
        self.rates: list[float] = []
        self.gradients: list[float] = []
        self.deviations: list[float] = []

    def on_step(self, run: Any, record: Any) -> None:
        del record
        self.rates.append(float(run.parameters[RATE]))
        self.gradients.append(float(run.estimate.gradient[RATE]))
        if run.estimate.variance is not None:
            self.deviations.append(float(run.estimate.variance[RATE]) ** 0.5)


def follow(problem: ur.Problem, method: str, rate: float, seeds: range) -> list[Trace]:
    """One run per seed."""
    estimator, optimizer, _, _ = METHODS[method]
    traces = []
    for seed in seeds:
        traces.append(Trace())
        ur.optimize(problem, estimator, optimizer(rate), steps=max(HORIZONS), seed=seed, callbacks=[traces[-1]])
    return traces


def errors(problem: ur.Problem, traces: list[Trace]) -> np.ndarray:
    """RMSE over runs at each step."""
    rates = np.array([trace.rates for trace in traces])
    return np.sqrt(np.mean((rates - problem.truth[RATE]) ** 2, axis=0))


def measure(problem: ur.Problem, seeds: int) -> dict[str, Any]:
    """Tuned errors of every method at both horizons."""
    found: dict[str, Any] = {}
    for method, (_, _, rates, _) in METHODS.items():
        tried = {rate: errors(problem, follow(problem, method, rate, TUNING_SEEDS)) for rate in rates}
        entry: dict[str, Any] = {"tried": {rate: [float(e[h - 1]) for h in HORIZONS] for rate, e in tried.items()}}
        for horizon in HORIZONS:
            last = horizon - 1
            best = min(tried, key=lambda rate, last=last: float(tried[rate][last]))
            traces = follow(problem, method, best, range(seeds))
            error = errors(problem, traces)
            entry[str(horizon)] = {
                "rate": best,
                "rmse": float(error[horizon - 1]),
                "curve": error.tolist(),
                "runs": [trace.rates for trace in traces[:20]],
                "gradients": traces[0].gradients,
                "deviations": traces[0].deviations,
            }
            print(f"{method}, {horizon} steps: rate {best:g}, rmse {error[horizon - 1]:.5f}", flush=True)
        found[method] = entry
    for method in found:
        for horizon in map(str, HORIZONS):
            found[method][horizon]["of_adam"] = found[method][horizon]["rmse"] / found["adam"][horizon]["rmse"]
    return found


def plot(results: dict[str, Any]) -> None:
    """Left: the rate over the steps, with the spread of 20 runs; middle: RMSE; right: one run's gradient and its predicted deviation."""
    figure, axes = plt.subplots(1, 3, figsize=(15, 4.2), layout="constrained")
    horizon = str(HORIZONS[0])
    for method, (_, _, _, colour) in METHODS.items():
        entry = results["methods"][method][horizon]
        runs = np.array(entry["runs"])
        axes[0].plot(runs.mean(0), color=colour, label=f"{method}, rate {entry['rate']:g}")
        axes[0].fill_between(np.arange(runs.shape[1]), runs.min(0), runs.max(0), color=colour, alpha=0.15, lw=0)
        axes[1].plot(entry["curve"], color=colour, label=f"{method}, rate {entry['rate']:g}")
    axes[0].axhline(0.5, color="k", ls=":", lw=1)
    axes[0].set(xlabel="step", ylabel="rate", ylim=(0.4, 0.75), title="mean and range of 20 runs")
    axes[1].set(xlabel="step", ylabel="RMSE of the rate", yscale="log", title=f"tuned for {horizon} steps")
    axes[0].legend(fontsize=8)
    for method in ("meta 24 + 8", "coupled"):
        entry, colour = results["methods"][method][horizon], METHODS[method][3]
        g, s = np.array(entry["gradients"])[:200], np.array(entry["deviations"])[:200]
        axes[2].plot(g, color=colour, label=method)
        axes[2].fill_between(np.arange(len(g)), g - s, g + s, color=colour, alpha=0.2, lw=0)
    axes[2].plot(
        results["methods"]["adam"][horizon]["gradients"][:200], ".", ms=2, color="#d1782a", label="plain samples"
    )
    axes[2].set(xlabel="step", ylabel="gradient", ylim=(-6, 4), title="one run: estimate and predicted deviation")
    axes[2].legend(fontsize=8)
    figure.savefig(HERE / "figure.png", dpi=110)
    print(f"wrote {HERE / 'figure.png'}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=60)
    parser.add_argument("--plot-only", action="store_true")
    asked = parser.parse_args()
    if not asked.plot_only:
        problem = ur.gallery.problem("exponential")
        write(HERE, {"seeds": asked.seeds, "methods": measure(problem, asked.seeds)})
    plot(read(HERE))


if __name__ == "__main__":
    main()
