"""The pixel samplers that are compared, uniform, in proportion to the loss derivative, adaptive, and the variance of their gradients."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

import unrender as ur
from benchmarks.internals import Key, PixelSampler, Tree

SCHEMES: dict[str, Callable[..., PixelSampler]] = {
    "uniform": ur.pixels.Uniform,
    "loss": ur.pixels.LossProportional,
    "adaptive": ur.pixels.Adaptive,
}
PAPERS: dict[str, Any] = {"relative": False, "uniform": 0.1, "learn_from_draws": False, "by_cost": False}
"""Options of the paper's adaptive form, but for its levels."""


def pixels(scheme: str, count: int, **options: Any) -> PixelSampler:
    """The sampler of that name; options that a scheme does not have are left out."""
    known = {"uniform": {"stratified"}, "loss": {"stratified", "samples", "refresh", "uniform"}}.get(scheme)
    return SCHEMES[scheme](count, **{k: v for k, v in options.items() if known is None or k in known})


def gradients(
    problem: ur.Problem, estimator: ur.PathGradient, runs: int, seed: int = 0, at: Tree | None = None
) -> tuple[np.ndarray, int, dict[int, np.ndarray]]:
    """(runs, n) independent estimates at the start, or at given parameters, paths of one, and the pixel probabilities they used."""
    at = at or problem.initial()
    state = estimator.init(problem, at)
    first, state = estimator.estimate(problem, at, state, Key(2 * seed))
    rows, samples = [], 0
    for run in range(runs):
        found, state = estimator.estimate(problem, at, state, Key(2 * seed + 1, run))
        rows.append(np.concatenate([np.array(g).ravel() for g in found.gradient.values()]))
        samples = found.info["samples"]
    return np.array(rows), samples, first.info.get("pixel_probability", {})


def spread(rows: np.ndarray, weights: np.ndarray | float = 1.0, parts: int = 4) -> tuple[float, float]:
    """The weighted sum of the variances of the elements, and its standard error from so many parts of the rows."""

    def summed(part: np.ndarray) -> float:
        return float((np.var(part, axis=0, ddof=1, dtype=np.float64) * weights).sum())

    return summed(rows), float(np.std([summed(part) for part in np.array_split(rows, parts)], ddof=1) / np.sqrt(parts))
