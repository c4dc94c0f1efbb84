"""All four methods at once: every combination of the ingredients, at equal time.

The ingredients: a memory of images (recursive control variates), a memory of gradients (coupled meta-estimation), samples where
the gradient's variance is, and, where there is a pose, perturbed renders for that alone (`HybridGradient`); without, it has path
gradients like the textures. The third is mini-batches of pixels (`Adaptive()`) or, with a memory of images, which learns from whole
views, numbers of samples (`AdaptiveCounts`, three a pixel on average, its least). Sixteen combinations where there is a pose, eight
elsewhere. Memories forget after some 20 steps (images) and 5 (gradients). Otherwise two samples a pixel; primary space where there is a
pose, else path space. Adam, or MetaAdam with a memory of gradients; the learning rate of each combination is tuned on a seed of its own
at the whole budget; that of a pose is a tenth of the smoothing's width. The budget is of processor time, of all threads of the process,
which other work on the machine changes little, twice as much where there is a pose. The error is each parameter's RMSE relative to where
it began, averaged over parameters, at the end of the budget: median over seeds.

Poses: the angle of `mug` with an unknown label; the place of the pot in `ajar`, beside its three textures, in light that comes
round a corner; with assets, the place of the published tray beside its base colour.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

import unrender as ur
from benchmarks.internals import Estimator
from benchmarks.races import TUNING_SEED, Entrant, median_and_range, search, total_error
from benchmarks.runner.timing import work_time
from benchmarks.suite.scenes import problem as foreign_problem

INGREDIENTS = ("images", "gradients", "pixels", "perturbed")
"""Their names, in the order of a combination's letters."""
GALLERY: dict[str, tuple[str, dict[str, Any]]] = {
    "mug, label": ("mug", {"label": 16}),
    "ajar, pot": ("ajar", {"resolution": 48}),
    "indirect-room": ("indirect-room", {"resolution": 48, "texture_resolution": 32}),
    "caustic": ("caustic", {}),
    "plain-and-textured": ("plain-and-textured", {}),
    "sun-glossy": ("sun-glossy", {"resolution": 48, "texture_resolution": 32}),
}
"""Problem and its options."""
TRAY = "tray, moved"
POSES: dict[str, dict[str, float]] = {
    "ajar, pot": {"pot.translation.x": 0.15, "pot.translation.z": -0.1},
    TRAY: {"tray.translation.x": 0.8, "tray.translation.z": -0.6},
}
"""Unknown coordinates that are added, and where they start; 0 in truth."""
SIGMA = {"mug, label": 0.6, "ajar, pot": 0.1, TRAY: 0.3}
"""Width of the smoothing where there is a pose."""
POSE_RATE, POSE_TIME = 0.1, 2.0
"""Learning rate of a pose as a share of its sigma; the budget where there is one, over that of the others."""
RATES, META_RATES = (0.01, 0.02), (0.002, 0.004)
SPP, COUNTED_SPP, SAMPLES = 2, 3, 8
IMAGE_MEMORY, GRADIENT_MEMORY = 0.95, 0.8
"""Greatest weights of the past: some 20 and 5 steps."""
MERGE = ("problems.*.methods",)
QUICK = {
    "problem": ("mug, label", "caustic"),
    "seconds": 0.3,
    "seeds": 1,
    "resolution": 16,
    "gallery_reference_spp": 4,
    "only": ("none", "igx", "igxp"),
}


def opened(name: str, resolution: int | None, reference_spp: int | None, assets: Path | None) -> ur.Problem:
    """The problem of that name; of the tray where assets are given."""
    if name == TRAY:
        if assets is None:
            raise ur.InputError(f"{TRAY}: give --assets, the folder of the scenes of others")
        found = foreign_problem("tray, L2", assets, resolution or 64, 32, reference_spp or 1024)
    else:
        problem, options = GALLERY[name]
        given = {"resolution": resolution, "reference_spp": reference_spp}
        found = ur.gallery.problem(problem, **options | {key: x for key, x in given.items() if x is not None})
    if name not in POSES:
        return found
    poses = POSES[name]
    return found.replaced(
        parameters=[*found.parameters, *(ur.Parameter(key, initial=start) for key, start in poses.items())],
        truth={**found.truth, **dict.fromkeys(poses, 0.0)},
    )


def pose_keys(problem: ur.Problem) -> tuple[str, ...]:
    """The unknown poses."""
    known = problem.renderer.parameters()
    return tuple(key for key in problem.shapes() if known[key].rigid)


def label(combination: tuple[bool, ...]) -> str:
    """A letter for each ingredient: i, g, x and p; "" for none."""
    return "".join(letter for letter, on in zip("igxp", combination, strict=True) if on)


def estimator(problem: ur.Problem, combination: tuple[bool, ...], sigma: float) -> Estimator:
    """Of a combination of ingredients."""
    images, gradients, pixels, perturbed = combination
    poses = pose_keys(problem)
    image = ur.images.Plain()
    if images:
        image = ur.images.RecursiveControlVariate("primary" if poses else "path", max_weight=IMAGE_MEMORY)
    sampler, spp = ur.pixels.All(), SPP
    if pixels:
        sampler, spp = (ur.pixels.AdaptiveCounts(), COUNTED_SPP) if images else (ur.pixels.Adaptive(), SPP)
    path: Any = ur.PathGradient(image, sampler, spp)
    if gradients:
        path = ur.MetaEstimator(coupled=True, spp=spp, image=image, pixels=sampler, max_weight=GRADIENT_MEMORY)
    if not perturbed:
        return path
    annealed = ur.schedules.Exponential(25, 0.1)
    smoothed = ur.SmoothedDerivatives(sigma, SAMPLES, spp=SPP, schedule=annealed, debiased=True)
    return ur.estimators.HybridGradient(path, smoothed, poses, averaged=gradients)


def entrants(problem: ur.Problem, name: str, only: tuple[str, ...] | None) -> list[Entrant]:
    """All combinations that the problem has."""
    poses, found = pose_keys(problem), []
    sigma = SIGMA.get(name, 0.1)
    for combination in itertools.product((False, True), repeat=4):
        named = label(combination)
        if (combination[3] and not poses) or (only and (named or "none") not in only):
            continue
        kind = ur.optimizers.MetaAdam if combination[1] else ur.optimizers.Adam

        def optimizer(rate: float, kind: Any = kind) -> Any:
            return kind({"*": rate, **dict.fromkeys(poses, POSE_RATE * sigma)})

        rates = META_RATES if combination[1] else RATES
        found.append(Entrant(named or "none", named, estimator(problem, combination, sigma), optimizer, rates))
    return found


class ProcessorBudget(ur.protocols.Callback):
    """Ends a run after so many seconds of the process; its own time is not the run's.

    Args:
        seconds: the budget.

    Attributes:
        spent: seconds so far.
        steps: made in them.
    """

    def __init__(self, seconds: float):
        self.seconds, self.spent, self.steps, self._mark = seconds, 0.0, 0, 0.0

    def on_start(self, run: Any) -> None:
        """See `Callback.on_start`."""
        self._mark = work_time()

    def on_step(self, run: Any, record: dict[str, Any]) -> None:
        """See `Callback.on_step`."""
        self.spent += work_time() - self._mark
        self.steps = run.step
        if self.spent >= self.seconds:
            run.stop("budget")
        self._mark = work_time()


def descend(problem: ur.Problem, entrant: Entrant, rate: float, seed: int, seconds: float) -> tuple[float, int]:
    """The error at the end of the budget, and the steps made in it."""
    budget = ProcessorBudget(seconds)
    optimizer = entrant.optimizer(rate)
    result = ur.optimize(problem, entrant.estimator, optimizer, steps=1 << 20, seed=seed, callbacks=[budget])
    error = total_error(problem.parameter_error(result.parameters), problem.parameter_error(problem.initial()))
    return error, budget.steps


def race(problem: ur.Problem, entrants: list[Entrant], seeds: int, seconds: float) -> dict[str, Any]:
    """Every entrant, tuned, over seeds 0, 1, ..., in turns."""
    found: dict[str, Any] = {}
    for entrant in entrants:

        def error(rate: float, entrant: Entrant = entrant) -> float:
            final, _ = descend(problem, entrant, rate, TUNING_SEED, seconds)
            print(f"{problem.name} {entrant.name} rate {rate:g}: {final:.4f}", flush=True)
            return final

        rate, tried = search(entrant.rates, error)
        found[entrant.name] = {"rate": rate, "tried": tried, "errors": [], "steps": []}
    for seed in range(seeds):
        for entrant in entrants:
            entry = found[entrant.name]
            final, steps = descend(problem, entrant, entry["rate"], seed, seconds)
            entry["errors"].append(final)
            entry["steps"].append(steps)
            print(f"{problem.name} {entrant.name} seed {seed}: {final:.4f} after {steps} steps", flush=True)
    return {name: {**entry, "final": median_and_range(entry["errors"])} for name, entry in found.items()}


def summarize(record: dict[str, Any]) -> dict[str, Any]:
    """Per problem: the error of the whole over that of the best single ingredient, and of the best combination that lacks one or more."""
    found: dict[str, Any] = {}
    for name, entry in record["problems"].items():
        errors = {label: method["final"][0] for label, method in entry["methods"].items()}
        whole = "igxp" if any("p" in label for label in errors) else "igx"
        rest = {label: error for label, error in errors.items() if label != whole}
        single = {label: error for label, error in rest.items() if len(label) == 1}
        if whole not in errors or not rest:
            continue
        best = min(rest, key=rest.__getitem__)
        found[name] = {"whole": whole, "error": errors[whole], "best": best, "over best": errors[whole] / rest[best]}
        if single:
            part = min(single, key=single.__getitem__)
            found[name] |= {"part": part, "over part": errors[whole] / single[part]}
        if "none" in errors:
            found[name]["over none"] = errors[whole] / errors["none"]
    ratios = [entry["over best"] for entry in found.values()]
    return {"summary": found, "mean": float(np.exp(np.mean(np.log(ratios)))) if ratios else None}


def run(
    problem: tuple[str, ...] = (*GALLERY, TRAY),
    assets: Path | None = None,
    seconds: float = 12.0,
    seeds: int = 3,
    only: tuple[str, ...] = (),
    resolution: int | None = None,
    gallery_reference_spp: int | None = None,
) -> Iterator[dict[str, Any]]:
    """A part per problem.

    Args:
        problem: of the gallery, some with an unknown pose; the tray where assets are given
        assets: folder of the scenes of others
        seconds: budget of every run, of the processor; twice that where there is a pose
        seeds: of the races
        only: combinations of i (images), g (gradients), x (pixels) and p (perturbed); none for all
        resolution: film size, none for the problem's own
        gallery_reference_spp: of the references, none for their own
    """
    for name in problem:
        if name == TRAY and assets is None:
            print(f"{TRAY}: left out, without assets", flush=True)
            continue
        made = opened(name, resolution, gallery_reference_spp, assets)
        budget = seconds * (POSE_TIME if pose_keys(made) else 1.0)
        methods = race(made, entrants(made, name, only), seeds, budget)
        yield {"problems": {name: {"poses": list(pose_keys(made)), "seconds": budget, "methods": methods}}}
