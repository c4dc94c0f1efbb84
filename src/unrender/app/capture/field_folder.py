"""Views as the problem of a radiance field: an emissive, absorbing cube around the common focus of the cameras, in front of a sky."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as Xml

import numpy as np

from unrender.app.capture import writing
from unrender.app.capture.capture import INSIDE, CapturedView, StoredViews
from unrender.app.capture.problem_folder import sensor_element
from unrender.app.evaluation.scenes import HELD_OUT
from unrender.app.stages import stages_file
from unrender.app.stages.stages_file import Stage, Stages
from unrender.core.errors import InputError
from unrender.io import images, volumes
from unrender.rendering.exposure import EXPOSURE
from unrender.rendering.mitsuba.emissive import COEFFICIENT

NAMES = ("field", "light", "exposure")
"""Possible unknowns of such a problem; the field is always one."""
GRIDS, EXTINCTION, LIGHT = "grids", "grids/extinction.vol", "grids/light.exr"
_HARMONICS = ["emission", *(f"{COEFFICIENT}{k}" for k in range(1, 9))]
OWN = frozenset({writing.PROBLEM, HELD_OUT, writing.SCENE, writing.REFERENCES, writing.MASKS, GRIDS, stages_file.FILE})
"""Names that `write` creates in a folder."""
_FIELD = "field"  # id of the medium in the scene
_KEYS = {
    "extinction": f"{_FIELD}.sigma_t.data",
    **{name: f"{_FIELD}.{name}.data" for name in _HARMONICS},
    "light": "light.data",
    "exposure": EXPOSURE,
}
_DEPTH = 0.5  # initial optical depth through the cube, which transmits more than half of the light
_RATES = {"extinction": 0.1, "light": 0.04, "emission": 0.04, **dict.fromkeys(_HARMONICS[1:], 0.01)}
"""Initial learning rates: of the logarithm of extinction, and of the others relative to the photographs' mean."""
_LOGARITHM = {"bounds": [0.0, math.inf], "parameterisation": "log"}
"""Options of extinction. The logarithm makes steps relative: noisy absolute steps, clamped at 0, would leave fog in rarely seen regions."""
_COARSER = 2
"""Factor by which harmonics beyond degree 0 have fewer voxels per side, from 64 voxels on. Radiance varies more with position than with
direction, and the harmonics are 24 of 28 numbers per voxel, which determine the time per step."""
_COARSEST, _COARSER_FROM = 16, 64
_METHOD = "adaptive"
_PIXELS, _PIXELS_FOR = 4096, 32
"""Pixels per step, up to this number of voxels per side. Beyond, pixels are proportional to it, since steps also have a cost per voxel."""
_SETTINGS = {"scheme": "uniform", "pixels": _PIXELS, "spp": 4, "beta_2": 0.99, "schedule": "exponential(150, 0.05)"}
"""Settings of the stages: mini-batches of pixels of all photographs, and decaying rates, since the noise does not decrease. A path is
weighted by the residual of the pixel's three other samples; with fewer samples, noise would dominate this residual."""
_LIGHT_SIZE = 16, 32


def cube_of(cameras: np.ndarray) -> tuple[np.ndarray, float]:
    """Return the centre (3,) and half the side of the cube that the cameras (V, 4, 4) look at.

    The centre is nearest to all optical axes, by least squares. Half the side is its median distance from the cameras. Raises `InputError`
    if the cameras look in parallel, or away from the centre.
    """
    places, views = cameras[:, :3, 3], -cameras[:, :3, 2]
    across = np.eye(3) - views[:, :, None] * views[:, None, :]
    normal = across.sum(0)
    if np.linalg.cond(normal) > 1e6:
        raise InputError("--field: the cameras look in parallel, at no common point")
    middle = np.linalg.solve(normal, (across @ places[:, :, None]).sum(0))[:, 0]
    if np.median(((middle - places) * views).sum(1)) <= 0:
        raise InputError(
            "--field: the cameras look away from the point that is nearest to their axes; --axes may be wrong"
        )
    return middle, float(np.median(np.linalg.norm(places - middle, axis=1)))


def write(folder: Path, name: str, views: StoredViews, voxels: int, chosen: Sequence[str]) -> None:
    """Write the problem of `chosen` unknowns, from `NAMES`, and its stages, coarse to fine, to an empty folder; masks are not used. Raises
    `InputError` if the cameras have no common focus."""
    bare = views.bare()
    middle, half = cube_of(np.array([view.camera_to_world for view in bare]))
    stems = writing.stems(view.name for view in bare)
    for part in (writing.REFERENCES, writing.MASKS, GRIDS):
        (folder / part).mkdir()
    means, masks = [], []
    for view, stem in zip(views, stems, strict=True):
        shown = view.shown > INSIDE
        if not view.held_out:
            means.append(float(view.values[shown].mean()))
        images.write(view.values, folder / writing.REFERENCES / f"{stem}.exr", half=True)
        masks.append("" if shown.all() else stem)
        if masks[-1]:
            writing.write_mask(shown, folder / writing.MASKS / f"{stem}.png")
    level = max(float(np.mean(means)), 1e-4)
    size = (voxels,) * 3
    volumes.write_grid(folder / EXTINCTION, np.full((*size, 1), _DEPTH / (2 * half), np.float32))
    coarse = (-(-voxels // (_COARSER if voxels >= _COARSER_FROM else 1)),) * 3
    for number, file in enumerate(_HARMONICS):
        values = np.zeros((*coarse, 3), np.float32) if number else np.full((*size, 3), level, np.float32)
        volumes.write_grid(folder / GRIDS / f"{file}.vol", values)
    images.write(np.full((*_LIGHT_SIZE, 3), level, np.float32), folder / LIGHT)
    (folder / writing.SCENE).write_bytes(_scene(bare, stems, middle, half))
    rates = {one: rate if one == "extinction" else rate * level for one, rate in _RATES.items()}
    bounds: dict[str, Any] = {"extinction": _LOGARITHM, "light": {"bounds": [0.0, math.inf]}}
    moved = ["extinction", *_HARMONICS, *(one for one in ("light", "exposure") if one in chosen)]
    tables = [
        {"key": _KEYS[one], **bounds.get(one, {}), **({"learning_rate": rates[one]} if one in rates else {})}
        for one in moved
    ]
    listed = writing.views((view.held_out for view in bare), stems, masks, [{}] * len(stems))
    writing.write_problems(folder, name, listed, tables, "L2", 1)
    note = "Each stage has twice the voxels a side. Run all: unrender run stages.toml. Written by `unrender import`."
    (folder / stages_file.FILE).write_text(stages_file.text(_stages(voxels, moved), note), encoding="utf-8")


def _stages(voxels: int, moved: Sequence[str]) -> Stages:
    """Return the stages from coarse to fine, in factors of 2, from about 16 voxels per side. Each takes as long as all earlier ones
    together."""
    keys, result, coarser = tuple(_KEYS[one] for one in moved), [], 1
    while voxels / coarser >= 1:
        side = -(-voxels // coarser)
        more: dict[str, Any] = {"pixels": _PIXELS * side // _PIXELS_FOR} if side > _PIXELS_FOR else {}
        result.insert(0, Stage(f"voxels-{side}", keys, 1.0, coarser, settings=more))
        if voxels // coarser <= _COARSEST:
            break
        coarser *= 2
    result[1:] = [replace(stage, share=2.0**number) for number, stage in enumerate(result[1:])]
    return Stages(Path(writing.PROBLEM), tuple(result), _METHOD, dict(_SETTINGS), seconds=600.0)


def _scene(views: Sequence[CapturedView], stems: Sequence[str], middle: np.ndarray, half: float) -> bytes:
    root = Xml.Element("scene", version="3.0.0")
    medium = Xml.SubElement(root, "medium", type="emissive", id=_FIELD)
    for name, file in (("sigma_t", EXTINCTION), *((one, f"{GRIDS}/{one}.vol") for one in _HARMONICS)):
        volume = Xml.SubElement(medium, "volume", type="gridvolume", name=name)
        writing.add_value(volume, "string", "filename", file)
        writing.add_value(volume, "boolean", "raw", "true")
        _place(volume, middle - half, 2 * half)
    shape = Xml.SubElement(root, "shape", type="cube", id="cube")
    _place(shape, middle, half)
    Xml.SubElement(shape, "bsdf", type="null")
    Xml.SubElement(shape, "ref", name="interior", id=_FIELD)
    for view, stem in zip(views, stems, strict=True):
        sensor = sensor_element(view, stem, half / 100, 100 * half)
        if np.abs(view.camera_to_world[:3, 3] - middle).max() < half:
            Xml.SubElement(sensor, "ref", id=_FIELD)
        root.append(sensor)
    light = Xml.SubElement(root, "emitter", type="envmap", id="light")
    writing.add_value(light, "string", "filename", LIGHT)
    return writing.encoded(root)


def _place(parent: Xml.Element, corner: np.ndarray, scale: float) -> None:
    transform = Xml.SubElement(parent, "transform", name="to_world")
    Xml.SubElement(transform, "scale", value=repr(scale))
    x, y, z = (repr(float(v)) for v in corner)
    Xml.SubElement(transform, "translate", x=x, y=y, z=z)
