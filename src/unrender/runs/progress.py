"""Display of a call's progress: a bar on a terminal, occasional lines elsewhere."""

from __future__ import annotations

import math
import time
from contextlib import AbstractContextManager
from typing import TYPE_CHECKING, Any

from rich.progress import BarColumn, TextColumn
from rich.progress import Progress as Bar

from unrender.core import phases
from unrender.display.terminal import Console
from unrender.runs.callbacks import Callback

if TYPE_CHECKING:
    from unrender.runs.result import Result
    from unrender.runs.run import Run

_BAR_SECONDS = 0.1
_LINE_SECONDS = 2.0
_SMOOTHING = 0.1


class Progress(Callback):
    """Displays each phase of a command (loading, reference images, compiling) with its progress.

    For steps it displays loss, parameter error (if the truth is known), gradient noise, speed and remaining time. The loss is smoothed
    over about ten steps. Use it as a context manager, so that it gets the phases, and the bar is always removed.

    Args:
        console: console for the output; None for standard output.
        began: time of `time.perf_counter` at which the command began; None for now.

    Attributes:
        budget_began: the same, or when the latest run of several began.
    """

    def __init__(self, console: Console | None = None, began: float | None = None):
        self._console = console or Console()
        self.budget_began = self._began = time.perf_counter() if began is None else began
        self._stopwatch = phases.Stopwatch()
        self._listening: AbstractContextManager[None] | None = None
        self._within: list[str] = []
        self._printed = ""
        self._bar: Bar | None = None
        self._started = self._shown = self._before = 0.0
        self._loss: float | None = None
        self._error: dict[str, float] = {}
        self._warnings_shown = 0

    def __enter__(self) -> Progress:
        self._listening = phases.listening(self)
        self._listening.__enter__()
        return self

    def __exit__(self, *_: object) -> None:
        self._close()
        if self._listening is not None:
            self._listening.__exit__(None, None, None)
            self._listening = None

    @property
    def seconds(self) -> dict[str, float]:
        """{phase: seconds} so far, without time outside of phases."""
        return dict(self._stopwatch.seconds)

    @property
    def elapsed(self) -> float:
        """Seconds since the command began."""
        return time.perf_counter() - self._began

    # ------------------------------------------------------------------ phases

    def on_phase(self, name: str) -> None:
        self._stopwatch.on_phase(name)
        self._within.append(name)
        if self._console.is_terminal:
            self._open(name, None)
        elif name != self._printed:
            self._print(name)
            self._printed = name

    def on_progress(self, share: float) -> None:
        now = time.perf_counter()
        if self._bar is not None:
            self._bar.update(self._bar.task_ids[0], total=1.0, completed=share)
        elif self._within and now - self._shown >= _LINE_SECONDS and share < 1:
            self._print(f"{self._within[-1]} {100 * share:.0f}%")

    def on_phase_end(self, name: str) -> None:
        self._stopwatch.on_phase_end(name)
        self._within.pop()
        self._close()
        if self._within and self._console.is_terminal:
            self._open(self._within[-1], None)

    # ------------------------------------------------------------------ steps

    def on_start(self, run: Run) -> None:
        self._started, self._before, self._shown = time.perf_counter(), run.progress(), 0.0
        self._loss, self._error, self._warnings_shown = None, {}, len(run.warnings)
        if self._console.is_terminal:
            self._open("", 1.0)

    def on_step(self, run: Run, record: dict[str, Any]) -> None:
        loss = record["loss"]
        if math.isfinite(loss):
            self._loss = loss if self._loss is None else self._loss + _SMOOTHING * (loss - self._loss)
        self._error = record.get("parameter_error") or self._error
        for line in run.warnings[self._warnings_shown :]:
            self._console.print(f"note: {line}", markup=False, highlight=False, soft_wrap=True)
        self._warnings_shown = len(run.warnings)
        now = time.perf_counter()
        last = bool(run.stopped)
        if self._bar is not None:
            if last or now - self._shown >= _BAR_SECONDS:
                self._shown = now
                self._bar.update(self._bar.task_ids[0], completed=run.progress(), description=self._line(run, record))
                self._bar.refresh()
            if last:
                self._close()
        elif last or now - self._shown >= _LINE_SECONDS:
            self._print(self._line(run, record))

    def on_end(self, run: Run, result: Result) -> None:
        self._close()

    # ------------------------------------------------------------------ the parts

    def _open(self, name: str, total: float | None) -> None:
        """Open a bar, which is animated if the total is unknown."""
        self._close()
        columns = BarColumn(bar_width=20), TextColumn("{task.description}", markup=False)
        self._bar = Bar(*columns, console=self._console, transient=True, auto_refresh=total is None)
        self._bar.start()
        self._bar.add_task(name, total=total)

    def _close(self) -> None:
        if self._bar is not None:
            self._bar.stop()
            self._bar = None

    def _print(self, line: str) -> None:
        self._shown = time.perf_counter()
        self._console.print(line, markup=False, highlight=False, soft_wrap=True)
        self._console.file.flush()

    def _line(self, run: Run, record: dict[str, Any]) -> str:
        parts = [f"step {run.step}" + (f"/{run.steps}" if run.steps else "")]
        if self._loss is not None:
            steps = f" (mean of ~{round(1 / _SMOOTHING)} steps)" if run.step > 1 else ""
            parts.append(f"loss {self._loss:.4g}{steps}")
        if self._error:
            parts.append("error " + ", ".join(f"{error:.3g}" for error in self._error.values()))
        if record["gradient_noise"] is not None:
            parts.append(f"noise {100 * record['gradient_noise']:.0f}%")
        if run.clock > 0:
            parts.append(f"{_count(record['samples'] / run.clock)} samples/s")
        if run.skipped:
            parts.append(f"{run.skipped} skipped")
        done = run.progress()
        if done > self._before and not run.stopped:
            left = (time.perf_counter() - self._started) * (1 - done) / (done - self._before)
            parts.append(f"{int(left) // 60}:{int(left) % 60:02d} left")
        return "  ".join(parts)


def _count(number: float) -> str:
    for size, letter in ((1e9, "G"), (1e6, "M"), (1e3, "k")):
        if number >= size:
            return f"{number / size:.3g}{letter}"
    return f"{number:.3g}"
