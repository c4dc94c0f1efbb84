"""Heuristic control weights while parameters move (RCV Sec. 7): the error of the remembered image, by rule of the weight.

`three-bodies` along two paths of its parameters: a descent, which moves fast and then settles (Adam, gradients at 16
spp), and a path to and fro between the descent's start and the truth, which never rests. Every rule of
`benchmarks/weight_rules.py` weighs the same pairs of renders, shared in path space, at the same parameters.

The error is the mean squared difference to a converged image at several steps, freed of that image's own noise, over the error of a plain
render of the same step; 1 is no gain. Weights of 1 and n/(n+1) do not depend on samples, so theirs is variance alone; the others' has their
bias in it. After the second and third render, too, where the rules by statistics know no variance yet.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

import unrender as ur
from benchmarks import figures, markdown
from benchmarks.internals import Tree, arrays
from benchmarks.paths import converged, descent, truth
from benchmarks.runner.records import Record
from benchmarks.weight_rules import RULES, one_run

RATE = 0.02
QUICK = {"resolution": 8, "spp": 2, "steps": 9, "runs": 3, "reference_spp": 64}


def to_and_fro(problem: ur.Problem, steps: int) -> list[Tree]:
    """From the initial values to the truth and back, as a cosine of 64 steps."""
    start, end, path = problem.initial(), truth(problem), []
    for step in range(steps):
        share = 0.5 - 0.5 * np.cos(2 * np.pi * step / 64)
        path.append({key: x + (end[key] - x) * arrays.scalar(float(share), x) for key, x in start.items()})
    arrays.evaluate(path)
    return path


def measure(problem: ur.Problem, path: Sequence[Tree], spp: int, runs: int, reference_spp: int) -> dict[str, Any]:
    """Of each rule: mean weight at every step; error over a plain render's at some steps, with its standard error over runs."""
    last = len(path) - 1
    at = sorted({1, 2, *(round(last * part / 8) for part in range(1, 9))})
    references = [converged(problem, path[step], reference_spp) for step in at]
    errors = {rule: np.zeros((runs, len(at))) for rule in RULES}
    weights = {rule: np.zeros(len(path)) for rule in RULES}
    for run in range(runs):
        images, used = one_run(problem, path, spp, run)
        for rule in RULES:
            weights[rule] += used[rule].mean(axis=(1, 2, 3)) / runs
            for place, (step, reference) in enumerate(zip(at, references, strict=True)):
                squares = np.square(images[rule][step] - reference.mean) - np.square(reference.error)
                errors[rule][run, place] = squares.mean()
        print(f"run {run + 1} of {runs}", flush=True)
    plain = errors["plain"].mean(axis=0)
    return {
        "steps": at,
        "rules": {
            rule: {
                "weight": weights[rule].tolist(),
                "error": (found.mean(axis=0) / plain).tolist(),
                "standard_error": (found.std(axis=0, ddof=1) / np.sqrt(runs) / plain).tolist(),
            }
            for rule, found in errors.items()
        },
    }


def run(
    resolution: int = 24, spp: int = 4, steps: int = 129, runs: int = 16, reference_spp: int = 4096
) -> dict[str, Any]:
    problem = ur.gallery.problem("three-bodies", resolution=resolution, reference_spp=1024)
    paths = {
        "descent": descent(problem, ur.PathGradient(spp=16), RATE, steps),
        "to and fro": to_and_fro(problem, steps),
    }
    return {"paths": {name: measure(problem, path, spp, runs, reference_spp) for name, path in paths.items()}}


def table(record: Record) -> str:
    text = "`three-bodies`, {resolution}², {spp} spp, {runs} runs; squared error of the image over a plain render's."
    parts = [text.format(**record["settings"])]
    for name, found in record["paths"].items():
        places = [0, 1, len(found["steps"]) // 2, len(found["steps"]) - 1]
        heads = (f"step {found['steps'][place]}" for place in places)
        cells = (f"{{error[{place}]:.3f}} ± {{standard_error[{place}]:.3f}}" for place in places)
        head = " | ".join([f"{name}, rule", *heads, "last weight"])
        row = " | ".join(["{rule}", *cells, "{weight[-1]:.3f}"])
        rules = (entry for entry in markdown.named(found["rules"], "rule") if entry["rule"] != "plain")
        parts.append(markdown.records(head, row, rules))
    return markdown.blocks(*parts)


def plot(record: Record) -> figures.Figure:
    """Error over a plain render's, a panel per path."""
    panels = {
        name: {
            rule: figures.band(found["steps"], entry["error"], entry["standard_error"])
            for rule, entry in found["rules"].items()
        }
        for name, found in record["paths"].items()
    }
    return figures.curves(panels, "step", "squared error over a plain render's", level=1.0)
