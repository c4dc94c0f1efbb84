"""Limits of a run's steps and seconds."""

from __future__ import annotations

import glob
import math
import time
from typing import TYPE_CHECKING

import numpy as np

from unrender.core import checks, timing
from unrender.core.errors import InputError
from unrender.core.text import in_words
from unrender.estimators.base import Estimate
from unrender.estimators.path import PathGradient
from unrender.methods import methods
from unrender.methods.rules.constants import CONSTANTS
from unrender.optimizers.averaged_newton import AveragedNewton
from unrender.pixels import All, Uniform
from unrender.runs.callbacks import Callback
from unrender.runs.image_sensitivity import seconds_of_probe
from unrender.runs.result import NON_FINITE, Result
from unrender.runs.truth_check import FEW_NEWTON_STEPS

if TYPE_CHECKING:
    from unrender.methods.plan import Plan
    from unrender.runs.run import Run

_MOST_SKIPPED = 20
_FEW_STEPS, _MEASURED = 20, 3
"""Number of steps below which a warning is given, and number of steps that are timed for it."""
_LEAST_SPP = 2  # least samples per pixel that it advises
_END_SHARE, _END_UNTESTED, _END_SECONDS = 0.1, 0.05, 1.0
"""Time reserved for verification and final images: a fraction of the budget, less without tests, plus seconds."""
_TESTED_SHARE, _OF_TESTS = (0.6, 0.1), 1 / 9
"""Share of the budget that must be left once kernels are traced for tests of what the images determine, less if kernels were compiled; and
largest share of the time left for one probe of the images' sensitivity, of which the tests take three at least."""
_LOOK_SECONDS, MOST_SLOWDOWN = 0.5, 3.0
"""Seconds between two measurements of the load of the machine; the largest slowdown that is taken into account."""
_LEAST_SHARE, _LONG_BEFORE = 0.5, 1 / 3
"""Fraction of the budget that the steps get even if the warm-up takes long, within the following limits; and fraction before the first step
that a line names."""
_LATE_SHARE, _LATE_SECONDS, _LATE_COMPILED = 0.1, 3.0, 15.0
"""Time beyond the budget at which everything is finished: a fraction of it plus seconds, or the last number if kernels were compiled."""
_PAGE_SECONDS = 1.0  # time of the page and the summary on an idle machine
_END_OF_STEPS, LEAST_END, LEAST_NUMBERS = 1 / 3, 1.5, 0.5
"""Most cost of the final pictures and tests of a run without a budget in seconds, relative to that of its steps; its minimum, with .5 a run
of 80 steps of a wall of 400 texels had no standard errors; and the minimum for the check of few numbers."""
_OF_STEP = 2  # cost of a path of a step, and launches of a step, relative to a rendering: most steps have an adjoint
_LONG_SHARE = 0.2  # share of the time for steps that one of them may take


class Budget(Callback):
    """Callback that stops a run after its steps or seconds, or after twenty consecutive steps that are not finite."""

    def __init__(self) -> None:
        self._least = self._looked = -math.inf

    def on_start(self, run: Run) -> None:
        if run.deadline is not None:
            run.deadline -= run.clock  # of a resumed run, before
        self._least = time.perf_counter() + _LEAST_SHARE * max((run.seconds or 0.0) - run.clock, 0.0)
        if run.deadline is not None and run.seconds is not None:
            run.before = max(time.perf_counter() - (run.deadline - run.seconds) - run.clock, 0.0)
            late = _LATE_COMPILED if run.compiled else _LATE_SHARE * run.seconds + _LATE_SECONDS
            run.grace = max(late - _PAGE_SECONDS * min(slowdown(), MOST_SLOWDOWN), 0.0)
            self._least = min(self._least, run.deadline + run.grace - _end(run))
        self._check(run)

    def on_update(self, run: Run, estimate: Estimate, applied: bool) -> None:
        self._check(run)

    def _check(self, run: Run) -> None:
        self._set_last_step(run)
        if run.state.skipped_in_a_row >= _MOST_SKIPPED:
            run.stop(NON_FINITE)
        if run.steps is not None and run.step >= run.steps:
            run.stop("steps")
        if run.seconds is not None and run.clock >= run.seconds:
            run.stop("seconds")
        if run.last_step is not None and run.step and time.perf_counter() + 0.5 * run.clock / run.step >= run.last_step:
            run.stop("seconds")
        if run.step and (run.stopped or run.step == _MEASURED):
            _warn_of_few_steps(run)
        if run.stopped in ("steps", "seconds") and 0 < run.step == run.skipped:
            run.stopped = NON_FINITE
        if run.stopped == NON_FINITE:
            count = run.skipped if run.skipped == run.step else run.state.skipped_in_a_row
            steps = "1 step was" if count == 1 else f"{count} steps in a row were"
            line = f"{steps} not finite: the run was stopped; the result holds the last finite values"
            if line not in run.warnings:
                run.warnings.append(line)

    def _set_last_step(self, run: Run) -> None:
        """Set when the steps end: before the deadline by the time of verification and pictures, longer on a busy machine."""
        now = time.perf_counter()
        if run.deadline is None or run.seconds is None or now - self._looked < _LOOK_SECONDS:
            return
        self._looked = now
        run.last_step = max(run.deadline - min(_end(run), 0.5 * run.seconds), self._least)


def _end(run: Run) -> float:
    """Return the seconds reserved for verification, final images and tests."""
    share = _END_SHARE if run.tested else _END_UNTESTED
    return (share * (run.seconds or 0.0) + _END_SECONDS) * min(slowdown(), MOST_SLOWDOWN)


def slowdown() -> float:
    """Return the time of this process over that on an idle machine, >= 1, from the waits of its threads; 1 if unknown, or not needed since
    renderings are counted."""
    if timing.counts():
        return 1.0
    running, waiting = np.sum([(0.0, 0.0), *map(timing.scheduled, glob.glob("/proc/self/task/*"))], axis=0).tolist()
    return 1.0 + waiting / running if running else 1.0


def can_test(run: Run) -> bool:
    """Return whether a budget in seconds has time for tests at the end, whose kernels take about as long as those of a step to trace and
    compile, by the times of the warm-up's steps."""
    if run.seconds is None:
        return True
    seconds, samples = run.trial
    probe = seconds_of_probe(run.problem, seconds, _cost_of_steps(samples, 1), 1)
    slow = not run.compiled and probe > _OF_TESTS * run.time_left()
    return run.time_left() - run.tracing > _TESTED_SHARE[run.compiled] * run.seconds and not slow


def shorter_steps(run: Run) -> Plan | None:
    """Return a plan with cheaper steps if one takes more than a fifth of the time left for steps, and add a warning; else None.

    There is none if the steps that were asked for fit into this time. The kernels of these steps are traced again, so there is none either
    if that took longer than a step and half of the time.
    """
    if run.deadline is None or run.seconds is None or run.plan.cheaper is None or run.resumed is not None:
        return None
    left, (seconds, _) = max(run.time_left() - _end(run), _LEAST_SHARE * run.seconds), run.trial
    wanted = min(run.steps or _FEW_STEPS, _FEW_STEPS)
    if seconds <= max(_LONG_SHARE, 1.0 / wanted) * left or run.tracing > max(0.5 * left, seconds):
        return None
    made = run.plan.cheaper(left / (wanted * seconds))
    if made is None:
        return None
    plan, options = made
    flags = " ".join(f"--set {name}={value}" for name, value in options.items())
    run.warnings.append(
        f"a step{' with its tracing' * (run.tracing == seconds)} took {seconds:.2g} s, and all steps have {left:.2g} s, so the run goes on "
        f"as with {flags}; use more seconds for larger steps"
    )
    return plan


def seconds_of_steps(result: Result) -> float:
    """Return the seconds of a run's steps, on the clock of `timing`."""
    if not timing.counts():
        return result.seconds
    return _cost_of_steps(result.history[-1]["samples"], result.steps) if result.history else 0.0


def _cost_of_steps(samples: float, steps: int) -> float:
    return timing.cost(_OF_STEP * samples, _OF_STEP * steps)


def cost_of_end(samples: float, steps: int, least: float = LEAST_END) -> float:
    """Return the seconds that final pictures and tests may take if renderings are counted, from the samples of all steps."""
    return max(_END_OF_STEPS * _cost_of_steps(samples, steps), least)


def _warn_of_few_steps(run: Run) -> None:
    """Warn if the time of the first steps shows that the budget allows few steps. At the end the line has the number of steps taken."""
    if run.seconds is None or run.clock <= 0.0:
        return
    expected = 0 if run.stopped else int(run.allowed_seconds() * run.step / run.clock)
    needed = FEW_NEWTON_STEPS if isinstance(run.optimizer, AveragedNewton) else _FEW_STEPS
    spp, steps = getattr(run.estimator, "spp", None), max(expected, run.step)
    ways = spp if isinstance(spp, int) else None, _suits_mini_batches(run), _enough(run, needed)
    ways = (None, False, None) if run.replanned else ways  # another budget or option has other steps
    line = few_steps(run.seconds, steps, run.steps, *ways, needed, run.before, run.compiled)
    run.warnings[:] = [known for known in run.warnings if known != run.few_steps] + [line] * bool(line)
    run.few_steps = line


def _suits_mini_batches(run: Run) -> bool:
    """Return whether the method has an option for fewer pixels a step, whose paths are a quarter at most, and noise does not bias the loss:
    else mini-batches diverge."""
    estimator, known = run.estimator, methods().get(run.description.get("method", ""))
    if not isinstance(estimator, PathGradient) or known is None or "pixels" not in known.options.model_fields:
        return False
    sampler = estimator.pixels
    count = sampler.count if isinstance(sampler, Uniform) else run.problem.pixels if isinstance(sampler, All) else 0
    return count * estimator.spp >= 4 * math.prod(CONSTANTS.short_batch) and run.problem.loss.linear


def _enough(run: Run, needed: int) -> float:
    """Return the seconds that `needed` steps of another run need, with everything before and after them if the budget covers it."""
    steps = needed * run.clock / run.step
    if run.deadline is None or run.seconds is None:
        return steps
    busy, before = min(slowdown(), MOST_SLOWDOWN), run.before - run.tracing * run.compiled  # it compiles no kernels
    return min((before + steps + busy * _END_SECONDS) / (1.0 - busy * _END_SHARE), 2.0 * (before + steps))


def few_steps(
    seconds: float,
    steps: int,
    most: int | None = None,
    spp: int | None = None,
    large: bool = False,
    enough: float | None = None,
    needed: int = _FEW_STEPS,
    before: float = 0.0,
    compiled: bool = False,
) -> str:
    """Return a line with advice if a budget allows fewer than `needed` steps and fewer than `most`; else "".

    Args:
        seconds, steps, most: the budget, the steps that it allows, and the steps that were requested.
        spp: samples per pixel of a step, of which it advises a quarter, at least 2, since gradients without bias need two groups of
            samples; None if unknown.
        large: whether to advise a mini-batch of pixels.
        enough: seconds that the needed steps need; None if unknown.
        needed: number of steps; Gauss-Newton steps of all unknowns need fewer.
        before: seconds of the budget before the first step.
        compiled: whether kernels were compiled that another run has, whose seconds `enough` are.
    """
    if steps >= min(needed, most or needed):
        return ""
    ways = ["use more seconds" if enough is None else f"use at least {max(math.ceil(enough), 1)} seconds"]
    if spp is not None and spp > _LEAST_SPP:
        ways.append(f"fewer samples (--set spp={max(spp // 4, _LEAST_SPP)})")
    ways.append("a smaller picture (resolution)")
    if large:
        ways.append("fewer pixels a step (--set pixels={} --set spp={})".format(*CONSTANTS.short_batch))
    advice = ", ".join(ways[:-1]) + (", or " if len(ways) > 2 else " or ") + ways[-1]
    if compiled and enough is not None and enough <= seconds:
        advice = "run it again, since its kernels are now compiled"
    late = f" after {before:.0f} s of loading and compiling" if before > _LONG_BEFORE * seconds else ""
    return f"the budget of {seconds:g} s allows about {steps} step{'' if steps == 1 else 's'}{late}; {advice}"


def check_budget(steps: int | None, seconds: float | None) -> None:
    """Raise `InputError` unless a limit is given, `steps` is a whole number in [1, 2⁶³), and `seconds` is positive and finite."""
    if steps is None and seconds is None:
        raise InputError("optimize: set a budget, steps= or seconds=")
    if steps is not None:
        checks.integer("optimize", "steps", steps, at_least=1, at_most=checks.LARGEST)
    if seconds is not None and not 0 < checks.real(seconds) < math.inf:
        raise InputError(f"optimize: seconds must be positive and finite, got {in_words(seconds)}")
