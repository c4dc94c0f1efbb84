"""The problem of a stage: its unknowns start at the values of earlier stages, and its scene contains the fixed values."""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from unrender.app.exporting import scene_folder
from unrender.app.stages.stages_file import Stage, Stages
from unrender.core.errors import InputError
from unrender.core.text import did_you_mean
from unrender.losses import Loss
from unrender.rendering.photographs import OF_PHOTOGRAPHS
from unrender.rendering.renderer import ParameterInfo
from unrender.scene.coarse_to_fine import NEVER, CoarseToFine
from unrender.scene.parameter import Parameter
from unrender.scene.problem import Problem
from unrender.scene.view import View


@dataclass(frozen=True)
class StagedProblem:
    """A problem with the unknowns of all stages, without its scene in memory: Mitsuba compiles kernels for all loaded scenes.

    Attributes:
        scene: an XML file.
        parameters, views, loss, max_depth, truth, name: attributes of `Problem`.
        known: the renderer's description of each unknown.
    """

    scene: Path
    parameters: dict[str, Parameter]
    views: tuple[View, ...]
    loss: Loss
    max_depth: int
    truth: dict[str, np.ndarray]
    name: str
    known: dict[str, ParameterInfo]

    @classmethod
    def read(cls, stages: Stages) -> StagedProblem:
        """Read the problem file of the stages.

        Raises:
            InputError: the file is malformed, a stage names an unknown that is no parameter of it, leaves out an unknown that no scene
                can hold, or remeshes a mesh whose first triangles later stages need.
        """
        problem = Problem.from_file(stages.problem)
        known = problem.renderer.parameters()
        parameters = {parameter.key: parameter for parameter in problem.parameters}
        _check(stages, parameters)
        return cls(
            Path(problem.origin["scene"]),
            parameters,
            problem.original_views,
            problem.loss,
            problem.max_depth,
            problem.truth,
            problem.name,
            {key: replace(known[key], mesh=None) for key in parameters},
        )

    def of_stage(self, stage: Stage, values: Mapping[str, np.ndarray], folder: Path) -> Problem:
        """Return the problem of a stage.

        Args:
            stage: the stage; its keys are among the unknowns.
            values: {key: array} of the results of earlier stages; those that the stage does not optimise become part of its scene.
            folder: folder of that scene, if one is needed; an existing scene is reused.

        Raises:
            InputError: the folder cannot be written, or a key of the stage has another name in the exported scene.
        """
        scene = self.scene
        fixed = {key: value for key, value in values.items() if key not in stage.unknowns}
        if fixed:
            if not (folder / scene_folder.SCENE).is_file():
                unknowns = [Parameter(key, keys=self.parameters[key].keys) for key in fixed]
                problem = Problem(scene, unknowns, self.views[:1], self.loss, self.max_depth, partial=True)
                self._check_names(stage, scene_folder.export((problem, fixed), folder))
            scene = folder / scene_folder.SCENE
        return Problem(
            scene,
            [self._parameter(key, stage, values.get(key)) for key in stage.unknowns],
            self.views,
            self.loss,
            self.max_depth,
            truth={key: self.truth[key] for key in stage.unknowns if key in self.truth},
            name=f"{self.name}: {stage.name}"[:200],
        )

    def _check_names(self, stage: Stage, written: scene_folder.Exported) -> None:
        for key in stage.unknowns:
            if key in written.renamed:
                shutil.rmtree(written.folder)  # otherwise the next call would reuse it
                raise InputError(
                    f"stage {stage.name}: {key} is called {written.renamed[key]} in the scene with the results of earlier stages; "
                    f"give the object that it belongs to an id in {self.scene}"
                )

    def _parameter(self, key: str, stage: Stage, value: np.ndarray | None) -> Parameter:
        parameter, info = self.parameters[key], self.known[key]
        parameter = parameter if value is None else replace(parameter, initial=value)
        if stage.coarser == 1 or not info.resizable:
            return parameter
        coarse = CoarseToFine((NEVER,), stage.coarser)
        return replace(parameter, coarse_to_fine=coarse if max(coarse.shape(info.shape, 0)[:-1]) > 1 else None)


def _check(stages: Stages, parameters: Mapping[str, Parameter]) -> None:
    keys = list(parameters)
    moved: dict[str, str] = {}
    for stage in stages.stages:
        for key in stage.unknowns:
            if key not in keys:
                hint = did_you_mean(key, keys) or f" ({', '.join(keys)})"
                raise InputError(f"stage {stage.name}: {key} is no parameter of {stages.problem}{hint}")
        for key, first in moved.items():
            if key not in stage.unknowns:
                raise InputError(
                    f'stage {stage.name}: "{key}" is an unknown of stage {first}, and no scene can hold it: name it here, too'
                )
        remeshed = next((key for key in stage.unknowns if parameters[key].remeshing is not None), None)
        if remeshed and stage is not stages.stages[-1]:
            raise InputError(
                f"stage {stage.name}: {remeshed} is remeshed, and later stages know the mesh by its first triangles: move it in the last "
                "stage alone, or leave out remeshing"
            )
        moved |= {key: stage.name for key in OF_PHOTOGRAPHS if key in stage.unknowns and key not in moved}
