"""Mini-batches of views, drawn by what their gradients tell, over views that are equally likely.

Adam descends with `Views(count, by="gradients")`. After some steps the parameters and the state are kept; then the variance of
many gradients from them, summed over all elements, is compared with that of as many of equally likely views: plain, and relative to each
element's mean square, which is what Adam's steps see. None of this depends on the machine's load.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

import unrender as ur
from benchmarks.adaptive.over_uniform.run import Kept, spread
from benchmarks.internals import Key, element_scales
from benchmarks.suite.scenes import problem as foreign_problem

GALLERY: dict[str, dict[str, Any]] = {
    "glossy-room": {"resolution": 32, "views": 6, "reference_spp": 64},
    "nerf-volume": {"resolution": 32, "views": 12, "reference_spp": 32},
}
FOREIGN = ("painting, L2",)
"""Of the assets."""
MERGE = ("problems.*",)
QUICK = {"problem": ("glossy-room",), "at": (12,), "runs": 16}


def opened(name: str, assets: Path | None) -> ur.Problem:
    """The problem of that name."""
    if name not in FOREIGN:
        return ur.gallery.problem(name, **GALLERY[name])
    if assets is None:
        raise ur.InputError(f"{name}: give --assets, the folder of the scenes of others")
    return foreign_problem(name, assets, 32, 32, 256)


def point(problem: ur.Problem, kept: Kept, step: int, count: int, runs: int) -> dict[str, Any]:
    """Probabilities of views over equal ones, and the ratios of variances [plain, relative] with their errors."""
    at, state = kept.before[step]
    found: dict[str, np.ndarray] = {}
    for name in ("equal", "gradients"):
        sampler = ur.pixels.Views(count, by="uniform" if name == "equal" else "gradients")
        estimator = ur.PathGradient(pixels=sampler, spp=2)
        begun = estimator.init(problem, at) if name == "equal" else state
        rows = []
        for run in range(runs):
            estimate, _ = estimator.estimate(problem, at, begun, Key(step + 1, run))
            pulled = problem.coordinates.pull_back(estimate.gradient, problem.coordinates.slopes(at))
            rows.append(np.concatenate([np.array(g).ravel() for g in pulled.values()]))
        found[name] = np.array(rows, np.float32)
    scales = element_scales(at, np.square(np.concatenate(list(found.values()))).mean(axis=0, dtype=np.float64))
    entry: dict[str, Any] = {"step": step, "uniform": state.pixels.uniform, "ratio": [], "error": []}
    entry["density"] = state.pixels.density().tolist()
    for weights in (np.ones(len(scales)), np.square(scales)):
        (a, error_a), (e, error_e) = spread(found["gradients"], weights), spread(found["equal"], weights)
        entry["ratio"].append(a / e)
        entry["error"].append(a / e * float(np.hypot(error_a, error_e)))
    return entry


def run(
    problem: tuple[str, ...] = (*GALLERY, *FOREIGN),
    assets: Path | None = None,
    at: tuple[int, ...] = (20, 80),
    runs: int = 160,
) -> Iterator[dict[str, Any]]:
    """A part per problem.

    Args:
        problem: of the gallery, or of others where assets are given
        assets: folder of the scenes of others
        at: steps of the descent before which variances are compared
        runs: gradients for each
    """
    for name in problem:
        if name in FOREIGN and assets is None:
            print(f"{name}: left out, without assets", flush=True)
            continue
        made = opened(name, assets)
        count = max(1, len(made.views) // 4)
        kept = Kept(ur.PathGradient(pixels=ur.pixels.Views(count, by="gradients"), spp=2), at)
        ur.optimize(made, kept, ur.optimizers.Adam(0.01), steps=max(at) + 1, seed=0)
        points = [point(made, kept, step, count, runs) for step in at]
        print(name, points, flush=True)
        yield {"problems": {name: {"views": len(made.views), "count": count, "points": points}}}
