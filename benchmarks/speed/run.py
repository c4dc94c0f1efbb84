# Dr.Jit's stubs know less than its functions return.
# pyright: reportArgumentType=false, reportAttributeAccessIssue=false, reportReturnType=false

"""What a pair, a step and the loop cost, as ratios within one run.

    python benchmarks/speed/run.py [--resolution 128] [--spp 16]

On `indirect-room`: the pair against a plain primal render of the same kernel and of Mitsuba's `prb`; a step with crossed halves and a
step with the control variate against the stock loop (`mi.render`, `dr.backward`, `mi.ad.Adam`) at equal spp; the variance of
the gradients, crossed against own paths; the share of a step spent outside kernels, and whether any kernel is new after warm-up.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path
from typing import Any

import drjit as dr
import matplotlib.pyplot as plt
import mitsuba as mi
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from common import median_time, mitsuba_renderer, read, stock_loop, write

import unrender as ur
from unrender.core.random import Key
from unrender.problem.bounds import project
from unrender.rendering.renderer import SampleRequest

HERE = Path(__file__).resolve().parent


def stepper(problem: ur.Problem, estimator: Any) -> Any:
    """A function that takes one whole step."""
    optimizer = ur.optimizers.Adam(learning_rate=1e-3)
    parameters = problem.initial()
    box = {"p": parameters, "s": estimator.init(problem, parameters), "m": optimizer.init(parameters)}

    def step(number: int) -> None:
        found, box["s"] = estimator.estimate(problem, box["p"], box["s"], Key(0, number))
        steps, box["m"] = optimizer.update(found, box["m"], box["p"])
        box["p"] = {k: project(x + steps[k], *problem.bounds[k]) for k, x in box["p"].items()}
        dr.eval(box["p"], box["m"])

    return step


def stock_time(problem: ur.Problem, spp: int, steps: int = 20) -> float:
    """Median milliseconds of a step of the stock loop."""
    clock = [h["seconds"] for h in stock_loop(problem, spp, 1e-3, steps=steps, every=1)]
    return 1e3 * float(np.median(np.diff(clock)))


def primal_costs(problem: ur.Problem, spp: int) -> dict[str, Any]:
    """A pair against plain renders, in milliseconds."""
    renderer = mitsuba_renderer(problem)
    session = renderer.prepare([p.key for p in problem.parameters], "path")
    now = problem.initial()
    before = {k: x * 0.99 for k, x in now.items()}
    dr.eval(before)
    prb = mi.load_dict({"type": "prb", "max_depth": problem.max_depth})
    scene = renderer.pair.current
    plain = median_time(lambda n: dr.eval(session.image(now, SampleRequest(0, spp, n, 2)).images))

    def pair(n: int) -> None:
        found = session.image_pair(now, before, SampleRequest(0, spp, n, 2), "path")
        dr.eval(found.images, found.previous)

    both = median_time(pair)
    with dr.suspend_grad():
        stock = median_time(lambda n: dr.eval(prb.render(scene, sensor=0, spp=spp, seed=n)))
    return {
        "plain": plain,
        "pair": both,
        "mitsuba_prb": stock,
        "pair/plain": both[0] / plain[0],
        "pair/prb": both[0] / stock[0],
    }


def outside_kernels(problem: ur.Problem, estimator: Any, steps: int = 10) -> dict[str, Any]:
    """The share of wall clock that no kernel accounts for, and how many kernels were new, over some steps after warm-up."""
    step = stepper(problem, estimator)
    warm = 8
    for number in range(warm):
        step(number)
    dr.sync_thread()
    began = time.perf_counter()  # without the history, whose own upkeep would count
    for number in range(warm, warm + steps):
        step(number)
    dr.sync_thread()
    wall = 1e3 * (time.perf_counter() - began)
    inside, new, launched = 0.0, 0, 0
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        for number in range(warm + steps, warm + 2 * steps):
            dr.kernel_history_clear()
            step(number)
            dr.sync_thread()
            history = dr.kernel_history()
            inside += sum(k["execution_time"] for k in history)
            jit = [k for k in history if k["type"] == dr.KernelType.JIT]
            launched += len(jit)
            new += sum(not k["cache_hit"] or k["cache_disk"] for k in jit)
    return {
        "wall_ms": wall / steps,
        "kernels_ms": inside / steps,
        "outside": 1 - inside / wall,
        "launched": launched / steps,
        "new": new,
    }


def gradient_variance(problem: ur.Problem, spp: int, count: int = 24) -> dict[str, Any]:
    """Variance of the gradient summed over elements, crossed groups against an adjoint on paths of its own at equal spp.

    At the start, where the loss derivative is large, and a twentieth of the way from the truth to it. On its own paths an
    image and an adjoint are correlated; their product's variance gains or loses by that, as the loss derivative is positive or not.
    """
    renderer = mitsuba_renderer(problem)
    start = problem.initial()
    truth = {key: renderer.array(np.asarray(problem.truth[key], np.float32)) for key in start}
    near = {key: truth[key] + (start[key] - truth[key]) * 0.05 for key in start}
    dr.eval(near)
    crossed = ur.PathGradient(spp=spp)
    own = ur.PathGradient(spp=spp, adjoint_spp=spp)
    found: dict[str, Any] = {}
    for place, point in (("start", start), ("near the truth", near)):
        variances = []
        for estimator in (crossed, own):
            state, rows = estimator.init(problem, point), []
            for number in range(count):
                gradient = estimator.estimate(problem, point, state, Key(7, number))[0].gradient
                rows.append(np.concatenate([np.ravel(np.array(g)) for g in gradient.values()]))
            variances.append(float(np.var(np.stack(rows).astype(np.float64), axis=0, ddof=1).sum()))
        found[place] = {"crossed": variances[0], "own paths": variances[1], "ratio": variances[0] / variances[1]}
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--resolution", type=int, default=128)
    parser.add_argument("--spp", type=int, default=16)
    parser.add_argument("--plot-only", action="store_true")
    asked = parser.parse_args()
    if not asked.plot_only:
        print(ur.use())
        linear = ur.gallery.problem("indirect-room", resolution=asked.resolution, loss="L2")
        plain, rcv = ur.PathGradient(spp=asked.spp), ur.PathGradient(ur.images.RecursiveControlVariate(), spp=asked.spp)
        primal = primal_costs(linear, asked.spp)
        print(primal)
        steps = {
            "stock": stock_time(linear, asked.spp),
            "crossed": median_time(stepper(linear, plain)),
            "rcv": median_time(stepper(linear, rcv)),
        }
        ratios = {"crossed/stock": steps["crossed"][0] / steps["stock"], "rcv/stock": steps["rcv"][0] / steps["stock"]}
        print(steps, ratios)
        small = ur.PathGradient(ur.images.RecursiveControlVariate(), spp=2)
        defaults = {name: ur.gallery.problem(name) for name in ur.gallery.names()}
        figures = {
            "resolution": asked.resolution,
            "spp": asked.spp,
            "primal_ms": primal,
            "step_ms": steps,
            "step_ratios": ratios,
            "gradient_variance": {
                name: gradient_variance(
                    ur.gallery.problem(name, resolution=asked.resolution // 2, loss="L2"), asked.spp
                )
                for name in ur.gallery.names()
            },
            "outside_kernels": {name: outside_kernels(problem, small) for name, problem in defaults.items()},
        }
        for name in defaults:
            print(name, figures["gradient_variance"][name], figures["outside_kernels"][name])
        write(HERE, figures)
    plot(read(HERE))


def plot(results: dict[str, Any]) -> None:
    """Two bar charts: primal and step."""
    figure, axes = plt.subplots(1, 2, figsize=(9, 3.2), layout="constrained")
    primal = {k: results["primal_ms"][k][0] for k in ("mitsuba_prb", "plain", "pair")}
    steps = {
        "stock loop": results["step_ms"]["stock"],
        "crossed halves": results["step_ms"]["crossed"][0],
        "control variate": results["step_ms"]["rcv"][0],
    }
    for axis, bars, title in zip(axes, (primal, steps), ("primal render", "whole step"), strict=True):
        axis.bar(list(bars), list(bars.values()), color=["#888888", "#d1782a", "#1f6fb4"])
        axis.set(title=f"{title}, {results['resolution']}², {results['spp']} spp", ylabel="milliseconds")
    figure.savefig(HERE / "figure.png", dpi=110)
    print(f"wrote {HERE / 'figure.png'}")


if __name__ == "__main__":
    main()
