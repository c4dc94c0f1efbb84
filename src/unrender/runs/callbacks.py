"""Callbacks: receivers of the events of a run, both parts of the run itself and user code; and the times of its phases."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from unrender.core.phases import Listener
from unrender.core.text import in_words

if TYPE_CHECKING:
    from unrender.estimators.base import Estimate
    from unrender.runs.result import Result
    from unrender.runs.run import Run


class Callback(Listener):
    """Receiver of the events of a run. Override the methods of interest; the run's time does not include them.

    User code and the parts of a run other than its steps (budget, refinement, verification, the run folder) are callbacks alike. The run
    calls each event on all of them, in order:

        on_warm_up → on_start → (before_step → on_update → on_step)* → on_result → on_end

    An exception before `on_end` is passed to `on_error`, and then to the caller. `on_phase`, `on_progress` and `on_phase_end` report
    the phases within the run, such as compiling; see `Listener`.

    A callback that blocks to pause the run should check `run.stopped`, which Ctrl-C sets. The history so far is on disk (`run.folder`,
    None without a run folder).
    """

    def on_warm_up(self, run: Run, fresh: dict[str, Any], warm: dict[str, Any]) -> None:
        """Called after kernels are compiled; the run is still before its first step.

        Args:
            run: the run.
            fresh, warm: snapshots before the first step and after two steps, which show the types and shapes of the states.
        """

    def on_start(self, run: Run) -> None:
        """Called before the first step, or before the first step after resuming (`run.step`). From here on, Ctrl-C stops the run
        gracefully."""

    def before_step(self, run: Run) -> None:
        """Called before each step. This time is not counted as the run's."""

    def on_update(self, run: Run, estimate: Estimate, applied: bool) -> None:
        """Called after a step, before its record is made. `applied` is false if the estimate or the optimizer's step was not finite."""

    def on_step(self, run: Run, record: dict[str, Any]) -> None:
        """Called after each step, with its record, the last of the history. `run.stop()` ends the run."""

    def on_result(self, run: Run, result: Result) -> Result:
        """Called after the last step, and after the run folder is written. Returns the result, possibly with additions."""
        return result

    def on_error(self, run: Run, error: BaseException) -> None:
        """Called if the run ends by an exception."""

    def on_end(self, run: Run, result: Result) -> None:
        """Called after everything is done and saved."""

    def warnings(self, run: Run) -> list[str]:
        """Return warnings for a result made now, in addition to `Run.warnings`, one line each."""
        return []


def _passed_on(event: Callable[..., None]) -> Any:
    def call(self: UserCallbacks, run: Run, *arguments: Any) -> None:
        bound = [getattr(callback, event.__name__) for callback in self._callbacks]
        if overridden := [each for each in bound if getattr(each, "__func__", None) is not event]:
            with run.shown():
                for each in overridden:
                    each(run, *arguments)

    return call


class UserCallbacks(Callback):
    """The user's callbacks as one.

    They see parameters at the scene's resolution where only the plan made them coarse (`Run.shown`). That takes time, so it is done only
    for events that a callback overrides.
    """

    def __init__(self, callbacks: Sequence[Callback]):
        self._callbacks = tuple(callbacks)

    on_warm_up, on_start, before_step = map(_passed_on, (Callback.on_warm_up, Callback.on_start, Callback.before_step))
    on_update, on_step, on_end = map(_passed_on, (Callback.on_update, Callback.on_step, Callback.on_end))
    on_error = _passed_on(Callback.on_error)

    def on_result(self, run: Run, result: Result) -> Result:
        for callback in self._callbacks:
            after: Any = callback.on_result(run, result)
            if isinstance(after, type(result)):
                result = after
            elif after is not None:  # a callback may return nothing
                line = (
                    f"{type(callback).__name__}.on_result: expected a Result, got {in_words(after)}, which is ignored"
                )
                result = replace(result, warnings=[*result.warnings, line])
        return result

    def warnings(self, run: Run) -> list[str]:
        return [line for callback in self._callbacks for line in callback.warnings(run)]


COMPILING, STEPS, ASIDE = "compiling", "steps", "checkpoints and callbacks"
VERIFYING, PICTURES = "verification", "final pictures"
"""Phases of a run in order: before the first step; the steps; what happens between and after them."""

RUN_PHASES = (COMPILING, STEPS, ASIDE, VERIFYING, PICTURES)


class PhaseTimes(Callback):
    """Callback that records the seconds of each phase in `Result.phases`, after the `earlier` ones. It is the first callback, so that saved
    results contain them.

    Compiling between steps, after a change of resolution or of a mesh, counts as compiling.
    """

    def __init__(self, earlier: Mapping[str, float] | None = None):
        self._earlier = dict(earlier or {})
        self._made = self._started = time.perf_counter()
        self._clock = self._warm = 0.0

    def on_start(self, run: Run) -> None:
        self._started, self._clock, self._warm = time.perf_counter(), run.clock, run.warmup_seconds

    def on_result(self, run: Run, result: Result) -> Result:
        steps = run.clock - self._clock
        between = run.warmup_seconds - self._warm
        aside = time.perf_counter() - self._started - steps - between
        run_phases = {COMPILING: self._started - self._made + between, STEPS: steps, ASIDE: max(aside, 0.0)}
        return replace(result, phases={**self._earlier, **run_phases})


def with_phase(result: Result, name: str, seconds: float) -> Result:
    return replace(result, phases={**result.phases, name: seconds})
