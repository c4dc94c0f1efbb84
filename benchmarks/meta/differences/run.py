"""What finite differences of gradients cost, and how their variance falls with the step (Balint et al. 2023, Eq. 14 and section 7).

    python benchmarks/meta/differences/run.py [--resolution 32] [--runs 48] [--spp 4]

Variance: at the start of each problem, the parameters of the previous state are moved by a step towards the truth whose length is
varied; Var[ΔF] is taken over runs, summed over the elements, in path space and in primary sample space, with its log-log slope.
Cost: an estimate by plain gradients at 4 spp, of the paper's meta-estimation and of the coupled form, and the parts of the meta step.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
from common import median_time, read, write

import unrender as ur
from unrender.core import arrays, trees
from unrender.core.random import Key
from unrender.core.trees import Tree
from unrender.estimators.sample_groups import gather
from unrender.images.base import PairRequest
from unrender.images.plain import PlainState
from unrender.rendering.renderer import SampleRequest

HERE = Path(__file__).resolve().parent
PROBLEMS = ("spiral", "indirect-room", "ajar", "chalice")
STEPS = (0.3, 0.1, 0.03, 0.01, 0.003)
"""Share of the way from the start to the truth."""


def difference(problem: ur.Problem, current: Tree, previous: Tree, space: Any, spp: int, key: Key) -> tuple[Tree, Tree]:
    """(F, ΔF) on `spp` coupled samples."""
    found = gather(
        problem, current, ur.images.Plain(), PlainState(), spp, key, pair_request=PairRequest(previous, space)
    )
    assert found.previous is not None
    return found.gradient, trees.subtract(found.gradient, found.previous)


def variances(problem: ur.Problem, spp: int, runs: int) -> dict[str, Any]:
    """Summed over elements, per space: of the gradient, and of its difference for each step length; and the slope."""
    start, truth = problem.initial(), {k: problem.renderer.array(v) for k, v in problem.truth.items()}
    found: dict[str, Any] = {"steps": STEPS}
    for space in ("path", "primary"):
        rows: list[float] = []
        gradient = 0.0
        for share in STEPS:
            previous = {k: x + (truth[k] - x) * arrays.scalar(share, x) for k, x in start.items()}
            arrays.evaluate(previous)
            both = [difference(problem, start, previous, space, spp, Key(1, run)) for run in range(runs)]
            flat = [
                np.stack([np.concatenate([arrays.numpy(x).ravel() for x in pair[side].values()]) for pair in both])
                for side in (0, 1)
            ]
            gradient = float(flat[0].var(0, ddof=1).sum())
            rows.append(float(flat[1].var(0, ddof=1).sum()))
        slope = float(np.polyfit(np.log(STEPS), np.log(rows), 1)[0])
        found[space] = {"gradient": gradient, "difference": rows, "slope": slope}
        print(
            f"{problem.name} {space}: slope {slope:.3f}, Var ΔF / Var F {[f'{r / gradient:.2g}' for r in rows]}",
            flush=True,
        )
    return found


def costs(problem: ur.Problem) -> dict[str, float]:
    """Milliseconds of whole estimates, and of what a meta step is made of."""
    parameters = problem.initial()
    previous = trees.map(lambda x: x * 0.99, parameters)
    estimators = {
        "plain 4 spp": ur.PathGradient(spp=4),
        "meta 2 + 1": ur.MetaEstimator(),
        "coupled 3 spp": ur.MetaEstimator(coupled=True, spp=3),
        "coupled 4 spp": ur.MetaEstimator(coupled=True, spp=4),
        "plain 2 spp": ur.PathGradient(spp=2),
    }
    found: dict[str, float] = {}
    for name, estimator in estimators.items():
        kept = [estimator.init(problem, parameters)]
        points = [parameters, previous]

        def step(seed: int, estimator: Any = estimator, kept: Any = kept, points: Any = points) -> None:
            # A new array per step, as a descent gives: the scenes take it in again.
            points.append(trees.map(lambda x: x * 1.0, points[seed % 2]))
            kept[0] = estimator.estimate(problem, points[-1], kept[0], Key(0, seed))[1]

        found[name] = median_time(step)[0]
    request = SampleRequest(problem.views[0].sensor, 1, 5)
    session = problem.renderer.prepare(list(parameters), "path")
    pair = session.image_pair(parameters, previous, request, "path")
    weights = problem.loss_derivative(0, pair.images)
    found["one pair of images, 1 spp"] = median_time(
        lambda seed: session.image_pair(parameters, previous, SampleRequest(request.sensor, 1, seed), "path")
    )[0]
    found["one pair of adjoints, 1 spp"] = median_time(
        lambda seed: session.adjoint_pair(parameters, previous, pair.paths, weights, weights)
    )[0]
    found["one image, 1 spp"] = median_time(
        lambda seed: session.image(parameters, SampleRequest(request.sensor, 1, seed))
    )[0]
    found["one adjoint, 1 spp"] = median_time(lambda seed: session.adjoint(parameters, pair.paths, weights))[0]
    found["meta / plain 4 spp"] = found["meta 2 + 1"] / found["plain 4 spp"]
    print(problem.name, {k: round(v, 2) for k, v in found.items()}, flush=True)
    return found


def plot(results: dict[str, Any]) -> None:
    """Variance of the difference over that of the gradient against the step, both spaces."""
    figure, axis = plt.subplots(figsize=(6, 4.5), layout="constrained")
    for colour, (name, found) in zip(
        ("#1f6fb4", "#d1782a", "#1a8f4c", "#8a3fa8"), results["variance"].items(), strict=True
    ):
        for space, style in (("path", "o-"), ("primary", "s:")):
            ratio = np.array(found[space]["difference"]) / found[space]["gradient"]
            label = f"{name}, {space}: slope {found[space]['slope']:.2f}"
            axis.loglog(found["steps"], ratio, style, color=colour, label=label, ms=4)
    axis.set(xlabel="step, share of the way to the truth", ylabel="Var ΔF / Var F")
    axis.legend(fontsize=7)
    figure.savefig(HERE / "figure.png", dpi=110)
    print(f"wrote {HERE / 'figure.png'}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--resolution", type=int, default=32)
    parser.add_argument("--cost-resolution", type=int, nargs="+", default=[96, 256])
    parser.add_argument("--costs-only", action="store_true", help="keep the variances that were measured before")
    parser.add_argument("--spp", type=int, default=4)
    parser.add_argument("--runs", type=int, default=48)
    parser.add_argument("--plot-only", action="store_true")
    asked = parser.parse_args()
    if not asked.plot_only:
        ur.use()
        loss = "RelativeL2"
        cost: dict[str, Any] = read(HERE)["cost"] if asked.costs_only else {}
        for size in asked.cost_resolution:
            large = {"resolution": size, "reference_spp": 16}
            cost[str(size)] = {n: costs(ur.gallery.problem(n, loss=loss, **large)) for n in PROBLEMS}
        if asked.costs_only:
            kept = ("resolution", "spp", "runs", "variance")
            write(HERE, {**{key: read(HERE)[key] for key in kept}, "cost": cost})
            return plot(read(HERE))
        small = {"resolution": asked.resolution, "texture_resolution": 16, "reference_spp": 512}
        variance = {n: variances(ur.gallery.problem(n, loss=loss, **small), asked.spp, asked.runs) for n in PROBLEMS}
        write(
            HERE,
            {
                "resolution": asked.resolution,
                "spp": asked.spp,
                "runs": asked.runs,
                "variance": variance,
                "cost": cost,
            },
        )
    plot(read(HERE))


if __name__ == "__main__":
    main()
