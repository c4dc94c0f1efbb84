"""Execution of gradient requests, in this process or in worker processes."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np


class Executor(Protocol):
    """Executor of an estimator's requests, which are plain data: `GradientRequest` or `pixel_statistics.PilotRequest`."""

    @property
    def variant(self) -> str | None:
        """Mitsuba's variant in the worker processes; None without workers."""
        ...

    def check(self, estimator: Any) -> None:
        """Raise `InputError` for an estimator that this executor does not support."""
        ...

    def estimate_gradient(self, problem: Any, request: Any) -> Any:
        """Return the `GradientSample` of a `GradientRequest`. Its image state may be a placeholder for states in the workers."""
        ...

    def trace_pilot(self, problem: Any, request: Any) -> list[np.ndarray]:
        """Return the paths of a `PilotRequest` as arrays (N, 3)."""
        ...

    def prepare_images(self, problem: Any, image: Any, state: Any) -> Any:
        """Return the state of an image estimator after `ImageEstimator.prepare`."""
        ...

    def collect(self, state: Any) -> Any:
        """Replace placeholders in a state by the workers' states, for checkpoints."""
        ...


class LocalExecutor:
    """Executor that computes everything in this process."""

    variant = None

    def check(self, estimator: Any) -> None:
        """Accept every estimator."""

    def estimate_gradient(self, problem: Any, request: Any) -> Any:
        sums = request.begin(problem)
        for index, frame in enumerate(sums.frames):
            sums.add(request.estimate_frame(problem, frame, request.key.fold(index)))
        return sums.result(problem)

    def trace_pilot(self, problem: Any, request: Any) -> list[np.ndarray]:
        return request.carry_out(problem)

    def prepare_images(self, problem: Any, image: Any, state: Any) -> Any:
        return image.prepare(problem, state)

    def collect(self, state: Any) -> Any:
        return state


LOCAL = LocalExecutor()
