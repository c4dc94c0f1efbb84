"""Hooks: parts of a run besides its steps, such as budget, refinement, warnings, the run folder and callbacks."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from unrender.runs.callbacks import Callback

if TYPE_CHECKING:
    from unrender.estimators.base import Estimate
    from unrender.runs.loop import Descent
    from unrender.runs.result import Result


class Hook:
    """Part of a run. Override the methods of interest.

    A `Callback` belongs to the user: it gets the run and only observes. A hook belongs to the run: it gets the entire `Descent` and may
    change it. The loop calls each event on all hooks, in order:

        on_warm_up → on_start → (before_step → on_update → on_step)* → on_result → on_end

    An exception before `on_end` is passed to `on_error`, and then to the caller.
    """

    def on_warm_up(self, descent: Descent, fresh: dict[str, Any], warm: dict[str, Any]) -> None:
        """Called after kernels are compiled; the run is still before its first step.

        Args:
            descent: the run.
            fresh, warm: snapshots before the first step and after two steps, which show the types and shapes of the states.
        """

    def on_start(self, descent: Descent) -> None:
        """Called before the first step, or the first step after resuming. From here on, Ctrl-C stops the run gracefully."""

    def before_step(self, descent: Descent) -> None:
        """Called before each step. This time is not counted as the run's."""

    def on_update(self, descent: Descent, estimate: Estimate, applied: bool) -> None:
        """Called after a step, before its record is made. `applied` is false for a step whose estimate was not finite."""

    def on_step(self, descent: Descent, record: dict[str, Any]) -> None:
        """Called after each step, with its record, the last of the history."""

    def on_result(self, descent: Descent, result: Result) -> Result:
        """Called after the last step. Returns the result, possibly with additions."""
        return result

    def on_error(self, descent: Descent, error: BaseException) -> None:
        """Called if the run ends by an exception."""

    def on_end(self, descent: Descent, result: Result) -> None:
        """Called after everything is done and saved."""

    def warnings(self, descent: Descent) -> list[str]:
        """Return warnings for a result made now, in addition to `Run.warnings`, one line each."""
        return []


class CallbackHook(Hook):
    """Hook that calls the user's callbacks."""

    def __init__(self, callbacks: Sequence[Callback]):
        self._callbacks = tuple(callbacks)

    def on_start(self, descent: Descent) -> None:
        with descent.run.shown() as run:
            for callback in self._callbacks:
                callback.on_start(run)

    def on_step(self, descent: Descent, record: dict[str, Any]) -> None:
        with descent.run.shown() as run:
            for callback in self._callbacks:
                callback.on_step(run, record)

    def on_end(self, descent: Descent, result: Result) -> None:
        with descent.run.shown() as run:
            for callback in self._callbacks:
                callback.on_end(run, result)
