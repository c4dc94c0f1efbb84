"""The progress of a run in a notebook's output."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from unrender.core import phases
from unrender.display import formatting
from unrender.display.notebook_bar import NotebookBar
from unrender.runs.callbacks import Callback

if TYPE_CHECKING:
    from unrender.runs.result import Result
    from unrender.runs.run import Run

__all__ = ["NotebookProgress"]


class NotebookProgress(Callback):
    """A bar in a notebook's cell: compiling, steps with loss and parameter error, final pictures; then one line. A context manager."""

    def __init__(self) -> None:
        self._bar = NotebookBar()
        self._listening = phases.listening(self._bar)
        self._told = ""

    def __enter__(self) -> NotebookProgress:
        self._listening.__enter__()
        return self

    def __exit__(self, *_: object) -> None:
        self._listening.__exit__(None, None, None)
        self._bar.close(self._told)

    def on_step(self, run: Run, record: dict[str, Any]) -> None:
        """See `Callback.on_step`."""
        parts = [
            f"step {run.step}" + (f" of {run.steps}" if run.steps else ""),
            f"loss {formatting.number(record['loss'])}",
        ]
        if errors := record.get("parameter_error"):
            parts.append("error " + ", ".join(map(formatting.number, errors.values())))
        self._bar.show(", ".join(parts), run.progress())

    def on_end(self, run: Run, result: Result) -> None:
        """See `Callback.on_end`."""
        del run
        self._told = f"{result.steps} steps in {formatting.duration(result.seconds)}"
        self._told += (
            f" and {formatting.duration(result.warmup_seconds)} to compile" if result.warmup_seconds >= 0.5 else ""
        )
