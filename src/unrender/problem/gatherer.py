"""The protocol of what computes a problem's gradients elsewhere."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np

__all__ = ["Gatherer"]


class Gatherer(Protocol):
    """Computes the gradient of all views, dealt to workers that keep what image estimators remember of them."""

    @property
    def variant(self) -> str:
        """Mitsuba's, of the workers; "" where it is this process's."""
        ...

    def check(self, estimator: Any) -> None:
        """Raise `InputError` for an estimator whose work cannot be dealt by views."""
        ...

    def gather(self, request: Any) -> Any:
        """What `estimators.sample_groups.gather` returns, of a `GatherRequest`. The image estimator's next state in it is a stand-in for
        what the workers keep."""
        ...

    def pilot(self, request: Any) -> list[np.ndarray]:
        """What `pixels.pixel_statistics.pilot` returns, of a `PilotRequest`."""
        ...

    def prepared(self, state: Any) -> Any:
        """An image estimator's state, a stand-in, as `ImageEstimator.prepare` returns it."""
        ...

    def collected(self, state: Any) -> Any:
        """Any state with all that the workers keep in place of its stand-ins: what one process would have. For checkpoints."""
        ...

    def snapshot(self) -> Any:
        """What the next steps depend on beside that, for checkpoints; None for nothing."""
        ...

    def restore(self, saved: Any) -> None:
        """Go on from what `snapshot` returned."""
        ...
