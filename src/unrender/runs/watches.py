"""Hooks that warn of parameters without influence, numbers left at their bounds, and faulty meshes."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from unrender.core import arrays, memory
from unrender.estimators.base import Estimate
from unrender.estimators.capabilities import BlockEstimate
from unrender.runs.hooks import Hook
from unrender.scene.self_intersections import crossing_triangles
from unrender.scene.surfaces import folds

if TYPE_CHECKING:
    from unrender.runs.loop import Descent
    from unrender.runs.run import Run


_NEAR = 0.01
"""Of a range with two ends: so near to one of them counts as there."""


class BoundsWatch(Hook):
    """Warns of single numbers that began inside of a range with two ends, and end next to one of these.

    There, a derivative may vanish or be mostly noise, so that a descent that overshot does not come back.
    """

    def warnings(self, descent: Descent) -> list[str]:
        run, found = descent.run, []
        for key, unknown in run.problem.unknowns.items() if run.stopped else ():
            first, (low, high) = unknown.initial, unknown.bounds
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


_STEPS = 5


class InfluenceWatch(Hook):
    """Warns of parameters whose gradient was exactly zero in each of the first five steps. Parameters that wait for a later step are left
    out: nothing was estimated of them.
    """

    def on_update(self, descent: Descent, estimate: Estimate, applied: bool) -> None:
        run, zero = descent.run, descent.state.zero_gradient
        if not applied or run.step > _STEPS:
            return
        block = estimate.get(BlockEstimate)
        waiting = block.keys if block is not None and block.estimate is None else ()
        for key, gradient in estimate.gradient.items():
            zero[key] = zero[key] and key not in waiting and arrays.number(memory.square(gradient)) == 0.0
            if zero[key] and run.step == _STEPS:
                run.warnings.append(
                    f"parameter {key}: its gradient is zero so far; it does not seem to influence the images"
                )


_EVERY, _TRIANGLES = 25, 100
"""Steps between two looks for self-intersections: so many, or one for so many triangles, where that is more."""


class MeshWatch(Hook):
    """Warns of meshes that no picture shows any more, of those that pass through themselves, and at the end of those that fold over, where
    they did not at the start."""

    def __init__(self) -> None:
        self._seen: set[str] = set()
        self._crossing: set[str] = set()

    def on_update(self, descent: Descent, estimate: Estimate, applied: bool) -> None:
        run = descent.run
        for key, faces in run.problem.faces.items() if applied else ():
            # None of estimators that have losses alone, or directions in its place.
            gradient = estimate.gradient.get(key)
            shown = gradient is not None and arrays.number(memory.square(gradient)) > 0.0
            if shown:
                self._seen.add(key)
            elif gradient is not None and key in self._seen:
                self._seen.discard(key)
                run.warnings.append(
                    f"step {run.step}: {key}: its gradient has become zero: the mesh has left the pictures, or is hidden"
                )
            if run.step % max(_EVERY, len(faces) // _TRIANGLES) == 0 and (line := self._crosses(run, key)):
                run.warnings.append(f"step {run.step}: {line}")

    def warnings(self, descent: Descent) -> list[str]:
        run, found = descent.run, []
        for key in run.problem.faces if run.stopped else ():
            before, after, joined = _joined(run, key)
            if (count := folds(after, joined)) > folds(before, joined):
                found.append(
                    f"{key}: the mesh folds over at {count} edges: a lower learning rate, or a larger λ of LargeSteps, keeps it smooth"
                )
            if line := self._crosses(run, key):
                found.append(line)
        return found

    def _crosses(self, run: Run, key: str) -> str:
        """The line on a mesh that passes through itself; "" where it does not, did so no less at the start, or the line was written."""
        if key in self._crossing or run.problem.unknowns[key].given.self_intersection == "ignore":
            return ""
        before, after, joined = _joined(run, key)
        count = len(crossing_triangles(after, joined))
        if count == 0 or count <= len(crossing_triangles(before, joined)):
            return ""
        self._crossing.add(key)
        return (
            f"{key}: the mesh passes through itself at {count} pairs of triangles: a lower learning rate or a larger λ of LargeSteps, "
            'or self_intersection = "prevent" of the parameter'
        )


def _joined(run: Run, key: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Vertices (V, 3) at the start and now, and the faces (F, 3), without seams."""
    start, end = (
        np.asarray(x).reshape(-1, 3) for x in (run.problem.unknowns[key].initial, arrays.numpy(run.parameters[key]))
    )
    _, first, places = np.unique(start, axis=0, return_index=True, return_inverse=True)
    return start[first], end[first], places.reshape(-1)[run.problem.faces[key]]
