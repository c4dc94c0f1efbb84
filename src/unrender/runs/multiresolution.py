"""A run's step to a finer resolution: the parameters, and what optimizer, estimator and pixel sampler remember.

How states are carried is in `problem.upsampling`. By default (`CoarseToFine.states`) the estimator's state is carried and the
optimizer's is not. That came out best, or as good as any, by equal steps: a control variate is what a run has paid for
and stays true, while Adam's mean squares take a thousand steps to follow.
"""

from __future__ import annotations

import time

from unrender.core import arrays, trees
from unrender.runs.noise import GradientNoise
from unrender.runs.run import Run, RunState
from unrender.scene.coarse_to_fine import NEVER
from unrender.scene.upsampling import NotCarried, Upsampler, restarted, upsampled

__all__ = ["hurry", "is_due", "refine", "unfinished"]

_MEASURED, _COARSE_SHARE = 3, 0.4
"""Steps whose time tells how many the budget allows; share of these after which all resolutions are the scene's own."""


def hurry(run: Run) -> None:
    """Bring the changes of resolution forward where the time of the first steps tells that the budget ends too early.

    It happens once, and the checkpoint remembers it. Steps at which the problem itself asks for a change stay.
    """
    ways = run.problem.coarse_to_fine
    if run.step != _MEASURED or not run.seconds or not ways or run.plan.problem.coarse_to_fine:
        return
    allowed = _COARSE_SHARE * run.seconds * run.step / max(run.clock, 1e-9)
    last = max(way.steps[-1] for way in ways.values())
    run.ahead = max(0, last - max(int(allowed), run.step)) if last < NEVER else 0


def is_due(run: Run) -> bool:
    """Whether the next step is the first of another resolution."""
    return bool(run.problem.coarse_to_fine) and trees.shapes(run.parameters) != run.problem.shapes(run.step + run.ahead)


def unfinished(run: Run) -> list[str]:
    """One line for each parameter that did not come to its scene's own resolution."""
    found = []
    for key, way in run.problem.coarse_to_fine.items():
        if (shape := arrays.shape(run.parameters[key])) != run.problem.shapes()[key] and way.steps[-1] < NEVER:
            size = "x".join(map(str, reversed(shape[:-1])))
            found.append(
                f"parameter {key}: still {size} at the end, after {run.step} steps of at least {way.steps[-1] + 1}"
            )
    return found


def refine(run: Run, state: RunState) -> float:
    """Bring parameters and states to the resolution of the next step. Returns the seconds it took."""
    started = time.perf_counter()
    upsampler = Upsampler(run.problem, run.step + run.ahead, run.parameters)
    asked = {way.states for key, way in run.problem.coarse_to_fine.items() if key in upsampler.shares}
    carry = {"estimator": "reset" not in asked, "optimizer": asked == {"carry"}}
    run.parameters = upsampler.tree(run.parameters)
    fresh = (
        run.estimator.init(run.problem, run.parameters),
        run.optimizer.init(run.problem.coordinates.of(run.parameters), run.problem.learning_rates),
    )
    for name, new in zip(("estimator", "optimizer"), fresh, strict=True):
        component = getattr(state, name)
        try:
            after = upsampled(component, upsampler) if carry[name] else restarted(component, new)
        except NotCarried as error:
            run.warnings.append(f"step {run.step}: {error} cannot be carried to another resolution: it starts anew")
            after = restarted(component, new)
        setattr(state, name, after)
    state.noise = GradientNoise()
    arrays.evaluate(run.parameters, state.estimator, state.optimizer)
    return time.perf_counter() - started
