"""Standard errors of textures and numbers against the true errors, as scores z = error / standard error, on problems with known truth.

Short runs of `auto` at small sizes, and `unrender.runs.uncertainty` at their ends. Textures count where the references decide at least half
of an element (`Result.data_share`). "wall, noisy" has references of 8 samples per pixel. Each seed has references of its own, since their
noise is an error that all runs of one reference share.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy import stats

import unrender as ur
from benchmarks import figures, markdown
from benchmarks.runner.records import Record
from benchmarks.suite import scenes

MERGE = ("problems.*",)
QUICK: dict[str, Any] = {"problems": ("wall",), "seeds": 1, "steps": (4,)}
_WALL = {"resolution": 40, "texture_resolution": 20}
LEVELS = (np.arange(41) + 0.5) / 41
"""Of the quantiles of scores."""


def problem(name: str, assets: Path) -> ur.Problem:
    """The problem of a name."""
    if name.startswith("wall"):
        return ur.gallery.problem("wall", reference_spp=_spp(name), **_WALL)
    if name == "smoke":
        return ur.gallery.problem("smoke", resolution=16, grid_resolution=8, reference_spp=256, views=4, max_depth=4)
    return scenes.problem(f"{name}, L2", assets, 48, 32, _spp(name))


def _spp(name: str) -> int:
    """Samples per pixel of the references."""
    return {"wall": 1024, "wall, noisy": 8}.get(name, 256)


def with_own_references(made: ur.Problem, spp: int, seed: int) -> ur.Problem:
    """The problem with references of random numbers of their own."""
    views = [
        replace(view, reference=ur.render(made, made.truth, n, spp=spp, seed=1000 * (seed + 1) + n))
        for n, view in enumerate(made.original_views)
    ]
    return made.replaced(views=views)


def run(
    assets: Path = Path("assets"),
    problems: tuple[str, ...] = ("wall", "wall, noisy", "tray", "spot", "numbers", "smoke"),
    seeds: int = 3,
    steps: tuple[int, ...] = (40, 160),
) -> dict[str, Any]:
    """Scores of every problem.

    Args:
        seeds: references and runs of each
    """
    found: dict[str, Any] = {}
    for name, count in itertools.product(problems, steps):
        made, scores, shares = problem(name, assets), [], []
        for seed in range(seeds):
            of = with_own_references(made, _spp(name), seed)
            result = ur.optimize(of, steps=count, seed=seed, progress=False)
            values, known = result.parameters, ur.runs.uncertainty(of, result, seed=seed)
            for key, error in known.standard_error.items():
                z = (values[key] - made.truth[key].reshape(error.shape)) / error
                share = known.data_share.get(key)
                scores.append(np.ravel(z if share is None else z[share >= 0.5]))
                shares.append(1.0 if share is None else float(np.mean(share >= 0.5)))
        z = np.concatenate(scores) if scores else np.zeros(0)
        z = z[np.isfinite(z)]
        entry: dict[str, Any] = {"seeds": seeds, "count": len(z)}
        if len(z):
            entry |= {"std": float(z.std()), "mean": float(z.mean()), "beyond_2": float(np.mean(np.abs(z) > 2))}
            entry |= {"decided": float(np.mean(shares)), "quantiles": np.quantile(z, LEVELS).tolist()}
        found[f"{name}, {count} steps"] = entry
        print(name, count, {k: x for k, x in entry.items() if k != "quantiles"}, flush=True)
    return {"problems": found}


def table(record: Record) -> str:
    rows = []
    for name, entry in record["problems"].items():
        if not entry["count"]:
            rows.append([name, entry["seeds"], 0, "no standard error", "", "", ""])
            continue
        numbers = [f"{entry[key]:.2f}" for key in ("std", "mean")]
        shares = [f"{entry[key]:.1%}" for key in ("beyond_2", "decided")]
        rows.append([name, entry["seeds"], entry["count"], *numbers, *shares])
    head = "problem | references | scores | standard deviation of z (1) | mean of z | beyond ± 2 (4.6 %) | decided by the references"
    return markdown.table(head, rows)


def plot(record: Record) -> figures.Figure:
    """Quantiles of the scores over those of the normal distribution."""
    return quantiles({name: {"measured": entry} for name, entry in record["problems"].items() if entry["count"]})


def quantiles(problems: Mapping[str, Mapping[str, Any]]) -> figures.Figure:
    """Draw quantiles of each problem's scores, by kind, over those of the normal distribution."""
    normal = stats.norm.ppf(LEVELS).tolist()
    panels = {
        name: {kind: [(normal, entry["quantiles"])] for kind, entry in kinds.items()}
        | {"calibrated": [(normal, normal)]}
        for name, kinds in problems.items()
    }
    return figures.curves(panels, "quantile of the normal distribution", "quantile of z", log="")
