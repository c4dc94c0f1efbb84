"""Evaluation of the result of a run on held-out photographs."""

from __future__ import annotations

import json
import math
import tempfile
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

from unrender.app.evaluation import scenes
from unrender.app.evaluation.measures import (
    FOLDER,
    SHEET,
    Albedo,
    Measures,
    best_factors,
    compare_albedo,
    environment_picture,
    mean,
    measure,
    names_of,
    write_pictures,
)
from unrender.app.exporting.asset import read_environment
from unrender.app.stages import stages_file
from unrender.backend import variant
from unrender.core import arrays, checks, phases
from unrender.core.errors import InputError, prefixed
from unrender.core.exclusive import exclusive
from unrender.io import files
from unrender.io.images import luminance
from unrender.io.images import write as write_image
from unrender.losses import metrics
from unrender.rendering.camera_poses import POSES
from unrender.rendering.exposure import EXPOSURE, VIGNETTING, falloff
from unrender.rendering.mitsuba.renderer import MitsubaRenderer
from unrender.rendering.photographs import OF_PHOTOGRAPHS, member_values, scene_renderer
from unrender.rendering.picture_format import format_of
from unrender.rendering.response import RESPONSE, curve
from unrender.runs import reopen
from unrender.runs.folder import reader as folders
from unrender.runs.folder import schema
from unrender.runs.folder.reader import RunFolder
from unrender.scene.parameter import Parameter
from unrender.scene.problem import Problem
from unrender.scene.render import render

RECORD, LIGHT = "judge.json", "environment"
_OWN = {RECORD, SHEET, FOLDER, f"{LIGHT}.png", f"{LIGHT}.exr"}
_ALBEDO = ("base_color", "reflectance")


@dataclass(frozen=True)
class Judgement:
    """The result of an evaluation.

    Attributes:
        folder: the folder of judge.json, sheet.png, pictures/ and, for a scene with an environment map, environment.png and
            environment.exr.
        measures: measures of the photographs; empty under another light than that of the photographs.
        albedo: errors of the base colour; None if the truth is unknown.
    """

    folder: Path
    names: tuple[str, ...]
    measures: tuple[Measures, ...]
    albedo: Albedo | None
    notices: tuple[str, ...]

    @property
    def mean(self) -> dict[str, float | None]:
        """Means of psnr, ssim and lpips over the photographs."""
        return mean(list(self.measures)) if self.measures else {}


@exclusive("judge")
def judge(
    run: str | Path,
    held_out: str | Path | None = None,
    environment: str | Path | None = None,
    spp: int = 64,
    out: str | Path | None = None,
    overwrite: bool = False,
) -> Judgement:
    """Render the result of a run for held-out photographs and measure the differences.

    Args:
        run: a run folder.
        held_out: a problem file with the photographs; None for held-out.toml next to the problem file of the run or its stages.
        environment: an environment map that replaces the light. Nothing is measured then, unless `held_out` is given: its photographs
            must have been taken under this light, which has the axes of the world of the scene.
        spp: samples per pixel.
        out: the new folder; None for the folder judge in the run folder.
        overwrite: whether an earlier evaluation may be replaced.

    Raises:
        InputError: no result, no held-out problem, a scene without the parameters of the run, or `out` cannot be written.
    """
    variant.ensure()
    spp = checks.integer("judge", "spp", spp, at_least=1)
    run = checks.path("judge: run", run, "a run folder")
    place = run / "judge" if out is None else checks.path("judge: out", out)
    files.check_replaceable(place, _OWN, RECORD, overwrite, f"--out {place}", "an earlier judgement")
    light = None if environment is None else scenes.read_light(checks.path("judge: environment", environment, "a file"))
    problem, result = reopen.problem_of(run), folders.read(run)
    given = "judge: held_out", held_out, "a file"
    held_out_file = scenes.find(run, problem) if held_out is None else checks.path(*given)
    values, truth = _recovered(run, problem, result)
    of_camera = {key: values[key] for key in (VIGNETTING, RESPONSE) if key in values}
    target, values, notices = _problem(problem, held_out_file, values, result)
    measured = light is None or held_out is not None
    exposed = any(parameter.key == EXPOSURE for parameter in problem.parameters)
    notices += [*reopen.scene_changes(problem, result), *(_unknown_of_photographs(problem) if measured else [])]

    def fill(folder: Path) -> tuple[list[Measures], Albedo | None]:
        with tempfile.TemporaryDirectory() as scratch:
            images, relit, albedo = _render(target, values, truth, light, not measured, spp, Path(scratch), folder)
        if measured and light is not None:
            # as the films of the views store them, which their photographs contain
            grey = [format_of(target.renderer, view.sensor).colour == "luminance" for view in target.views]
            images = [np.repeat(luminance(x), 3, axis=2) if of else x for x, of in zip(relit, grey, strict=True)]
            relit = []
        if measured:
            images = _photographed(target, images, of_camera, exposed)
        measures = _measure(target, images) if measured else []
        write_pictures(folder, target, images, relit, measures)
        record = _record(target, measures, albedo, held_out_file, environment, spp, notices)
        (folder / RECORD).write_text(json.dumps(record, indent=2, allow_nan=False) + "\n", encoding="utf-8")
        return measures, albedo

    measures, albedo = files.write_folder(place, fill, f"judge: {place}")
    if measured and not metrics.available():
        notices.append(metrics.MISSING)
    if not measured:
        notices.append("nothing is measured: the photographs show another light; see --held-out")
    return Judgement(place, tuple(names_of(target)), tuple(measures), albedo, tuple(notices))


def _recovered(run: Path, problem: Problem, result: RunFolder) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Return the recovered values of a run, and the known true values; ties are expanded to their members.

    For a stage, the values include those of earlier stages, which are part of its scene.
    """
    full = problem.full(result.parameters)
    values, truth = (member_values(problem.renderer, each) for each in (full, result.truth))
    staged = stages_file.stage_of(run)
    if staged is None:
        return values, truth
    stages, last = staged
    unknowns = [key for stage in stages.stages[:last] for key in stage.unknowns if key not in full]
    if not unknowns:
        return values, truth
    renderer = Problem.from_file(stages.problem).renderer
    earlier = list(member_values(renderer, dict.fromkeys(unknowns, np.zeros(()))))
    there = problem.renderer.parameters()
    for key in earlier:
        if key not in there:
            raise InputError(f"{run}: the scene of this stage has no {key}, which an earlier stage recovered")
    for index in range(last):
        folder = stages_file.folder_of(stages, index, run.resolve().parent)
        if (folder / schema.RECORD).is_file():
            known = member_values(renderer, folders.read(folder).truth)
            truth = {key: value for key, value in known.items() if key in earlier} | truth
    own = problem.renderer.values(earlier)
    return {key: arrays.numpy(value) for key, value in own.items()} | values, truth


def _problem(
    problem: Problem, held_out: Path, parameters: Mapping[str, np.ndarray], run: RunFolder
) -> tuple[Problem, dict[str, np.ndarray], list[str]]:
    """Return the problem with the held-out views, the values of its parameters, and the notices."""
    other = Problem.from_file(held_out, partial=True)
    known = scene_renderer(other.renderer).parameters()
    shared = [key for key in parameters if key in known]
    if not shared:
        raise InputError(f"{held_out}: its scene has none of the run's parameters, such as {problem.parameters[0].key}")
    left_out = [key for key in parameters if key not in known and key not in OF_PHOTOGRAPHS]
    notices = [f"{', '.join(left_out)}: not in the scene of {held_out.name}, left out"] if left_out else []
    bounds = {parameter.key: parameter.bounds for parameter in problem.parameters if parameter.keys is None}
    plain = [Parameter(key, bounds=bounds.get(key)) for key in shared]
    target = Problem(
        other.origin["scene"], plain, other.original_views, max_depth=problem.max_depth, name=other.name, partial=True
    )
    if not isinstance(target.renderer, MitsubaRenderer):
        raise InputError(f'{held_out}: judge does not support views with their own "with" or "scene"; leave them out')
    target = reopen.with_meshes(target, run)
    values = {key: parameters[key] for key in shared}
    for key, shape in target.shapes().items():
        if shape != np.shape(values[key]):
            raise InputError(f"{held_out}: {key} has shape {shape}, the run's {np.shape(values[key])}")
    return target, values, notices


def _render(
    problem: Problem,
    values: dict[str, np.ndarray],
    truth: Mapping[str, np.ndarray],
    light: np.ndarray | None,
    upright: bool,
    spp: int,
    scratch: Path,
    folder: Path,
) -> tuple[list[np.ndarray], list[np.ndarray], Albedo | None]:
    """Return the pictures of all views, those under another light, and the errors of the base colour; write the pictures of the light.

    `upright`: whether the other light is rotated so that its sky is in the direction of the cameras' up axes.
    """
    with phases.phase("pictures") as advance:
        images = []
        for view in range(len(problem.views)):
            images.append(render(problem, values, view, spp))
            advance((view + 1) / len(problem.views))
    renderer: Any = problem.renderer
    if renderer.pair.emissive:
        if light is not None:
            raise InputError(f"{problem.name}: an emissive medium cannot be lit otherwise")
        return images, [], None
    path = scenes.export_scene(problem, values, scratch / "scene")
    own, _ = read_environment(scenes.load_scene(path), [])
    if own is not None:
        (folder / f"{LIGHT}.png").write_bytes(environment_picture(own))
        write_image(own, folder / f"{LIGHT}.exr")
    relit = []
    if light is not None:
        up = scenes.turned_up(scenes.up_axis(scenes.sensors(problem))) if upright else None
        scene = scenes.load_scene(path, light, up)
        sensors = scene.sensors()
        with phases.phase("other light") as advance:
            for index, view in enumerate(problem.original_views):
                relit.append(scenes.render(scene, sensors[view.sensor], spp, problem.max_depth)[..., :3])
                advance((index + 1) / len(problem.views))
    return images, relit, _albedo(problem, values, truth, path, scratch)


def _albedo(
    problem: Problem, values: dict[str, np.ndarray], truth: Mapping[str, np.ndarray], path: Path, scratch: Path
) -> Albedo | None:
    known = {key: value for key, value in truth.items() if key in values and any(name in key for name in _ALBEDO)}
    if not known:
        return None
    other = scenes.export_scene(problem, values | known, scratch / "truth")
    sensors, pixels = scenes.sensors(problem), []
    masks = [view.pixel_weights() for view in problem.views]
    integrator = mi.load_dict({"type": "aov", "aovs": "albedo:albedo"})
    for file in (path, other):
        scene = scenes.load_scene(file)
        images = [
            np.array(mi.render(scene, sensor=sensors[view.sensor], integrator=integrator, spp=16))[..., -3:][mask > 0]
            for view, mask in zip(problem.views, masks, strict=True)
        ]
        pixels.append(np.concatenate(images))
    return compare_albedo(*pixels)


def _unknown_of_photographs(problem: Problem) -> list[str]:
    """Return a line for each kind of unknown that has separate values for each photograph."""
    moved = {parameter.key for parameter in problem.parameters}
    lines = {
        EXPOSURE: "exposures of photographs were unknown: each rendering is measured after multiplication by its best factors",
        POSES: "poses of photographs were corrected; held-out photographs have uncorrected poses",
    }
    return [line for key, line in lines.items() if key in moved]


def _photographed(
    problem: Problem, images: list[np.ndarray], of_camera: Mapping[str, np.ndarray], exposed: bool
) -> list[np.ndarray]:
    """Apply vignetting, exposure and response of the camera to the renderings."""
    if VIGNETTING in of_camera:
        images = [image * falloff(of_camera[VIGNETTING], *image.shape[:2]) for image in images]
    if exposed:
        images = [_exposed(image, view) for image, view in zip(images, problem.views, strict=True)]
    if RESPONSE in of_camera:
        contrast, brightness = of_camera[RESPONSE].T
        images = [curve(contrast, brightness, image).values for image in images]
    return images


def _exposed(image: np.ndarray, view: Any) -> np.ndarray:
    mask = view.pixel_weights() > 0
    return image * best_factors(image[mask], np.asarray(view.reference)[mask])


def _measure(problem: Problem, images: list[np.ndarray]) -> list[Measures]:
    measures = []
    for name, view, image in zip(names_of(problem), problem.views, images, strict=True):
        with prefixed(name):
            measures.append(measure(image, np.asarray(view.reference), view.pixel_weights()))
    return measures


def _record(
    problem: Problem,
    measures: list[Measures],
    albedo: Albedo | None,
    held_out: Path,
    environment: str | Path | None,
    spp: int,
    notices: list[str],
) -> dict[str, Any]:
    def plain(fields: dict[str, Any]) -> dict[str, Any]:
        return {k: None if isinstance(v, float) and not math.isfinite(v) else v for k, v in fields.items()}

    return {
        "held_out": str(held_out),
        "environment": None if environment is None else str(environment),
        "spp": spp,
        "photographs": [
            {"name": name, **plain(asdict(each))} for name, each in zip(names_of(problem), measures, strict=False)
        ],
        "mean": plain(mean(measures)) if measures else None,
        "albedo": None if albedo is None else asdict(albedo),
        "notices": notices,
    }
