"""Shared samples in primary sample space and in path space (RCV Fig. 8).

On `glossy-room` (its roughness maps change where paths go) and `indirect-room` (its albedo does not), view 0. One descent fixes the path of
the parameters; a plain render, a control variate in primary space and one in path space then take it alike, on several seeds. Per step: the
mean control weight and the variance over runs, relative to that of the plain render; every few steps also the mean square error against a
converged image, likewise relative. The cost is the median time of one image of one view, and of one whole gradient step of all views.
"""

from __future__ import annotations

from typing import Any

import numpy as np

import unrender as ur
from benchmarks import figures, markdown
from benchmarks.internals import ImageEstimator, Key, Tree, arrays, dr, image_step
from benchmarks.moments import Moments
from benchmarks.paths import converged, descent, follow, weight_of
from benchmarks.runner.records import Record
from benchmarks.runner.timing import medians, turns

RATE = 0.02
METHODS: dict[str, ImageEstimator] = {
    "plain": ur.images.Plain(),
    "primary": ur.images.RecursiveControlVariate(space="primary"),
    "path": ur.images.RecursiveControlVariate(space="path"),
}
QUICK = {"scene": ("glossy-room",), "resolution": 8, "spp": 2, "steps": 4, "runs": 2, "every": 2, "reference_spp": 128}


def measure(
    problem: ur.Problem, path: list[Tree], spp: int, runs: int, every: int, reference_spp: int
) -> dict[str, Any]:
    """Return weights, variances and errors of every method along the path."""
    checked = sorted({*range(0, len(path), every), len(path) - 1})
    references = {step: converged(problem, path[step], reference_spp) for step in checked}
    # What noise the references add to a mean square error.
    floor = {step: float(np.mean(reference.error**2)) for step, reference in references.items()}
    result: dict[str, Any] = {"checked": checked, "methods": {}}
    for name, estimator in METHODS.items():
        seen = [Moments() for _ in path]
        weights = [Moments() for _ in path]
        errors = {step: Moments() for step in checked}
        for run in range(runs):
            for step, estimate in enumerate(follow(problem, estimator, path, spp, run)):
                image = arrays.numpy(estimate.mean()).astype(np.float64)
                seen[step].add(image)
                weights[step].add(weight_of(estimate, image).mean())
                if step in errors:
                    errors[step].add(np.mean((image - references[step].mean) ** 2) - floor[step])
        result["methods"][name] = {
            "weight": [w.level for w in weights],
            "variance": [float(m.variance.mean()) for m in seen],
            "error": [errors[step].level for step in checked],
            "error_error": [errors[step].level_error for step in checked],
        }
        print(f"{problem.name}, {name}: done", flush=True)
    return result


def costs(problem: ur.Problem, path: list[Tree], spp: int) -> dict[str, dict[str, float]]:
    """Median milliseconds of an image (view 0) and of a gradient (all views), one method after the other.

    Parameters change at every call.
    """
    found: dict[str, dict[str, float]] = {}
    for name, image in METHODS.items():
        estimator = ur.PathGradient(image, spp=spp)
        states: dict[str, Any] = {"image": image.init(problem, path[0]), "step": estimator.init(problem, path[0])}

        def one_image(n: int, image: ImageEstimator = image, states: dict[str, Any] = states) -> None:
            now = path[n % len(path)]
            estimate, states["image"] = image_step(problem, image, now, states["image"], spp, Key(1, n))
            dr.eval(estimate.images, states["image"])

        def one_step(n: int, estimator: ur.PathGradient = estimator, states: dict[str, Any] = states) -> None:
            _, states["step"] = estimator.estimate(problem, path[n % len(path)], states["step"], Key(2, n))

        found[name] = medians(turns({"image_ms": one_image})) | medians(turns({"step_ms": one_step}))
    return found


def summarise(entry: dict[str, Any]) -> dict[str, dict[str, float]]:
    """Over the second half of the path: mean weight and plain's variance over this one's; costs relative to plain's."""
    plain, times = entry["methods"]["plain"], entry["costs"]
    half = len(plain["variance"]) // 2
    summary = {}
    for name, found in entry["methods"].items():
        gain = float(np.sum(plain["variance"][half:]) / np.sum(found["variance"][half:]))
        summary[name] = {
            "weight": float(np.mean(found["weight"][half:])),
            "variance_ratio": gain,
            "image_cost": times[name]["image_ms"] / times["plain"]["image_ms"],
            "step_cost": times[name]["step_ms"] / times["plain"]["step_ms"],
            "error_ratio_at_last": plain["error"][-1] / found["error"][-1],
        }
    return summary


def run(
    scene: tuple[str, ...] = ("glossy-room", "indirect-room"),
    resolution: int = 32,
    spp: int = 8,
    steps: int = 50,
    runs: int = 10,
    every: int = 10,
    reference_spp: int = 2048,
) -> dict[str, Any]:
    """Weights, variances, errors and costs of every method.

    Args:
        every: steps between converged images
    """
    entries = {}
    for name in scene:
        problem = ur.gallery.problem(name, resolution=resolution, texture_resolution=max(16, resolution // 2))
        estimator = ur.PathGradient(ur.images.RecursiveControlVariate(), spp=spp)
        path = descent(problem, estimator, RATE, steps)
        entry = measure(problem, path, spp, runs, every, reference_spp)
        entry["costs"] = costs(problem, path, spp)
        entry["summary"] = summarise(entry)
        entries[name] = entry
    return {"rate": RATE, "scenes": entries}


def table(record: Record) -> str:
    text = "{resolution}², {spp} spp, {steps} steps, {runs} runs; relative to a plain render."
    fields = ("weight", "variance_ratio", "error_ratio_at_last", "image_cost", "step_cost")
    return markdown.blocks(
        text.format(**record["settings"]),
        markdown.records(
            "scene | space | mean weight | variance ÷ | error ÷ at the last step | cost of an image | cost of a step",
            " | ".join(["{scene} | {space}", *(f"{{{field}:.2f}}" for field in fields)]),
            markdown.named(record["scenes"], "scene", "summary", "space"),
        ),
    )


def plot(record: Record) -> figures.Figure:
    """Per scene: mean weight, and variance over a plain render's."""
    panels = {}
    for scene, entry in record["scenes"].items():
        spaces = {name: found for name, found in entry["methods"].items() if name != "plain"}
        plain = np.array(entry["methods"]["plain"]["variance"])
        panels[f"{scene}: weight"] = {name: figures.over_steps(found["weight"]) for name, found in spaces.items()}
        panels[f"{scene}: variance over plain"] = {
            name: figures.over_steps(np.array(found["variance"]) / plain) for name, found in spaces.items()
        }
    return figures.curves(panels, "step", "", columns=2)
