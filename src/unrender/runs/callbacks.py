"""The user's view of a run: what can listen to it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from unrender.runs.result import Result
    from unrender.runs.run import Run

__all__ = ["Callback"]


class Callback:
    """Listens to a run. Override what is of interest; time spent here is not counted as the run's.

    One that waits, to pause the run, should look at `run.stopped` meanwhile, which Ctrl-C sets. The history of the steps so far is on
    the disk (`run.folder`, None for a run without a run folder).
    """

    def on_start(self, run: Run) -> None:
        """Before the first step, or the first after the run was resumed (`run.step`)."""

    def on_step(self, run: Run, record: dict[str, Any]) -> None:
        """After each step, with its record of the history. `run.stop()` ends the run."""

    def on_end(self, run: Run, result: Result) -> None:
        """After the last step."""
