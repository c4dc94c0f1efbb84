"""Runs of `unrender` over processor time, and what they reach: errors of surfaces and of pictures, free of the renderings' noise."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

import unrender as ur
from benchmarks.internals import Key, SampleRequest, Tree, arrays, prepare
from benchmarks.peers.drivers.recorder import BudgetSpentError, Recorder
from benchmarks.runner.timing import work_time
from unrender.statistics import debiased

Point = tuple[float, dict[str, np.ndarray]]
"""Processor seconds, and parameters."""
POINTS = 40
"""Of a curve."""
_PICTURE_SPP = 64


class Kept(ur.protocols.Callback):
    """Parameters along a run of ours, over the processor time of its steps; ends it when that is used up.

    Args:
        seconds: of the processor.
        points: how many times parameters are kept.
        steps: after which the run ends at the latest; None for no limit.
    """

    def __init__(self, seconds: float, points: int = POINTS, steps: int | None = None):
        self._recorder = Recorder(seconds, points, steps, timer=work_time)
        self.returned: dict[str, np.ndarray] = {}

    def on_start(self, run: Any) -> None:
        self._recorder.begin()

    def on_step(self, run: Any, record: dict[str, Any]) -> None:
        try:
            self._recorder.step(run.full)
        except BudgetSpentError:
            run.stop()

    @property
    def steps(self) -> int:
        """Number of steps so far."""
        return self._recorder.steps

    @property
    def seconds(self) -> float:
        """Processor seconds of the steps so far."""
        return self._recorder.clock

    @property
    def found(self) -> list[Point]:
        """(processor seconds, parameters) along the run."""
        return [(seconds, values) for seconds, _, values in self._recorder.kept]


def timed_run(
    problem: ur.Problem, seconds: float, seed: int, *method: Any, points: int = POINTS, steps: int | None = None
) -> Kept:
    """Run `auto`, or an estimator and an optimizer, for some processor seconds or steps without measuring errors; return what was kept."""
    kept = Kept(seconds, points, steps)
    limit = 100 * seconds  # of the clock, never reached
    result = ur.optimize(blind(problem), *method, seconds=limit, seed=seed, callbacks=[kept], progress=False)
    kept.returned = dict(result.parameters)
    return kept


def blind(problem: ur.Problem) -> ur.Problem:
    """The same without the truth: errors are no part of a run's time."""
    unknowns = {key: replace(unknown, truth=None, surface=None) for key, unknown in problem.unknowns.items()}
    return problem.with_parts(unknowns=unknowns)


def measured(problem: ur.Problem, found: Sequence[tuple[float, Mapping[str, np.ndarray]]]) -> dict[str, Any]:
    """What was reached in the end, and the curve of the surface's error over seconds; pictures alone where no surface is known."""
    first, last = (views_error(problem, at, _PICTURE_SPP) for at in (problem.initial_values(), found[-1][1]))
    if all(unknown.surface is None for unknown in problem.unknowns.values()):
        return {"pictures": last / first}
    (key,) = problem.faces
    start = problem.parameter_error(problem.initial())[key]
    curve = [(0.0, 1.0), *((seconds, problem.parameter_error(values)[key] / start) for seconds, values in found)]
    return {"curve": [list(x) for x in zip(*curve, strict=True)], "surface": curve[-1][1], "pictures": last / first}


Pair = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Two independent renderings, and the reference, (H, W, C) each."""


def picture_error(pairs: Iterable[Pair]) -> float:
    """Return the root mean square error over pictures of equal size (`debiased.rmse`)."""
    one, two, reference = (np.concatenate(each) for each in zip(*pairs, strict=True))
    return debiased.rmse(one, two, reference)[0]


def views_error(problem: ur.Problem, values: Mapping[str, np.ndarray], spp: int) -> float:
    """Return the `picture_error` of all views with these values of the unknowns, from two renderings of `spp` samples per pixel."""

    def pair(index: int) -> Pair:
        one, two = (ur.render(problem, values, index, spp=spp, seed=seed) for seed in (1, 2))
        return one, two, np.asarray(problem.views[index].reference)

    return picture_error(map(pair, range(len(problem.views))))


class ImageErrors:
    """How far renders of groups of views are from their references, relative to the start.

    Args:
        made: `nerf-volume` with all views.
        options: that it was made with.
        groups: numbers of views by name.
        spp: of two renders.
    """

    def __init__(self, made: ur.Problem, options: dict[str, Any], groups: Mapping[str, Sequence[int]], spp: int):
        own = ur.gallery.problem("nerf-volume", **{**options, "reference_spp": 1})
        self.session, self.groups, self.spp = prepare(own, made.initial()), groups, spp
        self.views, self.array = made.views, made.renderer.array
        self.start = self.errors(made.initial())

    def __call__(self, parameters: Tree) -> dict[str, float]:
        return {name: error / self.start[name] for name, error in self.errors(parameters).items()}

    def errors(self, parameters: Tree) -> dict[str, float]:
        """Root mean square over each group's views."""
        parameters = {key: self.array(value) for key, value in parameters.items()}

        def pair(number: int) -> Pair:
            request = SampleRequest(self.views[number].sensor, self.spp, Key(424_242, number).uint32(), 2)
            one, two = arrays.numpy(self.session.image(parameters, request).images)
            return one, two, np.asarray(self.views[number].reference)

        return {name: picture_error(map(pair, group)) for name, group in self.groups.items()}
