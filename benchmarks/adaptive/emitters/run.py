"""Variance of the gradient with emitters by its variance, and by their power, over that with uniform ones.

Adam descends with `PathGradient(emitters="adaptive")` from the start of each problem. At some steps the parameters and the probabilities
are kept; then the variance of the gradient with these, and with probabilities in proportion to the emitters' power, is divided by that with
uniform ones, at as many paths: twice, summed over all elements as it is ("plain"), and relative to each element's mean square, which is
what Adam's steps see. Standard errors are from eighths of the gradients. Then what steps cost, in processor time on one thread: gradients
alone, with probabilities as tables over Mitsuba's own uniform draws; and descents, with all that is learnt on the way.

Four scenes made here, with walls between lights, and four problems of the gallery.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

import unrender as ur
from benchmarks.adaptive.emitters import scenes
from benchmarks.adaptive.over_uniform.run import Kept, spread
from benchmarks.internals import Key, Tree, dr, element_scales, gradient_of

STEPS = (1, 20, 60)
"""At which the variance is measured: those done before."""
MERGE = ("problems.*",)
QUICK = {
    "problem": ("cells-8",),
    "runs": 16,
    "spp": 2,
    "resolution": 12,
    "reference_spp": 4,
    "cost_steps": 4,
}


def rows(problem: ur.Problem, at: Tree, emitters: np.ndarray | None, settings: dict[str, int], seed: int) -> np.ndarray:
    """(runs, n) independent gradients with these probabilities."""
    found = []
    for run in range(settings["runs"]):
        gradient = gradient_of(problem, at, None, Key(seed, run), settings["spp"], emitters)
        found.append(np.concatenate([np.ravel(part) for part in gradient]))
    return np.array(found, np.float32)


def point(problem: ur.Problem, at: Tree, state: Any, settings: dict[str, int], step: int) -> dict[str, Any]:
    """Ratios at one step, {contender: [[plain, relative], [standard error of each]]}."""
    likely = state.emitters.probabilities
    contenders = {"uniform": None, "power": scenes.powers(problem), "adaptive": likely}
    found = {
        name: rows(problem, at, emitters, settings, 10 * step + index)
        for index, (name, emitters) in enumerate(contenders.items())
    }
    scales = element_scales(at, np.square(np.concatenate(list(found.values()))).mean(axis=0, dtype=np.float64))
    result: dict[str, Any] = {"step": step, "uniform": state.emitters.uniform, "probabilities": likely.tolist()}
    for name in ("power", "adaptive"):
        ratios = []
        for weights in (np.ones_like(scales), np.square(scales)):
            (a, error_a), (u, error_u) = spread(found[name], weights), spread(found["uniform"], weights)
            ratios.append([a / u, a / u * float(np.hypot(error_a, error_u))])
        result[name] = np.transpose(ratios).tolist()
    return result


def costs(problem: ur.Problem, spp: int, steps: int) -> dict[str, float]:
    """Processor time over that of uniform draws, on one thread, in alternation: "gradient" with tables, "descent" with what is learnt."""
    at = problem.initial()
    start = np.full(len(scenes.powers(problem)), 1.0)
    start /= start.sum()
    spent = {name: [] for name in ("uniform", "tables", "scene", "adaptive")}
    estimators = {name: ur.PathGradient(spp=spp, emitters=name) for name in ("scene", "adaptive")}  # pyright: ignore[reportArgumentType]
    states = {name: estimator.init(problem, at) for name, estimator in estimators.items()}

    def timed(name: str, work: Callable[[], Any]) -> Any:
        began = time.process_time()
        found = work()
        spent[name].append(time.process_time() - began)
        return found

    threads = dr.thread_count()
    dr.set_thread_count(1)
    for step in range(-8, steps):  # with what each twentieth step learns
        if step == 0:
            spent = {name: [] for name in spent}
        key = Key(7, step + 8)
        timed("uniform", lambda key=key: gradient_of(problem, at, None, key, spp))
        timed("tables", lambda key=key: gradient_of(problem, at, None, key, spp, start))
        for name, estimator in estimators.items():
            _, states[name] = timed(name, lambda e=estimator, n=name, k=key: _step(e, problem, at, states[n], k))
    dr.set_thread_count(threads)
    total = {name: float(np.sum(each)) for name, each in spent.items()}
    return {"gradient": total["tables"] / total["uniform"], "descent": total["adaptive"] / total["scene"]}


def _step(estimator: ur.PathGradient, problem: ur.Problem, at: Tree, state: Any, key: Key) -> Any:
    found, state = estimator.estimate(problem, at, state, key)
    for value in found.gradient.values():
        np.array(value)
    return found, state


def summarize(record: dict[str, Any]) -> dict[str, Any]:
    """Geometric means over the problems at the last step, and the worst ratio of any step: [plain, relative]."""
    found = {}
    for name in ("power", "adaptive"):
        entries = [entry["points"] for entry in record["problems"].values()]
        last = np.array([points[-1][name][0] for points in entries])
        every = [point[name] for points in entries for point in points]
        worst = [max((ratio[n], error[n]) for ratio, error in every) for n in range(2)]
        found[name] = {"problems": len(entries), "mean": np.exp(np.log(last).mean(axis=0)).tolist(), "worst": worst}
    return {"summary": found}


def run(
    problem: tuple[str, ...] = (*scenes.OWN, *scenes.GALLERY),
    runs: int = 96,
    spp: int = 4,
    resolution: int = 48,
    reference_spp: int = 2048,
    cost_steps: int = 40,
    seed: int = 0,
) -> Iterator[dict[str, Any]]:
    """A part per problem.

    Args:
        problem: of those made here, or of the gallery
        runs: gradients of each variance
        spp: samples per pixel
        resolution: of the scenes made here
        reference_spp: of references
        cost_steps: gradients and steps whose cost is measured
        seed: of the descents
    """
    settings = {"runs": runs, "spp": spp}
    for name in problem:
        opened = scenes.problem(name, resolution, reference_spp)
        kept = Kept(ur.PathGradient(spp=spp, emitters="adaptive"), STEPS)
        ur.optimize(opened, kept, ur.optimizers.Adam(0.02), steps=STEPS[-1] + 1, seed=seed)
        points = [point(opened, at, state, settings, step) for step, (at, state) in sorted(kept.before.items())]
        shown = [
            f"{at['step']}: {at['adaptive'][0][0]:.2f} / {at['adaptive'][0][1]:.2f} ± {at['adaptive'][1][1]:.2f}"
            f" (power {at['power'][0][0]:.2f} / {at['power'][0][1]:.2f})"
            for at in points
        ]
        cost = costs(opened, spp, cost_steps)
        print(f"{name}: {', '.join(shown)}; cost {cost}", flush=True)
        yield {"problems": {name: {"emitters": len(scenes.powers(opened)), "points": points, "cost": cost}}}
