"""What takes part in a descent beside its steps: budget, refinement, warnings, the run folder, the user's callbacks."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from unrender.runs.callbacks import Callback

if TYPE_CHECKING:
    from unrender.estimators.base import Estimate
    from unrender.runs.loop import Descent
    from unrender.runs.result import Result


class Hook:
    """Takes part in a descent. Override what is of interest.

    A `Callback` is the user's: it sees the run and only listens. A hook belongs to the run: it sees all of the `Descent` and may change
    it. The loop calls each event on all hooks, in their order:

        on_warm_up → on_start → (before_step → on_update → on_step)* → on_result → on_end

    An exception anywhere before `on_end` goes to `on_error`, and on to the caller.
    """

    def on_warm_up(self, descent: Descent, fresh: dict[str, Any], warm: dict[str, Any]) -> None:
        """Kernels are compiled; the run is still before its first step.

        Args:
            descent: the run.
            fresh, warm: snapshots of the run before its first step and after two steps, which show the types and shapes of its states.
        """

    def on_start(self, descent: Descent) -> None:
        """Before the first step, or the first after the run was resumed. From here on Ctrl-C stops the run in good order."""

    def before_step(self, descent: Descent) -> None:
        """Before each step. Time spent here is not counted as the run's."""

    def on_update(self, descent: Descent, estimate: Estimate, applied: bool) -> None:
        """The step is done, its record not yet made. `applied` is false for a step whose estimate was not finite."""

    def on_step(self, descent: Descent, record: dict[str, Any]) -> None:
        """After each step, with its record, which is the last of the history."""

    def on_result(self, descent: Descent, result: Result) -> Result:
        """After the last step. Returns the result, with whatever this hook adds to it."""
        return result

    def on_error(self, descent: Descent, error: BaseException) -> None:
        """The descent ends by an exception."""

    def on_end(self, descent: Descent, result: Result) -> None:
        """All is done and saved."""

    def warnings(self, descent: Descent) -> list[str]:
        """What a result made now should warn of, beside `Run.warnings`: one line each."""
        return []


class CallbackHook(Hook):
    """Passes the events of a descent on to the user's callbacks."""

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
