"""Callbacks: user code that observes a run."""

from __future__ import annotations

import math
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from unrender.core import arrays
from unrender.core.errors import InputError
from unrender.io.thumbnails import reduced
from unrender.losses.metrics import exposure, srgb

if TYPE_CHECKING:
    from unrender.runs.result import Result
    from unrender.runs.run import Run


class Callback:
    """Base class of callbacks. Override the methods of interest; the run's time does not include them.

    A callback that blocks to pause the run should check `run.stopped`, which Ctrl-C sets. The history so far is on disk (`run.folder`,
    None without a run folder).
    """

    def on_start(self, run: Run) -> None:
        """Called before the first step, or before the first step after resuming (`run.step`)."""

    def on_step(self, run: Run, record: dict[str, Any]) -> None:
        """Called after each step with its record of the history. `run.stop()` ends the run."""

    def on_end(self, run: Run, result: Result) -> None:
        """Called after the last step."""


_LARGEST = 512
_VIEWS = 8


class TensorBoard(Callback):
    """Writes event files for TensorBoard: loss, gradient noise and parameter errors at every step, and images at intervals.

    Scalars have the step on the horizontal axis: `loss`, `gradient_noise`, `samples`, `seconds` (of optimisation), and
    `parameter_error/KEY` if the truth is known. Images are those at which the loss was evaluated, `view/N`, in sRGB at their reference's
    exposure.

    Args:
        directory: folder of the event files, which is created if missing. Use one folder per run.
        picture_seconds: minimum time between images, > 0; None for no images.

    Raises:
        InputError: the package tensorboardX is missing, or the folder is not writable.
    """

    def __init__(self, directory: str | Path, picture_seconds: float | None = 10.0):
        if picture_seconds is not None and not 0 < picture_seconds < math.inf:
            raise InputError(
                f"TensorBoard: picture_seconds must be positive and finite, or None, got {picture_seconds!r}"
            )
        try:
            from tensorboardX import SummaryWriter
        except ImportError as error:
            raise InputError("TensorBoard needs another package: pip install 'unrender[tensorboard]'") from error
        try:
            self._writer = SummaryWriter(logdir=str(directory))
        except OSError as error:
            raise InputError(f"TensorBoard: {directory}: cannot be written: {error.strerror or error}") from error
        self._every = picture_seconds
        self._next = 0.0

    def on_step(self, run: Run, record: dict[str, Any]) -> None:
        scalars = {name: record.get(name) for name in ("loss", "gradient_noise", "samples", "seconds")}
        scalars |= {f"parameter_error/{key}": error for key, error in record.get("parameter_error", {}).items()}
        for name, value in scalars.items():
            if value is not None and math.isfinite(value):
                self._writer.add_scalar(name, value, record["step"])
        if self._every is not None and (run.stopped or time.monotonic() >= self._next):
            self._pictures(run, record["step"])
            self._next = time.monotonic() + self._every

    def on_end(self, run: Run, result: Result) -> None:
        del run, result
        self._writer.close()

    def _pictures(self, run: Run, step: int) -> None:
        images = run.estimate.info.get("images", {}) if run.estimate is not None else {}
        for view, image in images.items():
            reference = np.asarray(run.problem.views[view].reference)
            shown = arrays.numpy(image)
            if view < _VIEWS and shown.shape == reference.shape:
                colours = srgb(reduced(shown, _LARGEST) * exposure(reference))
                self._writer.add_image(f"view/{view}", (colours * 255 + 0.5).astype(np.uint8), step, dataformats="HWC")
