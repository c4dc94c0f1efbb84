"""Finite differences of gradients (Meta Eq. 14 and section 7): how their variance falls with the step.

Variance: at the start of each problem, the parameters of the previous state are moved by a step towards the truth whose length is varied;
Var[ΔF] is taken over runs, summed over the elements, in path space and in primary sample space, with its log-log slope. Noise: the variance
of plain gradients by samples per pixel, near the truth, summed over elements: where that of images and adjoints multiply, it falls with the
square of the samples, and many in one step serve a descent better than as many over several.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

import unrender as ur
from benchmarks import figures, markdown
from benchmarks.internals import Key, arrays, coupled_gradients, trees
from benchmarks.paths import truth
from benchmarks.pixel_schemes import gradients, spread
from benchmarks.runner.records import Record

PROBLEMS = ("spiral", "indirect-room", "ajar", "chalice")
STEPS = (0.3, 0.1, 0.03, 0.01, 0.003)
"""Share of the way from the start to the truth."""
NOISE_SPP = (2, 4, 8, 16, 64)
NEAR = 0.9
"""Share of the way at which the noise is measured."""
MERGE = ("variance.problems", "noise.problems")
QUICK = {"problem": ("chalice",), "resolution": 8, "runs": 3, "spp": 2, "noise_runs": 3}


def variances(problem: ur.Problem, spp: int, runs: int) -> dict[str, Any]:
    """Summed over elements, per space: of the gradient, and of its difference for each step length; and the slope."""
    start, end = problem.initial(), truth(problem)
    found: dict[str, Any] = {"steps": STEPS}
    for space in ("path", "primary"):
        rows: list[float] = []
        gradient = 0.0
        for share in STEPS:
            previous = {k: x + (end[k] - x) * arrays.scalar(share, x) for k, x in start.items()}
            arrays.evaluate(previous)
            pairs = [coupled_gradients(problem, start, previous, space, spp, Key(1, n)) for n in range(runs)]
            gradient = float(np.stack([trees.ravel(F) for F, _ in pairs]).var(0, ddof=1).sum())
            rows.append(float(np.stack([trees.ravel(trees.subtract(F, H)) for F, H in pairs]).var(0, ddof=1).sum()))
        slope = float(np.polyfit(np.log(STEPS), np.log(rows), 1)[0])
        found[space] = {"gradient": gradient, "difference": rows, "slope": slope}
        print(problem.name, space, f"slope {slope:.3f}", [f"{r / gradient:.2g}" for r in rows], flush=True)
    return found


def noise(problem: ur.Problem, runs: int) -> list[float]:
    """The variance of a plain gradient at each of `NOISE_SPP`, summed over the elements."""
    start, end = problem.initial(), truth(problem)
    parameters = {k: x + (end[k] - x) * arrays.scalar(NEAR, x) for k, x in start.items()}
    arrays.evaluate(parameters)
    found = []
    for spp in NOISE_SPP:
        rows, _, _ = gradients(problem, ur.PathGradient(spp=spp), runs, at=parameters)
        found.append(spread(rows)[0])
    print(problem.name, "Var F of equal paths", *(v * n for v, n in zip(found, NOISE_SPP, strict=True)), flush=True)
    return found


def run(
    problem: tuple[str, ...] = PROBLEMS,
    part: tuple[str, ...] = ("variance", "noise"),
    resolution: int = 32,
    spp: int = 4,
    runs: int = 48,
    noise_runs: int = 64,
) -> Iterator[dict[str, Any]]:
    """Variances of differences, then of gradients.

    Args:
        noise_runs: of the noise
    """
    options = {"resolution": resolution, "texture_resolution": 16, "reference_spp": 512, "loss": "RelativeL2"}
    if "variance" in part:
        found = {name: variances(ur.gallery.problem(name, **options), spp, runs) for name in problem}
        yield {"variance": {"resolution": resolution, "spp": spp, "runs": runs, "problems": found}}
    if "noise" in part:
        found = {}
        for name in problem:
            size = {**options, "texture_resolution": 1} if name == "spiral" else options
            found[name] = noise(ur.gallery.problem(name, **size), noise_runs)
        yield {"noise": {"resolution": resolution, "runs": noise_runs, "spp": NOISE_SPP, "problems": found}}


def table(record: Record) -> str:
    variance, noise = record["variance"], record["noise"]
    first = next(iter(variance["problems"].values()))
    text = "{resolution}², {spp} spp, {runs} runs. Var ΔF / Var F by step, a share of the way to the truth:".format(
        **variance
    )
    rows = []
    for name, entry in variance["problems"].items():
        for space in ("path", "primary"):
            ratios = (f"{value / entry[space]['gradient']:.1e}" for value in entry[space]["difference"])
            rows.append([name, space, f"{entry[space]['slope']:.2f}", *ratios])
    head = ["problem | space | slope, log-log", *(f"{step:g}" for step in first["steps"])]
    parts = [text, markdown.table(" | ".join(head), rows)]
    rows = []
    for name, values in noise["problems"].items():
        of_paths = [v * n for v, n in zip(values, noise["spp"], strict=True)]
        rows.append([name, *(f"{v / of_paths[0]:.3f}" for v in of_paths)])
    text = "Var F of plain gradients times samples per pixel, over that at {spp[0]}, near the truth: what equal paths in steps of so many "
    text += "leave of noise ({resolution}², {runs} runs):"
    head = " | ".join(["problem", *(f"{n} spp" for n in noise["spp"])])
    return markdown.blocks(*parts, markdown.fill(text, noise), markdown.table(head, rows))


def plot(record: Record) -> figures.Figure:
    """Variance of the difference over that of the gradient, against the step."""
    contenders = {
        f"{name}, {space}: slope {found[space]['slope']:.2f}": [
            (found["steps"][::-1], np.array(found[space]["difference"])[::-1] / found[space]["gradient"])
        ]
        for name, found in record["variance"]["problems"].items()
        for space in ("path", "primary")
    }
    return figures.curves({"": contenders}, "step, share of the way to the truth", "Var ΔF / Var F", log="xy")
