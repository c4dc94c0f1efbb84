"""Statistics updated before or after use (RCV Fig. 4): the bias of a weight that depends on the samples it weighs.

On `indirect-room`, once with parameters that do not change and once on a fixed path from the initial values to the truth. Statistics are
updated after use (`RecursiveControlVariate()`) or before (`UpdatedBeforeUse`). Their bias, relative to the mean of the image, is measured
twice: as the mean over runs less a converged image at the same parameters, and, far more precisely, less the same recursion on the same
samples with weights fixed beforehand (those of other runs), which is unbiased. Mean squares are freed of noise. "Equivalent spp" is the spp
of one step times Var[plain] / Var[control variate].

At few samples a part of the bias does not come from the order: while a pixel has seen equal samples only (often 0), its
variance is 0, so is its weight, and those samples are forgotten once another comes. `--spp 32` shows the order alone.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

import unrender as ur
from benchmarks import figures, markdown
from benchmarks.internals import Key, SampleRequest, Tree, advance, arrays, prepare
from benchmarks.moments import Moments, bias, paired_bias
from benchmarks.paths import converged, follow, geometric
from benchmarks.runner.records import Record

METHODS = ("plain", "before", "after")


@dataclass(frozen=True)
class UpdatedBeforeUse(ur.images.RecursiveControlVariate):
    """The biased order of Fig. 4, left: the weight depends on the samples that it weighs."""

    def _combine_view(self, memory: Any, rendering: Any, asked: Any, frame: Any) -> Any:
        number = 1.0 if frame.counts is None else frame.counts.divisors
        mean = arrays.mean_over_first if frame.counts is None else frame.counts.means
        seen = super()._observe(memory, mean(rendering.images), mean(rendering.previous), number)
        return super()._combine_view(seen, rendering, asked, frame)

    def _observe(self, memory: Any, F: Any, H: Any, number: Any) -> Any:
        del F, H, number
        return memory


ORDERS = {"before": UpdatedBeforeUse(), "after": ur.images.RecursiveControlVariate()}
HALF_LIFE = 8.0
"""Steps in which the moving path halves the distance that is left."""
PILOT_SEEDS = (1_000_001, 1_000_002)
QUICK = {"resolution": 8, "spp": 2, "steps": 6, "runs": 3, "reference_spp": 128}


def pilot_weights(problem: ur.Problem, path: list[Tree], spp: int) -> list[Any]:
    """The control weights of every step, averaged over runs of other seeds: independent of all that is measured."""
    found = []
    for seed in PILOT_SEEDS:
        run = follow(problem, ORDERS["after"], path, spp, seed)
        found.append([arrays.numpy(e.info["control_weight"]) if e.info else 0.0 for e in run])
    return [np.mean(np.stack(list(step)), axis=0) for step in zip(*found, strict=True)]


def fixed(problem: ur.Problem, path: list[Tree], weights: list[Any], spp: int, seed: int) -> Iterator[np.ndarray]:
    """The recursion (6) with given weights, on the samples that `follow` takes: unbiased."""
    session, memory = prepare(problem, path[0], "path"), None
    for step, (now, before) in enumerate(zip(path, [path[0], *path], strict=False)):
        request = SampleRequest(problem.views[0].sensor, spp, Key(seed, step).uint32())
        pair = session.image_pair(now, before, request, "path")
        F, H = (arrays.numpy(images)[0].astype(np.float64) for images in (pair.images, pair.previous))
        memory = F if memory is None else advance(memory, F, H, weights[step])
        yield memory


def measure(
    problem: ur.Problem, path: list[Tree], spp: int, runs: int, steps: list[int], reference_spp: int
) -> dict[str, Any]:
    """Return bias and variance of every method at the chosen steps of one path."""
    references: dict[int, Moments] = {}
    for step in steps:
        same = next((s for s in references if path[s] is path[step]), None)
        references[step] = converged(problem, path[step], reference_spp) if same is None else references[same]
    weights = pilot_weights(problem, path, spp)
    found = {name: {step: Moments() for step in steps} for name in METHODS}
    paired = {name: {step: Moments() for step in steps} for name in (*ORDERS, "difference")}
    for run in range(runs):
        plain = follow(problem, ur.images.Plain(), [path[step] for step in steps], spp, runs + run)
        for step, estimate in zip(steps, plain, strict=True):
            found["plain"][step].add(arrays.numpy(estimate.mean()))
        sound = {n: image for n, image in enumerate(fixed(problem, path, weights, spp, run)) if n in steps}
        seen: dict[str, dict[int, np.ndarray]] = {}
        for name, image in ORDERS.items():
            estimates = enumerate(follow(problem, image, path, spp, run))
            seen[name] = {n: arrays.numpy(e.mean()).astype(np.float64) for n, e in estimates if n in steps}
        for step in steps:
            for name in ORDERS:
                found[name][step].add(seen[name][step])
                paired[name][step].add(seen[name][step] - sound[step])
            paired["difference"][step].add(seen["before"][step] - seen["after"][step])
        if (run + 1) % 8 == 0 or run + 1 == runs:
            print(f"run {run + 1} of {runs}", flush=True)
    end = steps[-1]
    scales = {step: float(references[step].mean.mean()) for step in steps}
    methods: dict[str, Any] = {}
    for name, moments in found.items():
        gain = float(found["plain"][end].variance.sum() / moments[end].variance.sum())
        rows = [{"step": step, **bias(moments[step], references[step])} for step in steps]
        methods[name] = {"converged": rows, "equivalent_spp": gain * spp}
    for name, moments in paired.items():
        rows = [{"step": step, **paired_bias(moments[step], scales[step])} for step in steps]
        methods.setdefault(name, {})["paired"] = rows
    return {"methods": methods}


def run(
    resolution: int = 32, spp: int = 4, steps: int = 32, runs: int = 32, reference_spp: int = 8192
) -> dict[str, Any]:
    """Bias and variance of every method on both paths."""
    problem = ur.gallery.problem(
        "indirect-room", resolution=resolution, texture_resolution=resolution, reference_spp=16
    )
    chosen = sorted({*(2**k for k in range(1, 12) if 2**k < steps - 1), steps - 1})
    paths = {"still": [problem.initial()] * steps, "drift": geometric(problem, steps, HALF_LIFE)}
    found = {name: measure(problem, path, spp, runs, chosen, reference_spp) for name, path in paths.items()}
    return {"paths": found}


def table(record: Record) -> str:
    names = {"plain": "plain render", "before": "updated before use (biased)", "after": "updated after use"}
    rows = []
    for path, entry in record["paths"].items():
        for method, name in names.items():
            found = entry["methods"][method]
            absolute = "{signed:+.2%} ± {signed_error:.2%}".format(**found["converged"][-1])
            paired = "{signed:+.3%} ± {signed_error:.3%}, {rms:.2%}"
            bias = paired.format(**found["paired"][-1]) if "paired" in found else ""
            rows.append([path, name, absolute, bias, f"{found['equivalent_spp']:.0f}"])
    head = "parameters | statistics | bias against a converged image | bias, paired: mean, RMS over pixels | worth plain spp"
    text = "{resolution}², {spp} spp, {steps} steps, {runs} runs, `indirect-room`.".format(**record["settings"])
    return markdown.blocks(text, markdown.table(head, rows))


def plot(record: Record) -> figures.Figure:
    """Mean bias over the steps, by the order of updates, and against what it is measured."""
    panels = {
        path: {
            f"{method}, {how}": figures.band(
                *zip(*((r["step"], r["signed"], r["signed_error"]) for r in rows), strict=True)
            )
            for method, entry in found["methods"].items()
            for how, rows in entry.items()
            if how in ("converged", "paired")
        }
        for path, found in record["paths"].items()
    }
    return figures.curves(panels, "step", "mean bias over the mean of the image", log="", level=0.0)
