"""Drawn pixels at equal time (Figs 4, 5 and 8 of the paper): `sun-glossy` with two losses, `plain-and-textured`, `two-planets`.

    python benchmarks/adaptive/equal_time/run.py [--problem two-planets] [--seconds 10] [--seeds 5] [--resolution 64]

Uniform mini-batches, those in proportion to the loss derivative, and adaptive ones, two paths per pixel and as many pixels for all, Adam,
the learning rate of each tuned on a seed of its own for the whole budget. On `plain-and-textured` also without levels; on `two-planets`
also with a control variate and with coupled meta-estimation, drawn and whole. Error is each parameter's RMSE relative to where
it began, averaged over parameters; ratios are to uniform mini-batches, at ten checkpoints, medians over seeds.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
from common import read, write
from races import Entrant, draw, race
from schemes import COLOURS, pixels

import unrender as ur

HERE = Path(__file__).resolve().parent
TASKS: dict[str, tuple[str, dict[str, Any]]] = {
    "sun-glossy L2": ("sun-glossy", {"loss": "L2"}),
    "sun-glossy relative L2": ("sun-glossy", {"loss": "RelativeL2"}),
    "plain-and-textured": ("plain-and-textured", {}),
    "two-planets": ("two-planets", {}),
}
COUNTS = {"sun-glossy": 2048, "plain-and-textured": 1024, "two-planets": 2048}
RATES = (0.01, 0.03)
META_RATES = (0.001, 0.003)
CHECKPOINTS = 10
CV = ur.images.RecursiveControlVariate


def entrants(name: str, count: int) -> list[Entrant]:
    """Who races."""
    adam = ur.optimizers.Adam

    def drawn(label: str, scheme: str, **options: Any) -> Entrant:
        return Entrant(label, label, ur.PathGradient(pixels=pixels(scheme, count, **options), spp=2), adam, RATES)

    found = [drawn("uniform", "uniform"), drawn("loss", "loss"), drawn("adaptive", "adaptive")]
    found.append(drawn("adaptive, paper's variance", "adaptive", relative=False))
    if name == "plain-and-textured":
        found.append(drawn("adaptive, one level", "adaptive", levels=0))
    if name == "two-planets":
        adaptive = pixels("adaptive", count)
        meta = ur.optimizers.MetaAdam
        found += [
            Entrant("adaptive, rcv", "adaptive, rcv", ur.PathGradient(CV(), adaptive, spp=2), adam, RATES),
            Entrant("all, rcv", "all, rcv", ur.PathGradient(CV(), spp=2), adam, RATES),
            Entrant(
                "adaptive, coupled",
                "adaptive, coupled",
                ur.MetaEstimator(coupled=True, spp=2, pixels=adaptive),
                meta,
                META_RATES,
            ),
            Entrant("all, coupled", "all, coupled", ur.MetaEstimator(coupled=True, spp=2), meta, META_RATES),
        ]
    return found


def checkpoints(entry: dict[str, Any], seconds: float) -> list[float]:
    """The median error over runs at each tenth of the time."""
    times = seconds * np.arange(1, CHECKPOINTS + 1) / CHECKPOINTS
    curves = [np.interp(times, np.array(run)[:, 0], np.array(run)[:, 2]) for run in entry["runs"]]
    return [float(x) for x in np.median(curves, axis=0)]


def plot(results: dict[str, Any]) -> None:
    """Error over time, one axis per task."""
    entries = results["entries"]
    figure, axes = plt.subplots(1, len(entries), figsize=(5 * len(entries), 4), squeeze=False, layout="constrained")
    for axis, (name, entry) in zip(axes[0], entries.items(), strict=True):
        for method, found in entry["methods"].items():
            draw(axis, found, 0, COLOURS[method], f"{method}: {found['final'][0]:.3f}")
        axis.set(title=name, xlabel="seconds", ylabel="parameter error / initial", yscale="log")
        axis.legend(fontsize=7)
    figure.savefig(HERE / "figure.png", dpi=110)
    print(f"wrote {HERE / 'figure.png'}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--problem", action="append", choices=list(TASKS))
    parser.add_argument("--seconds", type=float, default=8.0)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--resolution", type=int, help="film size, for GPUs")
    parser.add_argument("--count", type=int, help="pixels a step")
    parser.add_argument("--only", action="append", metavar="NAME", help="run these again, keep the others' figures")
    parser.add_argument("--plot-only", action="store_true")
    asked = parser.parse_args()
    if not asked.plot_only:
        ur.use()
        entries: dict[str, Any] = read(HERE)["entries"] if (HERE / "results.json").is_file() else {}
        for task in asked.problem or TASKS:
            name, options = TASKS[task]
            options = {**options, **({"resolution": asked.resolution} if asked.resolution else {})}
            problem = ur.gallery.problem(name, **options)
            count = asked.count or COUNTS[name]
            chosen = [e for e in entrants(name, count) if not asked.only or e.name in asked.only]
            kept = entries.get(task, {}).get("methods", {}) if asked.only else {}
            methods = {**kept, **race(problem, chosen, asked.seeds, seconds=asked.seconds)}
            marks = {method: checkpoints(entry, asked.seconds) for method, entry in methods.items()}
            ratios = {
                method: [a / b for a, b in zip(mark, marks["uniform"], strict=True)] for method, mark in marks.items()
            }
            for method, ratio in ratios.items():
                print(task, method, [round(r, 3) for r in ratio], flush=True)
            entries[task] = {
                "options": options,
                "count": count,
                "seconds": asked.seconds,
                "seeds": asked.seeds,
                "methods": methods,
                "checkpoints": marks,
                "over uniform": ratios,
            }
            write(HERE, {"entries": entries})
    plot(read(HERE))


if __name__ == "__main__":
    main()
