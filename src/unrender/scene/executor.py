"""Where the gradients of a problem are computed: in this process, or elsewhere."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np


class Executor(Protocol):
    """Carries out the requests of an estimator.

    A request is data: `estimators.sample_groups.GradientRequest` or `pixels.pixel_statistics.PilotRequest`. Its
    `carry_out(problem)` computes it in this process.
    """

    @property
    def variant(self) -> str | None:
        """Mitsuba's variant in the worker processes; None where there are none."""
        ...

    def check(self, estimator: Any) -> None:
        """Raise `InputError` for an estimator that this executor does not support."""
        ...

    def estimate_gradient(self, problem: Any, request: Any) -> Any:
        """Return the `GradientSample` of a `GradientRequest`. Its image state may stand in for states that workers keep."""
        ...

    def trace_pilot(self, problem: Any, request: Any) -> list[np.ndarray]:
        """Return the paths of a `PilotRequest`, arrays (N, 3)."""
        ...

    def prepare_images(self, problem: Any, image: Any, state: Any) -> Any:
        """Return the state of an image estimator after `ImageEstimator.prepare`."""
        ...

    def collect(self, state: Any) -> Any:
        """Return a state with the workers' own states in place of what stands in for them. For checkpoints."""
        ...

    def snapshot(self) -> Any:
        """Return what the next steps depend on besides the states, for checkpoints; None for nothing."""
        ...

    def restore(self, saved: Any) -> None:
        """Continue from what `snapshot` returned."""
        ...


class LocalExecutor:
    """Computes everything in this process."""

    variant = None

    def check(self, estimator: Any) -> None:
        """Accept every estimator."""

    def estimate_gradient(self, problem: Any, request: Any) -> Any:
        return request.carry_out(problem)

    def trace_pilot(self, problem: Any, request: Any) -> list[np.ndarray]:
        return request.carry_out(problem)

    def prepare_images(self, problem: Any, image: Any, state: Any) -> Any:
        return image.prepare(problem, state)

    def collect(self, state: Any) -> Any:
        return state

    def snapshot(self) -> Any:
        return None

    def restore(self, saved: Any) -> None:
        del saved


LOCAL = LocalExecutor()
