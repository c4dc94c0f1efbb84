"""Equal-time reconstruction: the stock loop, crossed halves and recursive control variates, each tuned, over several seeds.

    python benchmarks/rcv/fig9_reconstruction/run.py                         # every gallery problem, both losses
    python benchmarks/rcv/fig9_reconstruction/run.py --problem indirect-room --loss L1 --seconds 15

Each method is tuned on a seed of its own over the grid below for the whole budget; the best by final parameter error then runs on
the seeds. The error is each parameter's RMSE relative to where it began, averaged over parameters.
"""

from __future__ import annotations

import argparse
import itertools
import sys
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
from common import read, stock_loop, total_error, write

import unrender as ur

Grid = dict[str, list[tuple[int, float]]]

HERE = Path(__file__).resolve().parent
RATES = (3e-3, 1e-2, 3e-2)
SPP = {"plain": (2, 8, 32), "rcv": (2, 8, 32)}
NOISY = {"plain": (8, 32, 128), "rcv": (2, 8, 32)}  # of indirect-room, where fewer samples alone only make things worse
TUNING_SEED = 1000
BUDGETS = {"indirect-room": 15.0}
# Noise in the reference is part of what the loss asks for: a method that minimises it well fits it. Here it must be small.
OPTIONS: dict[str, dict[str, Any]] = {
    "indirect-room": {"reference_spp": 4096},
    "glossy-room": {"resolution": 64, "reference_spp": 4096},
    "sunlit-vase": {"resolution": 64, "reference_spp": 4096},
    "lamp": {"resolution": 64, "reference_spp": 4096},
}


def descend(
    problem: ur.Problem, method: str, spp: int, rate: float, seconds: float, seed: int
) -> list[tuple[float, float]]:
    """(seconds, error) along one run."""
    if method == "stock":
        history = stock_loop(problem, spp, rate, seconds=seconds, seed=seed)
    else:
        image = ur.images.Plain() if method == "plain" else ur.images.RecursiveControlVariate()
        optimizer = ur.optimizers.Adam(learning_rate=rate)
        history = ur.optimize(problem, ur.PathGradient(image, spp=spp), optimizer, seconds=seconds, seed=seed).history
    start = problem.parameter_error(problem.initial())
    return [(h["seconds"], total_error(h["parameter_error"], start)) for h in history if "parameter_error" in h]


def compare(
    name: str, loss: str, seconds: float, seeds: int, options: dict[str, Any], chosen: Grid | None
) -> dict[str, Any]:
    """Tune every method, then run its best on the seeds."""
    problem = ur.gallery.problem(name, loss=loss, **options)
    found: dict[str, Any] = {"problem": name, "loss": loss, "seconds": seconds, "options": options, "methods": {}}
    counts = NOISY if name == "indirect-room" else SPP
    for method in ("plain", "stock", "rcv"):
        tried: list[dict[str, Any]] = []
        if method == "stock":  # the same estimate but for the crossing: plain's choice of spp is its own
            grid = [(found["methods"]["plain"]["spp"], rate) for rate in RATES]
        else:
            grid = [(spp, rate) for spp in counts[method] for rate in RATES]
        grid = chosen.get(method, grid) if chosen else grid
        for spp, rate in grid:
            if len(grid) == 1:  # nothing to choose
                error = float("nan")
            else:
                error = descend(problem, method, spp, rate, seconds, TUNING_SEED)[-1][1]
            tried.append({"spp": spp, "rate": rate, "error": error})
            print(f"{name} {loss} {method} spp {spp} rate {rate}: {error:.3f}", flush=True)
        best = min(tried, key=lambda t: t["error"])
        best = {**best, "error": best["error"] if len(grid) > 1 else None}
        runs = [descend(problem, method, best["spp"], best["rate"], seconds, seed) for seed in range(seeds)]
        found["methods"][method] = {**best, "tried": tried if len(grid) > 1 else [], "runs": runs}
        print(f"{name} {loss} {method}: final {[round(r[-1][1], 3) for r in runs]}", flush=True)
    found["summary"] = summarise(found)
    print(found["summary"], flush=True)
    return found


def summarise(found: dict[str, Any]) -> dict[str, Any]:
    """Final errors (median, least, most), their ratio, and when the control variate reaches the others' best error."""
    rows: dict[str, Any] = {}
    for method, entry in found["methods"].items():
        final = [run[-1][1] for run in entry["runs"]]
        rows[method] = {"final": [float(np.median(final)), min(final), max(final)], "best": median_best(entry["runs"])}
    ours = found["methods"]["rcv"]["runs"]
    for method in ("stock", "plain"):
        rows[method]["ratio"] = rows["rcv"]["final"][0] / rows[method]["final"][0]
        reached = [next((t for t, e in run if e <= rows[method]["best"]), None) for run in ours]
        rows[method]["rcv_reaches_its_best_after"] = reached
        rows[method]["it_reaches_its_best_after"] = float(
            np.median([min(run, key=lambda p: p[1])[0] for run in found["methods"][method]["runs"]])
        )
    return rows


def median_best(runs: list[list[tuple[float, float]]]) -> float:
    """The median over runs of the least error along each."""
    return float(np.median([min(e for _, e in run) for run in runs]))


def plot(results: dict[str, Any]) -> None:
    """One panel per problem and loss: error over seconds, median and range over seeds."""
    entries = results["entries"]
    rows = -(-len(entries) // 2)
    figure, axes = plt.subplots(rows, 2, figsize=(10, 3.2 * rows), squeeze=False, layout="constrained")
    colours = {"stock": "#888888", "plain": "#d1782a", "rcv": "#1f6fb4"}
    for axis, entry in zip(axes.flat, entries, strict=False):
        for method, found in entry["methods"].items():
            grid = np.linspace(0, entry["seconds"], 100)
            curves = np.stack([np.interp(grid, *np.array([(0.0, 1.0), *run]).T) for run in found["runs"]])
            label = f"{method}, {found['spp']} spp, rate {found['rate']:g}"
            axis.plot(grid, np.median(curves, 0), color=colours[method], label=label)
            axis.fill_between(grid, curves.min(0), curves.max(0), color=colours[method], alpha=0.2, lw=0)
        axis.set(
            title=f"{entry['problem']}, {entry['loss']}",
            xlabel="seconds",
            ylabel="parameter error / initial",
            ylim=(0, None),
        )
        axis.legend(fontsize=7)
    for axis in axes.flat[len(entries) :]:
        axis.remove()
    figure.savefig(HERE / "figure.png", dpi=110)
    print(f"wrote {HERE / 'figure.png'}")


def parse(given: list[str] | None) -> Grid | None:
    """What `--grid` says."""
    pairs = (text.split("=") for text in given or [])
    return {m: [(int(t.split(":")[0]), float(t.split(":")[1])) for t in tries.split(",")] for m, tries in pairs} or None


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--problem", action="append", choices=list(OPTIONS))
    parser.add_argument("--loss", action="append", choices=["L1", "L2"])
    parser.add_argument("--seconds", type=float, help="budget of every run (default 15 for indirect-room, else 4)")
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--resolution", type=int, help="film size, for GPUs")
    parser.add_argument(
        "--grid",
        action="append",
        metavar="METHOD=SPP:RATE,...",
        help="try these in place of the grid; one is taken as it is",
    )
    parser.add_argument("--plot-only", action="store_true")
    asked = parser.parse_args()
    if not asked.plot_only:
        ur.use()
        entries: list[dict[str, Any]] = []
        if (HERE / "results.json").is_file():
            entries = read(HERE)["entries"]
        for name, loss in itertools.product(asked.problem or OPTIONS, asked.loss or ("L1", "L2")):
            options = {**OPTIONS[name], **({"resolution": asked.resolution} if asked.resolution else {})}
            seconds = asked.seconds or BUDGETS.get(name, 4.0)
            new = compare(name, loss, seconds, asked.seeds, options, parse(asked.grid))
            entries = [e for e in entries if (e["problem"], e["loss"]) != (name, loss)] + [new]
            write(HERE, {"entries": entries})
    plot(read(HERE))


if __name__ == "__main__":
    main()
