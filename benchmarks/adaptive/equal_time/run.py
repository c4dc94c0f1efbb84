"""Drawn pixels at equal time (Figs 4, 5 and 8 of the paper): `sun-glossy` with two losses, `plain-and-textured`, `two-planets`.

    python benchmarks/adaptive/equal_time/run.py [--problem two-planets] [--seconds 10] [--seeds 5] [--resolution 192]

Uniform mini-batches, those in proportion to the loss derivative, and adaptive ones, two paths per pixel and as many pixels for all, Adam,
the learning rate of each tuned on a seed of its own for the whole budget. Pictures and textures have fewer pixels drawn per texel than
texels, as in the paper. On `plain-and-textured` also five levels; `two-planets, memories` adds, on small pictures, a control variate and
coupled meta-estimation, drawn and whole. Error is each parameter's RMSE relative to where it began, averaged over parameters; ratios
are to uniform mini-batches, at ten checkpoints, medians over seeds, at equal samples and at equal time. Since the machine's speed may
change between runs, the time of a path is measured in turns, after the race (`--costs-only`: that alone, of the races on file).
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
from races import Entrant, Runs, draw, over, race, tenths
from schemes import COLOURS, pixels

import unrender as ur

HERE = Path(__file__).resolve().parent
FINE = {"resolution": 192, "texture_resolution": 192}
TASKS: dict[str, tuple[str, dict[str, Any], int]] = {
    "sun-glossy L2": ("sun-glossy", {"loss": "L2", **FINE}, 2048),
    "sun-glossy relative L2": ("sun-glossy", {"loss": "RelativeL2", **FINE}, 2048),
    "plain-and-textured": ("plain-and-textured", FINE, 2048),
    "two-planets": ("two-planets", {"resolution": 128, "texture_resolution": 128}, 2048),
    "two-planets, memories": ("two-planets", {}, 2048),
}
"""Problem, its options, pixels a step."""
RATES = (0.01, 0.03)
META_RATES = (0.001, 0.003)
CV = ur.images.RecursiveControlVariate


def entrants(task: str, count: int) -> list[Entrant]:
    """Who races."""
    adam = ur.optimizers.Adam

    def drawn(label: str, scheme: str, **options: Any) -> Entrant:
        return Entrant(label, label, ur.PathGradient(pixels=pixels(scheme, count, **options), spp=2), adam, RATES)

    found = [drawn("uniform", "uniform"), drawn("loss", "loss"), drawn("adaptive", "adaptive")]
    if task in ("plain-and-textured", "sun-glossy L2"):
        found.append(drawn("adaptive, as the paper", "adaptive", relative=False, levels=4))
    if task == "plain-and-textured":
        found.append(drawn("adaptive, five levels", "adaptive", levels=4))
    if task == "two-planets, memories":
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


def costs(
    problem: ur.Problem, chosen: list[Entrant], rate: float, rounds: int = 5, steps: int = 60
) -> dict[str, float]:
    """Seconds per path of short descents, in turns: medians."""
    found: dict[str, list[float]] = {entrant.name: [] for entrant in chosen}
    for turn in range(rounds):
        for entrant in chosen:
            history = ur.optimize(problem, entrant.estimator, entrant.optimizer(rate), steps=steps, seed=turn).history
            first, last = history[steps // 3], history[-1]
            found[entrant.name].append((last["seconds"] - first["seconds"]) / (last["samples"] - first["samples"]))
    return {name: float(np.median(times)) for name, times in found.items()}


def timed(methods: dict[str, Any], seconds: dict[str, float]) -> Runs:
    """The runs, with their seconds as so many paths take."""
    return {
        name: [[(samples * seconds[name], samples, error) for _, samples, error in run] for run in entry["runs"]]
        for name, entry in methods.items()
    }


def compare(methods: dict[str, Any], seconds: dict[str, float]) -> dict[str, Any]:
    """Errors at equal time, and over uniform's by time and by samples."""
    runs = timed(methods, seconds)
    return {"errors": tenths(runs, 0), "over uniform": over(runs, "uniform")}


def plot(results: dict[str, Any]) -> None:
    """Error over time, one axis per task."""
    entries = results["entries"]
    figure, axes = plt.subplots(1, len(entries), figsize=(5 * len(entries), 4), squeeze=False, layout="constrained")
    for axis, (name, entry) in zip(axes[0], entries.items(), strict=True):
        for method, runs in timed(entry["methods"], entry["seconds_per_path"]).items():
            draw(axis, {"runs": runs}, 0, COLOURS[method], f"{method}: {entry['errors'][method][-1]:.3f}")
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
    parser.add_argument("--costs-only", action="store_true")
    parser.add_argument("--plot-only", action="store_true")
    asked = parser.parse_args()
    if not asked.plot_only:
        ur.use()
        entries: dict[str, Any] = read(HERE)["entries"] if (HERE / "results.json").is_file() else {}
        for task in asked.problem or (entries if asked.costs_only else TASKS):
            name, options, count = TASKS[task]
            options = {**options, **({"resolution": asked.resolution} if asked.resolution else {})}
            problem = ur.gallery.problem(name, **options)
            count = asked.count or count
            everyone = entrants(task, count)
            chosen = [e for e in everyone if not asked.only or e.name in asked.only]
            kept = entries.get(task, {}).get("methods", {}) if asked.only or asked.costs_only else {}
            methods = {
                **kept,
                **({} if asked.costs_only else race(problem, chosen, asked.seeds, seconds=asked.seconds)),
            }
            seconds = costs(problem, [e for e in everyone if e.name in methods], RATES[0])
            compared = compare(methods, seconds)
            for by, found in compared["over uniform"].items():
                for method, ratio in found.items():
                    print(task, by, method, [round(r, 3) for r in ratio], flush=True)
            budget = {"options": options, "count": count, "seconds": asked.seconds, "seeds": asked.seeds}
            entries[task] = {
                **(entries[task] if asked.costs_only else budget),
                "methods": methods,
                "seconds_per_path": seconds,
                **compared,
            }
            write(HERE, {"entries": entries})
    plot(read(HERE))


if __name__ == "__main__":
    main()
