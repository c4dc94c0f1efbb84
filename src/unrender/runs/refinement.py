"""Coarse to fine: refinement of parameters during a run.

By default (`CoarseToFine.states`) the estimator's state is interpolated (`scene.upsampling`), and the optimizer's is not: a control
variate stays valid, whereas Adam's mean squares take a thousand steps to adapt.
"""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any

from unrender.core import arrays, trees
from unrender.runs.hooks import Hook
from unrender.runs.noise import GradientNoise
from unrender.runs.run import Run, RunState
from unrender.scene.coarse_to_fine import NEVER
from unrender.scene.upsampling import NotCarried, Upsampler, restarted, upsampled

if TYPE_CHECKING:
    from unrender.runs.loop import Descent


_MEASURED, _COARSE_SHARE = 3, 0.4
"""Number of steps that are timed to predict the number of steps in the budget, and the fraction of these after which all resolutions are
the scene's."""


def hurry(run: Run) -> None:
    """Advance the changes of resolution if the time of the first steps shows that the budget ends too early.

    It happens once, and the checkpoint stores it. Steps that the problem itself specifies are not changed.
    """
    levels = run.problem.coarse_to_fine
    if run.step != _MEASURED or not run.seconds or not levels or run.plan.problem.coarse_to_fine:
        return
    allowed = _COARSE_SHARE * run.allowed_seconds() * run.step / max(run.clock, 1e-9)
    last = max(each.steps[-1] for each in levels.values())
    run.ahead = max(0, last - max(int(allowed), run.step)) if last < NEVER else 0


def is_due(run: Run) -> bool:
    """Return whether the next step is the first with another resolution."""
    return bool(run.problem.coarse_to_fine) and trees.shapes(run.parameters) != run.problem.shapes(run.step + run.ahead)


def unfinished(run: Run) -> list[str]:
    """Return one line for each parameter that did not reach its scene's resolution."""
    lines = []
    for key, levels in run.problem.coarse_to_fine.items():
        if (shape := arrays.shape(run.parameters[key])) != run.problem.shapes()[key] and levels.steps[-1] < NEVER:
            size = "x".join(map(str, reversed(shape[:-1])))
            lines.append(
                f"parameter {key}: still {size} at the end, after {run.step} steps of at least {levels.steps[-1] + 1}"
            )
    return lines


def refine(run: Run, state: RunState) -> float:
    """Convert parameters and states to the resolution of the next step. Returns the elapsed seconds."""
    started = time.perf_counter()
    upsampler = Upsampler(run.problem, run.step + run.ahead, run.parameters)
    modes = {schedule.states for key, schedule in run.problem.coarse_to_fine.items() if key in upsampler.shares}
    carry = {"estimator": "reset" not in modes, "optimizer": modes == {"carry"}}
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
            run.warnings.append(f"step {run.step}: {error} cannot be carried to another resolution: it restarts")
            after = restarted(component, new)
        setattr(state, name, after)
    state.noise = GradientNoise()
    arrays.evaluate(run.parameters, state.estimator, state.optimizer)
    return time.perf_counter() - started


class Refinement(Hook):
    """Hook that refines parameters and states before the steps at which their resolution changes, and records the resolutions.

    Compiling the kernels of the new resolution counts as warm-up.
    """

    def __init__(self) -> None:
        self._refined = False

    def before_step(self, descent: Descent) -> None:
        hurry(descent.run)
        self._refined = is_due(descent.run)
        if self._refined:
            descent.log.warmup_seconds += refine(descent.run, descent.state) + descent.warm_up()[0]

    def on_step(self, descent: Descent, record: dict[str, Any]) -> None:
        run = descent.run
        keys = run.problem.coarse_to_fine
        if self._refined or (run.step == 1 and keys):
            record["resolution"] = {key: run.parameters[key].shape[:-1] for key in keys}

    def warnings(self, descent: Descent) -> list[str]:
        """Return warnings about parameters that did not reach their scene's resolution."""
        return unfinished(descent.run) if descent.run.stopped else []
