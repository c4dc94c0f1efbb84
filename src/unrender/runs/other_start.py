"""Other starts during a run: where the picture differs from the references, values elsewhere within the bounds are compared."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from unrender.core.text import listed
from unrender.estimators.fresh_pictures import FreshPictures
from unrender.methods.rules.starts import better_place, number_of_places
from unrender.runs.callbacks import Callback
from unrender.runs.loop import begin_at
from unrender.runs.number_means import NumberTrace
from unrender.runs.result import Result
from unrender.runs.verification import misfit_of_numbers

if TYPE_CHECKING:
    from unrender.runs.run import Run

_USED, _FEWEST_STEPS = 0.4, 16
"""Fraction of the budget, and number of steps, after which values are compared once."""
_SHARE, _LEAST_PATHS, _MOST_SHARE = 0.5, 1 << 14, 2.5
"""Paths of all pictures relative to the run's so far, the least number of one, and the share above which a short run is not compared."""
BEGUN_AGAIN = "begins again at step"
"""First words of the line about other values."""
_NUMBER, _KEPT = 4, "kept"
"""Index of the set of random numbers; outcome of a comparison without a better place."""


class OtherStart(Callback):
    """Callback that continues a run of few numbers from other values where its picture stays different from the references.

    A descent ends in the nearest minimum. After 40 % of the budget, a new picture is compared with the references. If they differ by more
    than noise, pictures of other values of `Plan.other_starts` are rendered. The run begins again at the best ones only if their loss is
    at most half of that of the descent so far, beyond noise. A descent that arrives is therefore not disturbed.
    """

    def before_step(self, run: Run) -> None:
        """Compare values once, and begin again at better ones."""
        state, problem = run.state, run.problem
        if not run.plan.other_starts or state.other_start or run.step < _FEWEST_STEPS or run.progress() < _USED:
            return
        places = number_of_places(problem, run.plan.other_starts)
        paths = max(_SHARE / places * state.samples, _LEAST_PATHS)
        pictures = FreshPictures(problem, run.seed, paths, _NUMBER)
        if problem.executor.variant is not None or pictures.paths * places > _MOST_SHARE * state.samples:
            return
        state.other_start, values = _KEPT, run.full()
        images = pictures.picture(values).images
        of = pictures.differences(images), pictures.references, pictures.weights_of(images), pictures.sizes
        if not misfit_of_numbers(problem, *of):
            return
        keys, known = run.plan.other_starts, problem.renderer.parameters()
        lights = [k for k, u in problem.unknowns.items() if known[k].brightness == "light" and u.transform is None]
        if place := better_place(problem, pictures, values, keys, lights):
            begin_at(run, {**run.parameters, **{k: problem.renderer.array(x) for k, x in place.values.items()}})
            state.numbers = NumberTrace()
            state.other_start = (
                f"{BEGUN_AGAIN} {run.step} with other values of {listed(list(keys))}, where the loss is {place.share:.0%} of that "
                "of the descent so far"
            )

    def on_result(self, run: Run, result: Result) -> Result:
        """Add the line about another start."""
        line = run.state.other_start
        return replace(result, adapted=[*result.adapted, line]) if line not in ("", _KEPT) else result
