"""The problem of a stage: its unknowns start at the values of earlier stages, and its scene contains the fixed values."""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from unrender.app.exporting import scene_folder
from unrender.app.stages.stages_file import Stage, Stages
from unrender.core import arrays
from unrender.core.errors import InputError
from unrender.core.text import did_you_mean
from unrender.losses import Loss
from unrender.rendering.photographs import OF_PHOTOGRAPHS, member_values, scene_renderer
from unrender.rendering.renderer import ParameterInfo, Renderer
from unrender.rendering.worlds import WorldsRenderer
from unrender.rendering.wrapper import layers
from unrender.scene.coarse_to_fine import NEVER, CoarseToFine
from unrender.scene.parameter import Parameter, ties_of
from unrender.scene.prior import Prior
from unrender.scene.problem import Problem
from unrender.scene.references import View
from unrender.scene.view_worlds import requested_depth


@dataclass(frozen=True)
class StagedProblem:
    """A problem with the unknowns of all stages, without its scene in memory: Mitsuba compiles kernels for all loaded scenes.

    Attributes:
        scene: an XML file.
        known: the renderer's description of each unknown.
        initial: {key: array}, initial values that a scene can hold.
        given: the keys of those that the problem's scene does not have.
        scenes: keys of the parameters of each view's own scene; empty for views of the problem's scene.
    """

    scene: Path
    parameters: dict[str, Parameter]
    views: tuple[View, ...]
    loss: Loss
    max_depth: int | None
    truth: dict[str, np.ndarray]
    name: str
    known: dict[str, ParameterInfo]
    initial: dict[str, np.ndarray]
    given: frozenset[str]
    scenes: tuple[frozenset[str], ...]

    @classmethod
    def read(cls, stages: Stages) -> StagedProblem:
        """Read the problem file of the stages.

        Raises `InputError` if the file is malformed, a stage names an unknown that is no parameter of it, leaves out an unknown that no
        scene can hold, or remeshes a mesh whose first triangles later stages need; or if the scene has a transform that a stage cannot
        export.
        """
        problem = Problem.from_file(stages.problem)
        known, scene = problem.renderer.parameters(), scene_renderer(problem.renderer)
        parameters = {parameter.key: parameter for parameter in problem.parameters}
        _check(stages, parameters)
        for key in (key for key in parameters if parameters[key].keys is None and key not in OF_PHOTOGRAPHS):
            if key not in scene.parameters():
                raise InputError(f"{stages.problem}: {key} is an unknown of expressions, which stages do not support")
        initial = {key: u.initial for key, u in problem.unknowns.items() if key not in OF_PHOTOGRAPHS}
        given = frozenset(key for key, value in initial.items() if _differs(problem.renderer, key, value))
        path = Path(problem.origin["scene"])
        if _exports(stages, given):
            scene_folder.check_transforms(path)
        return cls(
            path,
            parameters,
            problem.original_views,
            problem.loss,
            requested_depth(problem.renderer, problem.original_views, problem.max_depth),
            problem.truth,
            problem.name,
            {key: replace(known[key], mesh=None) for key in parameters},
            initial,
            given,
            tuple(_keys_of_scene(problem, view) for view in range(len(problem.views))),
        )

    def of_stage(self, stage: Stage, values: Mapping[str, np.ndarray], folder: Path) -> Problem:
        """Return the problem of a stage.

        Args:
            stage: the stage; its keys are among the unknowns.
            values: {key: array} of the results of earlier stages. These, and initial values, become part of the stage's scene, and of
                the other scenes of views, where the stage does not optimise them.
            folder: folder of that scene, if one is needed; an existing scene is reused.

        Raises:
            InputError: the folder cannot be written, or a key of the stage has another name in the exported scene.
        """
        scene = self.scene
        fixed = {key: value for key, value in {**self.initial, **values}.items() if key not in stage.unknowns}
        stored = {key: value for key, value in fixed.items() if key in values or key in self.given}
        if stored:
            if not (folder / scene_folder.SCENE).is_file():
                unknowns = [Parameter(key, keys=self.parameters[key].keys) for key in stored]
                view = next((view for view in self.views if view.scene is None), self.views[0])
                problem = Problem(scene, unknowns, [view], self.loss, self.max_depth, partial=True)
                self._check_names(stage, scene_folder.export((problem, stored), folder))
            scene = folder / scene_folder.SCENE
        seen = self._seen(stage)
        views = [view for index, view in enumerate(self._views(fixed)) if seen[index]]
        problem = Problem(
            scene,
            [self._parameter(key, stage, values.get(key)) for key in stage.unknowns],
            views,
            self.loss,
            self.max_depth,
            truth={key: self.truth[key] for key in stage.unknowns if key in self.truth},
            name=f"{self.name}: {stage.name}"[:200],
        )
        left_out = [
            f"view {n} is left out: its scene has none of the unknowns of this stage"
            for n, own in enumerate(seen)
            if not own
        ]
        return problem.with_parts(notices=[*problem.notices, *left_out])

    def _seen(self, stage: Stage) -> list[bool]:
        """Return whether each view depends on the unknowns of a stage; all do if none does."""
        ties = {tie.key: tie.factors for tie in ties_of(list(self.parameters.values()))}
        members = {member for key in stage.unknowns for member in ties.get(key, [key])}
        everywhere = not members.isdisjoint(OF_PHOTOGRAPHS)
        seen = [everywhere or not keys or not members.isdisjoint(keys) for keys in self.scenes]
        return seen if any(seen) else [True] * len(seen)

    def _views(self, fixed: Mapping[str, np.ndarray]) -> list[View]:
        """Return the views; those of other scenes know the fixed values there."""
        ties = {tie.key: tie.factors for tie in ties_of(list(self.parameters.values()))}
        members = {m: f * x for key, x in fixed.items() for m, f in ties.get(key, {key: 1.0}).items()}
        known = [{key: x for key, x in members.items() if key in keys} for keys in self.scenes]
        return [
            replace(v, known={**own, **(v.known or {})}) if own else v for v, own in zip(self.views, known, strict=True)
        ]

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
        parameter = parameter if value is None else replace(parameter, initial=value, coarse_to_fine=None)
        if stage.coarser == 1 or not info.resizable:
            return parameter
        coarse = CoarseToFine((NEVER,), stage.coarser)
        return replace(parameter, coarse_to_fine=coarse if max(coarse.shape(info.shape, 0)[:-1]) > 1 else None)


def _exports(stages: Stages, given: frozenset[str]) -> bool:
    """Return whether a stage has fixed values that the problem's scene does not have, so that it needs a scene of its own."""
    stored = set(given)
    for stage in stages.stages:
        if not stored <= set(stage.unknowns):
            return True
        stored |= set(stage.unknowns)
    return False


def _keys_of_scene(problem: Problem, view: int) -> frozenset[str]:
    """Return the keys of the parameters of a view's own scene; empty for the problem's scene."""
    worlds = next((layer for layer in layers(problem.renderer) if isinstance(layer, WorldsRenderer)), None)
    if problem.original_views[view].scene is None or worlds is None:
        return frozenset()
    return frozenset(worlds.state_of(problem.views[view].sensor).renderer.parameters())


def _differs(renderer: Renderer, key: str, initial: np.ndarray) -> bool:
    """Return whether the initial value of an unknown is not that of the scene."""
    members, scene = member_values(renderer, {key: initial}), scene_renderer(renderer)
    return any(not np.array_equal(x, arrays.numpy(scene.values([name])[name])) for name, x in members.items())


def _check(stages: Stages, parameters: Mapping[str, Parameter]) -> None:
    keys = list(parameters)
    moved: dict[str, str] = {}
    known: set[str] = set()
    pulled = {key for key, own in parameters.items() if own.prior is not None and _near(own.prior) == "initial"}
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
        if key := next((key for key in pulled if key in stage.unknowns and key in known), None):
            raise InputError(
                f'stage {stage.name}: the prior of {key} is near = "initial", but a stage starts at the result of the earlier ones; '
                f"give near as numbers, or name {key} in one stage alone"
            )
        known |= set(stage.unknowns)
        moved |= {key: stage.name for key in OF_PHOTOGRAPHS if key in stage.unknowns and key not in moved}


def _near(prior: Prior | Mapping[str, Any]) -> Any:
    return prior.near if isinstance(prior, Prior) else prior.get("near")
