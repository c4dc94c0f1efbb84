"""What removes the heavy tails of the leave-one-out gradient, at equal samples: clipping, medians, uneven splits, a control variate.

A rare bright adjoint path meets a rare bright image. Gradients at the start of each problem, from several chains of steps in which the
parameters rest: the variance of a single step's gradient, of its mean over many steps (which tells what is only moved to later steps),
and how far the mean is from that of `PathGradient`, over what noise alone would make it: 1 where there is no bias. As a plain sum over
elements, and relative to each one's mean square, as Adam's steps see it. Then descents of equal steps, each method at the better of two
rates.

The methods are prototypes (prototypes.py): images that the loss derivative sees, its derivative, or the gradient's elements clipped at
a running quantile or mean square, what is cut off added later; medians over sample groups; samples divided unevenly between image and
adjoint; and the recursive control variate, alone and with weights or the gradient clipped.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

import unrender as ur
from benchmarks.adaptive.over_uniform.run import rough_box
from benchmarks.adaptive.tails.prototypes import (
    ClippedGradient,
    ClippedImages,
    ClippedWeights,
    MedianOfMeans,
    Recorded,
)
from benchmarks.internals import Key, element_scales
from benchmarks.races import total_error

PROBLEMS = ("ajar", "spiral", "indirect-room", "caustic", "glossy-room", "rough-box")
PLAIN = "as it is"
PARTS = ("variance", "descents")
MERGE = ("variance.*", "descents.*")
QUICK = {
    "problem": ("indirect-room",), "spp": (4,), "chains": 3, "warm": 5, "steps": 4, "descent_spp": (4,), "descent_steps": 6,
    "seeds": 1, "resolution": 12, "rates": (0.02,),
}  # fmt: skip


def methods(spp: int, recorded: bool = False) -> dict[str, Any]:
    """{name: estimator} of so many samples a pixel; with `recorded`, those that wrap the same estimator have the same estimates."""
    plain, control = ur.PathGradient(spp=spp), ur.PathGradient(ur.images.RecursiveControlVariate(), spp=spp)
    inner, controlled = (Recorded(plain), Recorded(control)) if recorded else (plain, control)
    found: dict[str, Any] = {
        PLAIN: inner,
        "images clipped": ClippedImages(spp),
        "weights clipped": ClippedWeights(spp),
        "gradient clipped": ClippedGradient(inner),
        "gradient clipped, rest dropped": ClippedGradient(inner, release=0.0),
        "rcv": controlled,
        "rcv, weights clipped": ClippedWeights(spp, ur.images.RecursiveControlVariate()),
        "rcv, gradient clipped": ClippedGradient(controlled),
    }
    if spp == 2:
        found["image and adjoint 1:1"] = ur.PathGradient(spp=1, adjoint_spp=1)
    else:
        found["median of means"] = MedianOfMeans(spp)
        found["image and adjoint 1:3"] = ur.PathGradient(spp=spp // 4, adjoint_spp=spp - spp // 4)
        found["image and adjoint 3:1"] = ur.PathGradient(spp=spp - spp // 4, adjoint_spp=spp // 4)
    return found


def made(name: str, resolution: int) -> ur.Problem:
    """A problem with a small film."""
    if name == "rough-box":
        return rough_box(256, resolution)
    return ur.gallery.problem(name, resolution=resolution, reference_spp=256)


def remembers(estimator: Any) -> bool:
    """Whether a step depends on those before it."""
    if isinstance(estimator, Recorded):
        return remembers(estimator.inner)
    if isinstance(estimator, ur.PathGradient):
        return not isinstance(estimator.image, ur.images.Plain)
    return not isinstance(estimator, MedianOfMeans)


def gradients(problem: ur.Problem, estimator: Any, chains: int, warm: int, steps: int) -> np.ndarray:
    """(chains, steps, n) gradients at the start, after `warm` steps that are left out; none are where nothing is remembered."""
    at, warm = problem.initial(), warm if remembers(estimator) else 0
    slopes = problem.coordinates.slopes(at)
    found = []
    for chain in range(chains):
        state, rows = estimator.init(problem, at), []
        for step in range(warm + steps):
            estimate, state = estimator.estimate(problem, at, state, Key(chain, step))
            if step >= warm:
                pulled = problem.coordinates.pull_back(estimate.gradient, slopes)
                rows.append(np.concatenate([np.array(g).ravel() for g in pulled.values()]))
        found.append(rows)
    return np.array(found, np.float64)


def judged(rows: np.ndarray, reference: np.ndarray, weights: np.ndarray) -> dict[str, Any]:
    """Of gradients (chains, steps, n) by weights (n,) of the elements.

    "step": the variance of a single step's, and its standard error over chains; "mean": of the mean of all steps, times their number;
    "distance": of the means from that of the reference (chains, steps, n), squared, over its expectation from their variances.
    """
    chains, steps, _ = rows.shape
    deviations = np.square(rows - rows.mean(axis=(0, 1))) @ weights * chains / (chains - 1)
    each = deviations.mean(axis=1)
    means, others = rows.mean(axis=1), reference.mean(axis=1)
    of_mean = float(means.var(axis=0, ddof=1) @ weights)
    noise = (of_mean + float(others.var(axis=0, ddof=1) @ weights)) / chains
    apart = float(np.square(means.mean(axis=0) - others.mean(axis=0)) @ weights)
    error = float(each.std(ddof=1) / np.sqrt(chains))
    return {"step": [float(each.mean()), error], "mean": of_mean * steps, "distance": apart / noise}


def variances(problem: ur.Problem, spp: tuple[int, ...], chains: int, warm: int, steps: int) -> dict[str, Any]:
    """{spp: {method: {"plain": …, "adam": …}}}; units of Adam from the gradients of all methods and numbers of samples together: from one
    method's own, elements whose rare gradients it has missed would weigh too much against the others.

    The reference of the distance is the plain estimator with the most samples, with seeds of its own.
    """
    found = {
        n: {name: gradients(problem, e, chains, warm, steps) for name, e in methods(n, recorded=True).items()}
        for n in spp
    }
    squares = np.mean([np.square(rows).mean(axis=(0, 1)) for of in found.values() for rows in of.values()], axis=0)
    units = {"plain": np.ones_like(squares), "adam": np.square(element_scales(problem.initial(), squares))}
    own = gradients(problem, ur.PathGradient(spp=max(16, *spp)), 2 * chains, 0, 2 * steps)[chains:]
    return {
        str(n): {
            name: {unit: judged(each, own, weights) for unit, weights in units.items()} for name, each in rows.items()
        }
        for n, rows in found.items()
    }


def descend(problem: ur.Problem, estimator: Any, rate: float, steps: int, seed: int) -> float:
    """The error over the last tenth of the steps, relative to the start."""
    result = ur.optimize(problem, estimator, ur.optimizers.Adam(learning_rate=rate), steps=steps, seed=seed)
    start = problem.parameter_error(problem.initial())
    errors = [total_error(h["parameter_error"], start) for h in result.history if "parameter_error" in h]
    return float(np.mean(errors[-max(1, steps // 10) :]))


def descents(
    problem: ur.Problem, spp: tuple[int, ...], steps: int, seeds: int, rates: tuple[float, ...]
) -> dict[str, Any]:
    """{spp: {method: {"rate": …, "errors": of the seeds}}}, at the rate of least mean error; "ends" of all rates."""
    found: dict[str, Any] = {}
    for number in spp:
        for name, estimator in methods(number).items():
            ends = {f"{r:g}": [descend(problem, estimator, r, steps, seed) for seed in range(seeds)] for r in rates}
            rate = min(ends, key=lambda r: float(np.mean(ends[r])))
            found.setdefault(str(number), {})[name] = {"rate": float(rate), "errors": ends[rate], "ends": ends}
    return found


def run(
    problem: tuple[str, ...] = PROBLEMS,
    part: tuple[str, ...] = PARTS,
    spp: tuple[int, ...] = (2, 4, 8, 16),
    chains: int = 6,
    warm: int = 8,
    steps: int = 8,
    descent_spp: tuple[int, ...] = (4,),
    descent_steps: int = 40,
    seeds: int = 3,
    rates: tuple[float, ...] = (0.01, 0.03),
    resolution: int = 24,
) -> Iterator[dict[str, Any]]:
    """A part per problem.

    Args:
        problem: of the gallery, or "rough-box"
        part: measured; the other's figures stay
        spp: samples per pixel of the variances
        chains: independent ones
        warm: steps of a chain before those that count
        steps: of a chain that count
        descent_spp: samples per pixel of the descents
        descent_steps: of a descent
        seeds: of a descent
        rates: of Adam, the better of which counts
        resolution: film size
    """
    for name in problem:
        opened = made(name, resolution)
        if "variance" in part:
            found = variances(opened, spp, chains, warm, steps)
            print(
                name,
                {n: {m: round(e["adam"]["step"][0], 4) for m, e in of.items()} for n, of in found.items()},
                flush=True,
            )
            yield {"variance": {name: found}}
        if "descents" in part:
            ends = descents(opened, descent_spp, descent_steps, seeds, rates)
            print(
                name,
                {n: {m: np.round(e["errors"], 3).tolist() for m, e in of.items()} for n, of in ends.items()},
                flush=True,
            )
            yield {"descents": {name: ends}}
