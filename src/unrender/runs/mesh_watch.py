"""Meshes that fold over, or leave the pictures, while a run goes on."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from unrender.core import arrays
from unrender.estimators.base import Estimate
from unrender.evaluation.surfaces import folds
from unrender.runs.hooks import Hook

if TYPE_CHECKING:
    from unrender.runs.loop import Descent

__all__ = ["MeshWatch"]


class MeshWatch(Hook):
    """Warns of meshes that no picture shows any more, and at the end of those that fold over where they did not at the start."""

    def __init__(self) -> None:
        self._seen: set[str] = set()

    def on_update(self, descent: Descent, estimate: Estimate, applied: bool) -> None:
        """See `Hook.on_update`."""
        run = descent.run
        for key in run.problem.faces if applied else ():
            gradient = estimate.gradient[key]
            if arrays.number(arrays.total(gradient * gradient)) > 0.0:
                self._seen.add(key)
            elif key in self._seen:
                self._seen.discard(key)
                run.warnings.append(
                    f"step {run.step}: {key}: its gradient has become zero: the mesh has left the pictures, or is hidden"
                )

    def warnings(self, descent: Descent) -> list[str]:
        """See `Hook.warnings`."""
        run, found = descent.run, []
        for key, faces in run.problem.faces.items() if run.stopped else ():
            start, end = (
                np.asarray(x).reshape(-1, 3)
                for x in (run.problem.initial_values()[key], arrays.numpy(run.parameters[key]))
            )
            _, places = np.unique(start, axis=0, return_inverse=True)
            joined = places.reshape(-1)[faces]
            first = np.unique(joined, return_index=True)
            before, after = np.zeros((joined.max() + 1, 3)), np.zeros((joined.max() + 1, 3))
            for of, vertices in ((before, start), (after, end)):
                of[first[0]] = vertices[faces.reshape(-1)[first[1]]]
            if (count := folds(after, joined)) > folds(before, joined):
                found.append(
                    f"{key}: the mesh folds over at {count} edges: a lower learning rate, or a larger λ of LargeSteps, keeps it smooth"
                )
        return found
