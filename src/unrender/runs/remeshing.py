"""A run's step to other triangles of its meshes: the problem, the parameters, and what its parts remember."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any

from unrender.core import arrays
from unrender.core.errors import InputError
from unrender.optimizers.partitioned import PartitionedState
from unrender.runs.folder.meshes import arrays_of
from unrender.runs.hooks import Hook
from unrender.runs.noise import GradientNoise
from unrender.scene.upsampling import restarted

if TYPE_CHECKING:
    from unrender.runs.loop import Descent

__all__ = ["MeshRefinement"]


class MeshRefinement(Hook):
    """Gives meshes other triangles before the steps that `Parameter.remeshing` names. Compiling kernels anew counts as warm-up.

    Where a mesh cannot be remeshed, it stays as it is, with a warning.
    """

    def __init__(self) -> None:
        self._made: dict[str, int] = {}

    def before_step(self, descent: Descent) -> None:
        """See `Hook.before_step`."""
        run, state = descent.run, descent.state
        due = [key for key, way in run.problem.remeshings.items() if run.step in way.steps]
        if not due:
            return
        started, found = time.perf_counter(), {}
        for key in due:
            vertices = arrays.numpy(run.parameters[key]).reshape(-1, 3)
            try:
                mesh = run.problem.remeshings[key].apply(
                    vertices, run.problem.faces[key], run.problem.texture_coordinates(key)
                )
            except InputError as error:
                run.warnings.append(f"step {run.step}: {key}: {error}; the mesh stays as it is")
                continue
            found[key] = mesh
            self._made[key] = len(mesh.faces)
        if not found:
            return
        run.problem = run.problem.remeshed(found)
        kept = {key: arrays.numpy(value) for key, value in run.parameters.items() if key not in found}
        values = {key: kept.get(key, run.problem.initial_values()[key]) for key in run.parameters}
        run.parameters = {key: run.problem.renderer.array(value) for key, value in values.items()}
        fresh = run.optimizer.init(run.problem.coordinates.of(run.parameters), run.problem.learning_rates)
        state.estimator = run.estimator.init(run.problem, run.parameters)
        before = state.optimizer
        state.optimizer = restarted(before, fresh)
        if isinstance(before, PartitionedState) and isinstance(fresh, PartitionedState):
            state.optimizer = PartitionedState(restarted(before.own, fresh.own), before.others)
        state.noise = GradientNoise()
        descent.log.description["meshes"] = arrays_of(run.problem, descent.log.description["meshes"])
        arrays.evaluate(run.parameters, state.estimator, state.optimizer)
        descent.log.warmup_seconds += time.perf_counter() - started + descent.warm_up()[0]

    def on_step(self, descent: Descent, record: dict[str, Any]) -> None:
        """See `Hook.on_step`."""
        if self._made:
            record["faces"] = dict(self._made)
            self._made = {}
