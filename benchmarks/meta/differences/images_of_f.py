"""ΔF with loss derivatives at images of its own and at F's: a step's cost, the variance of the meta-estimate, and errors of descents."""

from __future__ import annotations

import functools
from typing import Any

import numpy as np

import unrender as ur
from benchmarks.internals import Key, Tree, arrays, dr
from benchmarks.paths import straight
from benchmarks.races import median_and_range, total_error
from benchmarks.runner.timing import medians, turns, work_time
from unrender.schedules import Cosine

OPTIONS: dict[str, dict[str, Any]] = {"spiral": {}, "chalice": {"texture_resolution": 32}}
RATES = {"spiral": 0.003, "chalice": 0.0015}
FLOOR = 0.02
PATH_STEPS, WHOLE_PATH = 16, 51
"""Of the fixed path on which variances are measured: its points, and those of the whole way from the start to the truth."""
REPEATS = 24
FORMS = {
    "own": ur.MetaEstimator(),
    "F's": ur.MetaEstimator(difference_images="proportional"),
    "own, 12 + 4": ur.MetaEstimator(4, 12),
    "F's, 12 + 4": ur.MetaEstimator(4, 12, difference_images="proportional"),
}
"""By the images; 1 + 2 samples, difference and proportional, unless others are given. Of those with others only the cost is measured."""


def path(problem: ur.Problem) -> list[Tree]:
    """Parameters on the way from the start to the truth."""
    return straight(problem, WHOLE_PATH)[:PATH_STEPS]


def costs(problem: ur.Problem) -> dict[str, float]:
    """Processor milliseconds of a step of each form, taken in turns."""
    states = {name: form.init(problem, problem.initial()) for name, form in FORMS.items()}
    points = path(problem)

    def step(name: str, n: int) -> None:
        # A new array per step, as in a descent, so that the scenes are updated.
        parameters = {key: x * 1.0 for key, x in points[n % PATH_STEPS].items()}
        states[name] = FORMS[name].estimate(problem, parameters, states[name], Key(0, n))[1]

    steps = {name: functools.partial(step, name) for name in FORMS}
    return medians(turns(steps, repeats=REPEATS, clock=work_time))


def variances(problem: ur.Problem, form: ur.MetaEstimator, runs: int) -> dict[str, Any]:
    """Of the meta-estimate at the end of the fixed path, summed over elements: each run's square about the mean, and the mean of the
    variances that it states."""
    points, gradients, stated = path(problem), [], []
    for seed in range(runs):
        state, found = form.init(problem, points[0]), None
        for step, parameters in enumerate(points):
            found, state = form.estimate(problem, parameters, state, Key(seed, step))
        assert found is not None
        assert found.variance is not None
        gradients.append(np.concatenate([arrays.numpy(x).ravel() for x in found.gradient.values()]))
        stated.append(sum(arrays.numpy(x).sum() for x in found.variance.values()))
    squares = np.square(gradients - np.mean(gradients, axis=0)).sum(axis=1) * runs / (runs - 1)
    return {"squares": squares.tolist(), "variance": float(squares.mean()), "stated": float(np.mean(stated))}


def ratio(ours: list[float], own: list[float]) -> list[float]:
    """Of two means over the same seeds, and its standard error."""
    a, b = np.array(ours), np.array(own)
    found = a.mean() / b.mean()
    return [float(found), float(np.std(a - found * b, ddof=1) / (b.mean() * np.sqrt(len(a))))]


def errors(problem: ur.Problem, form: ur.MetaEstimator, rate: float, steps: int, seeds: int) -> list[float]:
    """The errors that descents with a falling rate end with, of seeds 0, 1, ..."""
    start = problem.parameter_error(problem.initial())
    optimizer = ur.optimizers.MetaAdam(rate, schedule=Cosine(steps, FLOOR))
    runs = [ur.optimize(problem, form, optimizer, steps=steps, seed=seed) for seed in range(seeds)]
    return [total_error(problem.parameter_error(run.parameters), start) for run in runs]


def images_of_f(names: tuple[str, ...], resolution: int, runs: int, steps: int, seeds: int) -> dict[str, Any]:
    """All figures, on one thread."""
    threads, problems = dr.thread_count(), {}
    dr.set_thread_count(1)
    for name in names:
        problem = ur.gallery.problem(name, resolution=resolution, loss="RelativeL2", **OPTIONS[name])
        spent = costs(problem)
        print(name, {form: round(ms, 2) for form, ms in spent.items()}, flush=True)
        problems[name] = {}
        for form, estimator in FORMS.items():
            found: dict[str, Any] = {"milliseconds": spent[form]}
            if "," not in form:
                ends = errors(problem, estimator, RATES[name], steps, seeds)
                found |= {"rate": RATES[name], "errors": ends, "final": median_and_range(ends)}
                found |= variances(problem, estimator, runs)
                own = problems[name]["own"]["squares"] if problems[name] else found["squares"]
                found["ratio"] = ratio(found["squares"], own)
            problems[name][form] = found
            print(name, form, {key: value for key, value in found.items() if key != "squares"}, flush=True)
    dr.set_thread_count(threads)
    return {"resolution": resolution, "runs": runs, "steps": steps, "seeds": seeds, "problems": problems}
