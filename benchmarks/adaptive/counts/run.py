"""More samples in the pixels where the gradient's variance is, with and without a control variate.

`--part variance`: Adam descends with adaptive numbers of samples. At some steps the parameters and the state, with what
images it remembers, are kept; then the variance of many gradients from them, summed over all elements, is compared with
that of as many with equal numbers, as many samples in all: plain, and relative to each element's mean square, which is
what Adam's steps see. The cost of a path is counted: 1 + v / 2 for v vertices. None of this depends on the machine's load.

`--part race`: descents with a control variate, equal and adaptive numbers at several samples per pixel, the learning
rate of each tuned on a seed of its own, all with as many paths; the error along them by the processor time of a path,
which is measured in turns afterwards (of all threads, so that other work on the machine matters little).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

import unrender as ur
from benchmarks.adaptive.over_uniform.run import FOREIGN, GALLERY, Kept, rough_box, spread
from benchmarks.internals import Key, element_scales
from benchmarks.races import Entrant, Runs, over, race, reached, tenths
from benchmarks.runner.timing import work_time
from benchmarks.suite.scenes import problem as foreign_problem

RACED: dict[str, dict[str, Any]] = {
    "caustic": {},
    "mirror-trio": {},
    "indirect-room": {"resolution": 64},
}
IMAGES = {"plain": ur.images.Plain, "rcv": ur.images.RecursiveControlVariate}
EQUAL, ADAPTIVE = (2, 4, 8), (4, 8)
"""Samples per pixel that race."""
RATES = (0.01, 0.03)
MERGE = ("variance.*", "races.*", "seconds_per_path.*")
QUICK = {
    "problem": ("mirror-trio",),
    "spp": 4,
    "at": (5,),
    "runs": 16,
    "paths": 1 << 16,
    "seeds": 1,
    "rounds": 2,
    "gallery_reference_spp": 4,
}


def rows(problem: ur.Problem, kept: Kept, step: int, runs: int, equal: bool) -> np.ndarray:
    """(runs, n) gradients of a state that was kept, in the coordinates of the descent; with equal numbers of samples or its own."""
    at, state = kept.before[step]
    if equal:
        state = replace(state, pixels=replace(state.pixels, uniform=1.0))
    found = []
    for run in range(runs):
        estimate, _ = kept.inner.estimate(problem, at, state, Key(step + 1, run))
        pulled = problem.coordinates.pull_back(estimate.gradient, problem.coordinates.slopes(at))
        found.append(np.concatenate([np.array(g).ravel() for g in pulled.values()]))
    return np.array(found, np.float32)


def cost(problem: ur.Problem, sampler: ur.pixels.AdaptiveCounts, state: Any, spp: int) -> float:
    """What a step's paths cost, by their counted vertices, over as many with equal numbers."""
    from unrender.scene.sample_counts import rounded

    shares = sampler.redraw(problem, state, Key(0)).shares
    if shares is None or len(state.costs) != problem.pixels:
        return float("nan")
    numbers = np.concatenate([rounded(part, spp, shares.least, 0.5).ravel() for part in shares.shares])
    return float(numbers @ state.costs / (spp * state.costs.sum()))


def variances(
    problem: ur.Problem, image: str, spp: int, steps: tuple[int, ...], runs: int, seed: int
) -> list[dict[str, Any]]:
    """At each step: ratios of variances [plain, relative] with their errors, and of the cost."""
    sampler = ur.pixels.AdaptiveCounts()
    kept = Kept(ur.PathGradient(IMAGES[image](), sampler, spp=spp), steps)
    ur.optimize(problem, kept, ur.optimizers.Adam(0.01), steps=max(steps) + 1, seed=seed)
    found = []
    for step in steps:
        both = {name: rows(problem, kept, step, runs, name == "equal") for name in ("equal", "adaptive")}
        at, state = kept.before[step]
        scales = element_scales(at, np.square(np.concatenate(list(both.values()))).mean(axis=0, dtype=np.float64))
        point: dict[str, Any] = {"step": step, "uniform": state.pixels.uniform, "ratio": [], "error": []}
        for weights in (np.ones(len(scales)), np.square(scales)):
            (a, error_a), (e, error_e) = spread(both["adaptive"], weights), spread(both["equal"], weights)
            point["ratio"].append(a / e)
            point["error"].append(a / e * float(np.hypot(error_a, error_e)))
        point["cost"] = cost(problem, sampler, state.pixels, spp)
        found.append(point)
    return found


def entrants() -> list[Entrant]:
    """Who races, all with a control variate."""
    image, counts = ur.images.RecursiveControlVariate(), ur.pixels.AdaptiveCounts()
    made = [(f"equal {spp}", ur.PathGradient(image, spp=spp)) for spp in EQUAL]
    made += [(f"adaptive {spp}", ur.PathGradient(image, counts, spp=spp)) for spp in ADAPTIVE]
    return [Entrant(name, name.split()[0], estimator, ur.optimizers.Adam, RATES) for name, estimator in made]


def seconds_per_path(problem: ur.Problem, chosen: list[Entrant], rounds: int, steps: int = 30) -> dict[str, float]:
    """Processor seconds of all threads per path of short descents, in turns: medians."""

    class Clock(ur.protocols.Callback):
        def __init__(self) -> None:
            self.points: list[tuple[float, float]] = []

        def on_step(self, run: Any, record: dict[str, Any]) -> None:
            self.points.append((work_time(), float(record["samples"])))

    found: dict[str, list[float]] = {entrant.name: [] for entrant in chosen}
    for turn in range(rounds + 1):
        for entrant in chosen:
            clock = Clock()
            optimizer = entrant.optimizer(RATES[0])
            ur.optimize(problem, entrant.estimator, optimizer, steps=steps, seed=turn, callbacks=[clock])
            (began, before), (ended, after) = clock.points[steps // 3 - 1], clock.points[-1]
            found[entrant.name].append((ended - began) / (after - before))
    return {name: float(np.median(times[1:])) for name, times in found.items()}  # the first turn compiles


def raced(problem: ur.Problem, paths: int, seeds: int, tuning_seeds: int) -> dict[str, Any]:
    """Each entrant, tuned by itself for as many paths as all."""
    found: dict[str, Any] = {}
    for entrant in entrants():
        steps = max(4, paths // (problem.pixels * int(entrant.name.split()[1])))
        found |= race(problem, [entrant], seeds, tuning_seeds, steps=steps)
    return {name: {**entry, "runs": [thinned(run) for run in entry["runs"]]} for name, entry in found.items()}


def thinned(run: list[Any]) -> list[Any]:
    """Some sixty points of a run, the last among them, which is all that tables tell."""
    kept = run[:: max(1, len(run) // 60)]
    return kept if kept[-1] is run[-1] else [*kept, run[-1]]


def timed(methods: dict[str, Any], seconds: dict[str, float]) -> Runs:
    """The runs, with their seconds as so many paths take."""
    return {
        name: [[(samples * seconds[name], samples, error) for _, samples, error in run] for run in entry["runs"]]
        for name, entry in methods.items()
    }


def summarize(record: dict[str, Any]) -> dict[str, Any]:
    """Of the variances geometric means at the last step; of the races errors at equal time, and the time to the best equal error."""
    found: dict[str, Any] = {"summary": {}, "equal_time": {}}
    for image in IMAGES:
        last = np.array([entry[image][-1]["ratio"] for entry in record.get("variance", {}).values() if image in entry])
        if len(last):
            found["summary"][image] = {"problems": len(last), "mean": np.exp(np.log(last).mean(axis=0)).tolist()}
    for name, methods in record.get("races", {}).items():
        if name not in record.get("seconds_per_path", {}):
            continue
        runs = timed(methods, record["seconds_per_path"][name])
        errors = tenths(runs, 0)
        equal = min((e for e in runs if e.startswith("equal")), key=lambda e: errors[e][-1])
        level, end = errors[equal][-1], min(run[-1][0] for every in runs.values() for run in every)
        first = {method: reached(every, level, 0) for method, every in runs.items()}
        found["equal_time"][name] = {
            "errors": errors,
            "best equal": equal,
            "over it": over(runs, equal)["time"],
            "time": {method: None if at is None else at / end for method, at in first.items()},
        }
    return found


def opened(name: str, assets: Path | None, options: dict[str, Any]) -> ur.Problem:
    """A problem by name."""
    if name in FOREIGN and assets is not None:
        return foreign_problem(name, assets, 64, 64, 1024)
    if name == "rough-box":
        return rough_box(**options)
    return ur.gallery.problem(name, **{**GALLERY.get(name, {}), **options})


def run(
    problem: tuple[str, ...] = tuple(GALLERY),
    assets: Path | None = None,
    foreign: tuple[str, ...] = FOREIGN,
    part: tuple[str, ...] = ("variance", "race"),
    image: tuple[str, ...] = tuple(IMAGES),
    spp: int = 4,
    at: tuple[int, ...] = (5, 61),
    runs: int = 64,
    paths: int = 6 << 20,
    seeds: int = 3,
    tuning_seeds: int = 1,
    rounds: int = 3,
    gallery_reference_spp: int | None = None,
) -> Iterator[dict[str, Any]]:
    """A part per problem.

    Args:
        problem: of the gallery, and "rough-box"
        assets: folder of the scenes of others
        foreign: of others, where assets are given
        part: measured; the other's figures stay
        image: with what images the variance is measured
        spp: samples per pixel of the variances
        at: steps at which it is measured
        runs: gradients of each variance
        paths: of each run of a race
        seeds: of the races
        tuning_seeds: that the rates are tuned on
        rounds: of turns of the processor time
        gallery_reference_spp: of the gallery's references, none for its own
    """
    options = {} if gallery_reference_spp is None else {"reference_spp": gallery_reference_spp}
    for name in (*problem, *(foreign if assets is not None else ())):
        made, found = opened(name, assets, options), {}
        if "variance" in part:
            points = {each: variances(made, each, spp, at, runs, 0) for each in image}
            found["variance"] = {name: points}
            for each, along in points.items():
                shown = [f"{p['step']}: {p['ratio'][0]:.2f} {p['ratio'][1]:.2f} ± {p['error'][1]:.2f}" for p in along]
                print(f"{name}, {each}: {', '.join(shown)}; cost {along[-1]['cost']:.2f}", flush=True)
        if "race" in part and name in RACED:
            found["races"] = {name: raced(made, paths, seeds, tuning_seeds)}
            found["seconds_per_path"] = {name: seconds_per_path(made, entrants(), rounds)}
        if found:
            yield found
