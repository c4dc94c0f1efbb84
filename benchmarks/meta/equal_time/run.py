"""Meta-estimation against Adam at equal time (Balint et al. 2023, Figs 1, 6 and 9): `spiral`, `ajar`, and the hard case `chalice`.

    python benchmarks/meta/equal_time/run.py [--problem spiral] [--seconds 10 | --steps 400] [--seeds 5] [--resolution 48]

Adam gets plain gradients (crossed groups) at several samples per pixel (the table `SPP`), and a control variate's at 2;
meta-estimation is the paper's form (1 difference, 2 proportional samples) with MetaAdam and, as the paper warns, with Adam; and
the coupled form at 3 and 8 samples, on plain images and on a control variate's. The learning rate of each is tuned for the
whole budget on seeds of its own. On `spiral`, as in the paper's figure, every run has as many steps, and the question is when
the others reach what Adam ends with; on `ajar` and `chalice` every run has as much time. Error is each parameter's RMSE
relative to where it began, averaged over parameters.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
from common import read, write
from races import Entrant, colours, draw, race, reached

import unrender as ur

HERE = Path(__file__).resolve().parent
OPTIONS: dict[str, dict[str, Any]] = {
    "spiral": {"resolution": 32},
    "ajar": {"resolution": 48},
    "chalice": {"resolution": 48, "texture_resolution": 32},
}
BUDGETS: dict[str, dict[str, Any]] = {"spiral": {"steps": 400}, "ajar": {"seconds": 8.0}, "chalice": {"seconds": 4.0}}
TUNING_SEEDS = {"spiral": 3, "ajar": 1, "chalice": 1}  # five numbers of one ribbon end in different places by seed
SPP = {"spiral": (4, 16, 32), "ajar": (1, 4, 16, 64), "chalice": (4, 16, 64)}
ADAM_RATES = (0.003, 0.01, 0.03)
META_RATES = (0.0003, 0.001, 0.003)
CV = ur.images.RecursiveControlVariate


def entrants(problem: str) -> list[Entrant]:
    """Who races."""
    adam, meta = ur.optimizers.Adam, ur.optimizers.MetaAdam
    return [
        *(Entrant(f"adam {n} spp", "adam", ur.PathGradient(spp=n), adam, ADAM_RATES) for n in SPP[problem]),
        Entrant("rcv 2 spp", "rcv", ur.PathGradient(CV(), spp=2), adam, ADAM_RATES),
        Entrant("meta", "meta", ur.MetaEstimator(), meta, META_RATES),
        Entrant("meta, naive", "meta, naive", ur.MetaEstimator(), adam, ADAM_RATES),
        Entrant("coupled 3 spp", "coupled", ur.MetaEstimator(coupled=True, spp=3), meta, META_RATES),
        Entrant("coupled 8 spp", "coupled", ur.MetaEstimator(coupled=True, spp=8), meta, META_RATES),
        Entrant(
            "coupled 3 spp, rcv", "coupled, rcv", ur.MetaEstimator(coupled=True, spp=3, image=CV()), meta, META_RATES
        ),
    ]


def summarise(found: dict[str, Any]) -> dict[str, Any]:
    """When meta-estimation reaches what Adam ends with, in time and samples, and the ratio of final errors."""
    rows: dict[str, Any] = {}
    for ours in (name for name in found if found[name]["group"] not in ("adam", "rcv")):
        for theirs in (name for name in found if found[name]["group"] in ("adam", "rcv")):
            target = found[theirs]["final"][0]
            row: dict[str, Any] = {"error_ratio": found[ours]["final"][0] / target}
            for column, unit in ((0, "seconds"), (1, "samples")):
                mine, its = reached(found[ours]["runs"], target, column), reached(found[theirs]["runs"], target, column)
                row[unit] = [mine, its]
                row[f"{unit}_ratio"] = its / mine if mine and its else None
            rows[f"{ours} / {theirs}"] = row
    return rows


def plot(results: dict[str, Any]) -> None:
    """Per problem: error over seconds and over samples."""
    entries = results["entries"]
    figure, axes = plt.subplots(len(entries), 2, figsize=(12, 4.2 * len(entries)), squeeze=False, layout="constrained")
    for row, (name, entry) in zip(axes, entries.items(), strict=True):
        adam = [n for n, e in entry["methods"].items() if e["group"] == "adam"]
        shade = dict(zip(adam, colours(len(adam)), strict=True))
        other = {
            "rcv": "#555555",
            "meta": "#1f6fb4",
            "meta, naive": "#7fb2dd",
            "coupled": "#1a8f4c",
            "coupled, rcv": "#8a3fa8",
        }
        for column, (axis, unit) in enumerate(zip(row, ("seconds", "paths"), strict=True)):
            for method, found in entry["methods"].items():
                colour = shade.get(method, other.get(found["group"]))
                label = f"{method}, rate {found['rate']:g}: {found['final'][0]:.3f}"
                draw(
                    axis,
                    found,
                    column,
                    colour,
                    label,
                    "--" if method.endswith("8 spp") and method not in shade else "-",
                )
            axis.set(title=name, xlabel=unit, ylabel="parameter error / initial", yscale="log")
            if column:
                axis.set_xscale("log")
            else:
                axis.legend(fontsize=6)
    figure.savefig(HERE / "figure.png", dpi=110)
    print(f"wrote {HERE / 'figure.png'}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--problem", action="append", choices=list(OPTIONS))
    parser.add_argument("--seconds", type=float, help="budget of every run")
    parser.add_argument("--steps", type=int, help="budget of every run, in place of seconds")
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--resolution", type=int, help="film size, for GPUs")
    parser.add_argument("--only", action="append", metavar="NAME", help="run these again, keep the others' figures")
    parser.add_argument("--plot-only", action="store_true")
    asked = parser.parse_args()
    if not asked.plot_only:
        ur.use()
        entries: dict[str, Any] = read(HERE)["entries"] if (HERE / "results.json").is_file() else {}
        for name in asked.problem or OPTIONS:
            options = {**OPTIONS[name], **({"resolution": asked.resolution} if asked.resolution else {})}
            problem = ur.gallery.problem(name, **options)
            chosen = [e for e in entrants(name) if not asked.only or e.name in asked.only]
            kept = entries.get(name, {}).get("methods", {}) if asked.only else {}
            given = {"seconds": asked.seconds, "steps": asked.steps}
            budget = {k: v for k, v in given.items() if v is not None} or BUDGETS[name]
            old = entries.get(name, {})
            if kept and (old["options"], old["budget"], old["seeds"]) != (options, budget, asked.seeds):
                raise SystemExit(
                    f"{name}: the figures to keep are of {old['options']}, {old['budget']}, {old['seeds']} seeds"
                )
            methods = {**kept, **race(problem, chosen, asked.seeds, TUNING_SEEDS[name], **budget)}
            entries[name] = {
                "options": options,
                "budget": budget,
                "seeds": asked.seeds,
                "methods": methods,
                "summary": summarise(methods),
            }
            write(HERE, {"entries": entries})
    plot(read(HERE))


if __name__ == "__main__":
    main()
