"""Meshes that fold over, pass through themselves, or leave the pictures, while a run goes on."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from unrender.core import arrays, memory
from unrender.estimators.base import Estimate
from unrender.runs.hooks import Hook
from unrender.scene.self_intersections import crossing_triangles
from unrender.scene.surfaces import folds

if TYPE_CHECKING:
    from unrender.runs.loop import Descent
    from unrender.runs.run import Run

__all__ = ["MeshWatch"]

_EVERY, _TRIANGLES = 25, 100
"""Steps between two looks for self-intersections: so many, or one for so many triangles, where that is more."""


class MeshWatch(Hook):
    """Warns of meshes that no picture shows any more, of those that pass through themselves, and at the end of those that fold over, where
    they did not at the start."""

    def __init__(self) -> None:
        self._seen: set[str] = set()
        self._crossing: set[str] = set()

    def on_update(self, descent: Descent, estimate: Estimate, applied: bool) -> None:
        """See `Hook.on_update`."""
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
        """See `Hook.warnings`."""
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
        if key in self._crossing or run.problem.self_intersections[key] == "ignore":
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
        np.asarray(x).reshape(-1, 3) for x in (run.problem.initial_values()[key], arrays.numpy(run.parameters[key]))
    )
    _, first, places = np.unique(start, axis=0, return_index=True, return_inverse=True)
    return start[first], end[first], places.reshape(-1)[run.problem.faces[key]]
