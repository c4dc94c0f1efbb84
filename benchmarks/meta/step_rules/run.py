"""Rules of the step for a meta-estimate on a linear model of `spiral` (Meta Eq. 21): MetaAdam's two beside Adam, without rendering.

The model's gradient is H (x - truth) plus normal noise, its differences H Δ plus normal noise in proportion to the step: H and
both noises are those of plain gradients at 2 samples per pixel and of differences at 1, measured at the truth of `spiral` at
32² and divided by 4 for 64². Rates fall along half a cosine; each is the best of its grid, by the median error of all trials.
Adam also gets 16 samples per pixel in a quarter of the steps, whose variance there is 1/119 of that at 2: equal paths or, with
the differences, equal time. Beside it: how far each rule moves an element whose gradient is noise alone, in learning rates.
"""

from __future__ import annotations

from typing import Any

import numpy as np

import unrender as ur
from benchmarks.internals import Estimate, Optimizer
from unrender.protocols import PastWeight, Variance
from unrender.schedules import Constant, Cosine, Schedule
from unrender.statistics import meta

RENDERS = False
START = np.array([-0.35, 0.08, 0.3, -0.5, 0.3])
PARTS = (slice(0, 3), slice(3, 4), slice(4, 5))
"""Colour, metalness, roughness."""
H = np.array([
    [0.574, 0.0, 0.0, -0.421, 0.016], [0.0, 1.415, 0.0, -0.566, 0.148], [0.0, 0.0, 3.084, -0.54, 0.12],
    [-0.421, -0.566, -0.54, 1.285, -0.593], [0.016, 0.148, 0.12, -0.593, 1.177],
])  # fmt: skip
NOISE = np.array([
    [0.115, 0.096, 0.065, -0.425, 0.138], [0.096, 0.156, 0.132, -0.45, 0.174], [0.065, 0.132, 0.146, -0.309, 0.097],
    [-0.425, -0.45, -0.309, 2.365, -0.75], [0.138, 0.174, 0.097, -0.75, 3.953],
]) / 4  # fmt: skip
DIFFERENCE = np.array([1.247, 1.608, 2.571, 3.267, 19.568]) / 2
"""Deviation of a difference over the length of its step."""
AT_16 = 1 / 119
FLOOR = 0.02
ADAM_RATES, META_RATES = (0.003, 0.01, 0.03, 0.1), (0.0003, 0.001, 0.003, 0.01)
QUICK = {"steps": 20, "trials": 4, "wander_steps": 10}


def descend(optimizer: Optimizer, steps: int, trials: int, variance: float, memory: bool) -> np.ndarray:
    """(5, trials): each trial's error at the fifths of a descent, relative to the start."""
    rng, root = np.random.default_rng(0), np.linalg.cholesky(NOISE * variance)
    x = np.tile(START, (trials, 1))
    state, taken, previous, errors = meta.init(x), optimizer.init({"x": x}, None), x, []
    for step in range(steps):
        F, moved = x @ H + rng.normal(size=x.shape) @ root.T, x - previous
        length = np.linalg.norm(moved, axis=1, keepdims=True)
        estimate = Estimate(0.0, {"x": F})
        if memory:
            change = moved @ H + rng.normal(size=x.shape) * DIFFERENCE * length
            gradient, spread, alpha, state = meta.update(state, F, change, length, beta_proportional=0.999)
            estimate = Estimate(0.0, {"x": gradient}, (Variance({"x": spread}), PastWeight({"x": alpha})))
        previous = x
        change_of_x, taken = optimizer.update(estimate, taken, {"x": x})
        x = x + change_of_x["x"]
        if (step + 1) * 5 // steps > step * 5 // steps:
            parts = [np.sqrt(np.mean(x[:, p] ** 2, 1) / np.mean(START[p] ** 2)) for p in PARTS]
            errors.append(np.mean(parts, axis=0))
    return np.array(errors)


def wander(optimizer: Optimizer, steps: int, trials: int, memory: bool) -> float:
    """The deviation of the way that noise moves an element, in learning rates of 1."""
    rng, x = np.random.default_rng(1), np.zeros(trials)
    state, taken = meta.init(x), optimizer.init({"x": x}, None)
    for _ in range(steps):
        F = rng.choice([-1.0, 1.0], trials)
        estimate = Estimate(0.0, {"x": F})
        if memory:
            gradient, spread, alpha, state = meta.update(state, F, 0.0 * F, 0.1)
            estimate = Estimate(0.0, {"x": gradient}, (Variance({"x": spread}), PastWeight({"x": alpha})))
        change, taken = optimizer.update(estimate, taken, {"x": x})
        x = x + change["x"]
    return float(x.std())


def made(name: str, rate: float, schedule: Schedule) -> Optimizer:
    """The optimizer of a rule."""
    if name.startswith("Adam"):
        return ur.optimizers.Adam(rate, schedule=schedule)
    return ur.optimizers.MetaAdam(rate, schedule=schedule, rule="walk" if name.endswith("walk") else "deviation")


def run(steps: int = 3000, trials: int = 64, wander_steps: int = 300) -> dict[str, Any]:
    """All rules.

    Args:
        steps: of a descent
        trials: descents of the same model
        wander_steps: of elements in noise
    """
    racing = {
        "Adam, 2 spp": (steps, 1.0, ADAM_RATES),
        "Adam, 16 spp": (steps // 4, AT_16, ADAM_RATES),
        "meta, deviation": (steps, 1.0, META_RATES),
        "meta, walk": (steps, 1.0, ADAM_RATES),
    }
    methods: dict[str, Any] = {}
    for name, (count, variance, rates) in racing.items():
        memory, tried = name.startswith("meta"), {}
        for rate in rates:
            errors = descend(made(name, rate, Cosine(count, FLOOR)), count, trials, variance, memory)
            tried[rate] = np.quantile(errors, [0.25, 0.5, 0.75], axis=1).T.tolist()
        rate = min(tried, key=lambda r: tried[r][-1][1])
        methods[name] = {
            "steps": count,
            "rate": rate,
            "errors": tried[rate],
            "tried": [[r, e[-1][1]] for r, e in tried.items()],
        }
        print(name, rate, [round(e[1], 3) for e in tried[rate]], flush=True)
    walks = {
        name: wander(made(name, 1.0, Constant()), wander_steps, 4096, name.startswith("meta"))
        for name in ("Adam, 2 spp", "meta, deviation", "meta, walk")
    }
    return {"methods": methods, "wander": walks}
