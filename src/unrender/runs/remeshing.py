"""Remeshing during a run: replacement of the problem, the parameters and the states."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from unrender.core import arrays
from unrender.core.errors import InputError
from unrender.optimizers.partitioned import PartitionedState
from unrender.rendering.picture_format import format_of
from unrender.rendering.renderer import Remeshable, ReplacedMesh
from unrender.runs.folder.meshes import arrays_of
from unrender.runs.hooks import Hook
from unrender.runs.noise import GradientNoise
from unrender.scene.problem import Problem
from unrender.scene.upsampling import restarted

if TYPE_CHECKING:
    from unrender.runs.loop import Descent


def remeshed(problem: Problem, meshes: Mapping[str, ReplacedMesh]) -> Problem:
    """Return the same problem with other meshes, {key of vertex positions: mesh}, which are also the initial values of these parameters.

    Raises `InputError` if the renderer does not support it.
    """
    if not isinstance(problem.renderer, Remeshable):
        raise InputError(f"{', '.join(meshes)}: this renderer does not support remeshing")
    schedules = [
        replace(p, initial=meshes[p.key].vertices.reshape(-1).astype(np.float32)) if p.key in meshes else p
        for p in problem.parameters
    ]
    shapes = {key.rpartition(".")[0]: mesh for key, mesh in meshes.items()}
    renderer = problem.renderer.with_meshes(shapes, [p.key for p in schedules])
    # Checked views are RGB; films of other formats would misinterpret them.
    plain = all(format_of(renderer, view.sensor).colour == "rgb" for view in problem.views)
    made = Problem(
        renderer,
        schedules,
        problem.views if plain else problem.given_views,
        problem.loss,
        problem.max_depth,
        truth={key: value for key, value in problem.truth.items() if key not in meshes},
        name=problem.name,
        surfaces={key: unknown.surface for key, unknown in problem.unknowns.items() if unknown.surface is not None},
    )
    return made.with_parts(
        origin=problem.origin, executor=problem.executor, remeshed_from=problem.remeshed_from or problem
    )


class MeshRefinement(Hook):
    """Hook that remeshes before the steps in `Parameter.remeshing`. Compiling new kernels counts as warm-up.

    If a mesh cannot be remeshed, it stays unchanged, with a warning.
    """

    def __init__(self) -> None:
        self._made: dict[str, int] = {}

    def before_step(self, descent: Descent) -> None:
        run, state = descent.run, descent.state
        remeshings = {key: unknown.remeshing for key, unknown in run.problem.unknowns.items()}
        due = {
            key: remeshing
            for key, remeshing in remeshings.items()
            if remeshing is not None and run.step in remeshing.steps
        }
        if not due:
            return
        started, meshes = time.perf_counter(), {}
        for key, remeshing in due.items():
            vertices = arrays.numpy(run.parameters[key]).reshape(-1, 3)
            try:
                mesh = remeshing.apply(vertices, run.problem.faces[key], run.problem.texture_coordinates(key))
            except InputError as error:
                run.warnings.append(f"step {run.step}: {key}: {error}; the mesh is unchanged")
                continue
            meshes[key] = mesh
            self._made[key] = len(mesh.faces)
        if not meshes:
            return
        run.problem = remeshed(run.problem, meshes)
        unchanged = {key: arrays.numpy(value) for key, value in run.parameters.items() if key not in meshes}
        values = {key: unchanged.get(key, run.problem.unknowns[key].initial) for key in run.parameters}
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
        if self._made:
            record["faces"] = dict(self._made)
            self._made = {}
