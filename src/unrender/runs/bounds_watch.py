"""Numbers that a descent leaves at their bounds."""

from __future__ import annotations

from typing import TYPE_CHECKING

from unrender.core import arrays
from unrender.runs.hooks import Hook

if TYPE_CHECKING:
    from unrender.runs.loop import Descent

__all__ = ["BoundsWatch"]

_NEAR = 0.01
"""Of a range with two ends: so near to one of them counts as there."""


class BoundsWatch(Hook):
    """Warns of single numbers that began inside of a range with two ends, and end next to one of these.

    There, a derivative may vanish or be mostly noise, so that a descent that overshot does not come back.
    """

    def warnings(self, descent: Descent) -> list[str]:
        """See `Hook.warnings`."""
        run, found = descent.run, []
        for key, (low, high) in run.problem.bounds.items() if run.stopped else ():
            first = run.problem.first_values[key]
            if first.size != 1 or low is None or high is None:
                continue
            last, near = float(arrays.numpy(run.parameters[key]).item()), _NEAR * (high - low)
            for bound in (low, high):
                if abs(last - bound) <= near < abs(float(first.item()) - bound):
                    found.append(
                        f"parameter {key}: ended at {last:.3g}, next to its bound {bound:g}: where that is not to be expected, "
                        "try another seed or a lower learning_rate"
                    )
        return found
