"""A control variate along a descent (RCV Fig. 2): `three-bodies`, L1.

Along the path of one descent with a control variate, repeated by independent runs: the weight that its pixels get, and
its variance over that of plain renders of as many samples, summed over pixels. Besides, each parameter's error over
descents with a control variate and with plain renders, Adam at one rate for both.
"""

from __future__ import annotations

from typing import Any

import numpy as np

import unrender as ur
from benchmarks import figures, markdown
from benchmarks.moments import summed_variances
from benchmarks.paths import descent, images_along
from benchmarks.runner.records import Record

METHODS = {"rcv": ur.images.RecursiveControlVariate(), "plain": ur.images.Plain()}
QUANTILES = [10, 50, 90]
QUICK = {"steps": 6, "spp": 2, "runs": 3, "seeds": 1, "resolution": 8}


def descents(problem: ur.Problem, steps: int, spp: int, seeds: int) -> tuple[dict[str, Any], list[Any]]:
    """{method: {parameter: (seeds, steps) of errors relative to the first}}, and the path of the first descent of "rcv"."""
    start, found, first = problem.parameter_error(problem.initial()), {}, []
    for method, image in METHODS.items():
        found[method] = {key: [] for key in start}
        for seed in range(seeds):
            path = descent(problem, ur.PathGradient(image, spp=spp), 0.01, steps, seed)
            first = first or path
            errors = [problem.parameter_error(state) for state in path]
            for key, begun in start.items():
                found[method][key].append([error[key] / begun for error in errors])
        print(method, {key: np.mean([run[-1] for run in runs]) for key, runs in found[method].items()}, flush=True)
    return found, first


def measure(problem: ur.Problem, path: list[Any], spp: int, runs: int) -> dict[str, Any]:
    """Weights and variance along the path, over independent runs."""
    images, means, quantiles, renders = [], [], [], []
    for number in range(runs):
        kept, weights = images_along(problem, METHODS["rcv"], path, spp, 1000 + number)
        images.append(kept)
        means.append(weights.mean(axis=(1, 2, 3)))
        quantiles.append(np.percentile(weights, QUANTILES, axis=(1, 2, 3)))
    for number in range(runs):
        renders.append(images_along(problem, METHODS["plain"], path, spp, 5000 + number)[0])
    with_it, without = summed_variances(np.stack(images)), summed_variances(np.stack(renders))
    ratio = with_it.mean(axis=0) / without.mean(axis=0)
    spread = [x.std(axis=0, ddof=1) / np.sqrt(runs) / x.mean(axis=0) for x in (with_it, without)]
    return {
        "weight": np.mean(means, axis=0).tolist(),
        "weight_10_50_90": np.mean(quantiles, axis=0).tolist(),
        "variance_ratio": ratio.tolist(),
        "variance_ratio_error": (ratio * np.hypot(*spread)).tolist(),
    }


def run(steps: int = 250, spp: int = 4, runs: int = 16, seeds: int = 3, resolution: int = 32) -> dict[str, Any]:
    """Errors of the descents, weights and variance along the first.

    Args:
        runs: along one descent's path
        seeds: descents
    """
    problem = ur.gallery.problem("three-bodies", resolution=resolution, reference_spp=4096)
    errors, path = descents(problem, steps, spp, seeds)
    return {"errors": errors, **measure(problem, path, spp, runs)}


def table(record: Record) -> str:
    last = len(record["weight"]) - 1
    row = "{0} | {{weight[{0}]:.3f}} | {{weight_10_50_90[1][{0}]:.3f}} | {{variance_ratio[{0}]:.3f}} ± {{variance_ratio_error[{0}]:.3f}}"
    rows = [[markdown.fill(row.format(n), record)] for n in sorted({1, 5, 20, 50, 100, 200, 500, last}) if n <= last]
    keys = list(record["errors"]["rcv"])
    ends = [[method, *(_median(runs[key]) for key in keys)] for method, runs in record["errors"].items()]
    text = "`three-bodies`, {resolution}², {spp} spp, L1, Adam at 0.01, {steps} steps; weights and variance over {runs} runs along one "
    text += "descent's path."
    seeds = record["settings"]["seeds"]
    return markdown.blocks(
        text.format(**record["settings"]),
        markdown.table("step | weight, mean over pixels | median | variance over that of a plain render", rows),
        f"Errors over the initial ones, mean of the last fifth of the steps: median of {seeds} seeds (range).",
        markdown.table(" | ".join(["image", *keys]), ends),
    )


def _median(runs: list[list[float]]) -> str:
    return markdown.spread([float(np.mean(run[-(len(run) // 5) :])) for run in runs])


def plot(record: Record) -> figures.Figure:
    """Weight, variance over a plain render's, and a panel for each parameter."""
    steps = range(len(record["weight"]))
    panels = {
        "control weight": {"mean": figures.over_steps(record["weight"])},
        "variance over a plain render's": {
            "control variate": figures.band(steps, record["variance_ratio"], record["variance_ratio_error"])
        },
    }
    for key in record["errors"]["rcv"]:
        panels[f"error of {key.split('.')[0]}"] = {
            method: figures.over_steps(*runs[key]) for method, runs in record["errors"].items()
        }
    return figures.curves(panels, "step", "", columns=3)
