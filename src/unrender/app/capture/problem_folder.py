"""Views and a mesh as a problem: a Mitsuba scene, its files, and TOML files for training and held-out views."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from xml.etree import ElementTree as Xml

import numpy as np

from unrender.app.capture import unknowns, writing
from unrender.app.capture.capture import INSIDE, CapturedView, CapturedViews
from unrender.app.capture.mesh import Mesh, ply
from unrender.app.capture.silhouettes import Silhouettes, light_turns
from unrender.app.evaluation.scenes import HELD_OUT
from unrender.app.stages import stages_file
from unrender.core.errors import InputError
from unrender.core.geometry import MITSUBA_TO_OPENGL
from unrender.core.text import printable
from unrender.io import images

MESH = "asset.ply"
LIGHT = "textures/light.exr"
_FOLDERS = (writing.REFERENCES, writing.MASKS, writing.TEXTURES)
OWN = frozenset({writing.PROBLEM, HELD_OUT, writing.SCENE, MESH, stages_file.FILE, *_FOLDERS})
"""Names that `write` creates in a folder."""
_LIGHT_SIZE = 16, 32
_MAX_DEPTH = 3
_BAND_WEIGHT = 0.1
_WHITE = 0.95  # minimum linear value of a saturated pixel, below 1 since resizing averages neighbours


def write(
    folder: Path,
    name: str,
    views: CapturedViews,
    mesh: Mesh,
    silhouettes: Silhouettes,
    texture: int,
    chosen: Sequence[str] = unknowns.DEFAULT,
    band: int = 0,
    turntable: bool = False,
) -> None:
    """Write the problem of `chosen` unknowns and its stages to an empty folder, with textures of `texture` texels a side.

    Training masks have a border of `band` pixels with reduced weight. The light of a `turntable` is fixed relative to the cameras. Raises
    `InputError` if a mask covers no pixel completely.
    """
    stems = writing.stems(view.name for view in views)
    (folder / MESH).write_bytes(ply(mesh))
    turns = light_turns(np.array([view.camera_to_world for view in views])) if turntable else None
    (folder / writing.SCENE).write_bytes(_scene(views, stems, mesh, chosen, None if turns is None else turns[0]))
    for part in _FOLDERS:
        (folder / part).mkdir()
    level, clipped, brightest = [], False, 0.0
    for view, stem in zip(views, stems, strict=True):
        mask = _loss_mask(view, silhouettes)
        level.append(float(view.values[mask].mean()))
        clipped |= bool((view.values[mask] >= _WHITE).any())
        brightest = max(brightest, float(view.values.max()))
        images.write(view.values, folder / writing.REFERENCES / f"{stem}.exr", half=True)
        weights = _banded(mask, 0 if view.held_out else band)
        writing.write_mask(weights, folder / writing.MASKS / f"{stem}.png")
    for file, values in unknowns.textures(chosen, texture).values():
        images.write(values, folder / writing.TEXTURES / file)
    # Under uniform light, a surface shows its base colour times the light's radiance.
    radiance = max(float(np.median(level)) / unknowns.COLOUR, 1e-4)
    images.write(np.full((*_LIGHT_SIZE, 3), radiance, np.float32), folder / LIGHT)
    # Values above 1 cannot come from files of 8 or 16 bits.
    white = clipped and brightest <= 1.001
    loss = {"type": "Censored", "loss": "L1", "white": _WHITE} if white else "L1"
    tables = unknowns.parameters(chosen, float(np.linalg.norm(np.ptp(mesh.vertices, axis=0))))
    known = [{}] * len(views) if turns is None else writing.turned_light(turns)
    listed = writing.views((view.held_out for view in views), stems, stems, known)
    writing.write_problems(folder, name, listed, tables, loss, _MAX_DEPTH)
    note = "Each stage starts from the result of the previous stage. Run all: unrender run stages.toml"
    stages = unknowns.stages(chosen, Path(writing.PROBLEM))
    text = stages_file.text(stages, f"{note}. Written by `unrender import`.")
    (folder / stages_file.FILE).write_text(text, encoding="utf-8")


def to_world(camera_to_world: np.ndarray) -> np.ndarray:
    """Return the pose of a camera as `to_world` of Mitsuba's sensors, (4, 4)."""
    return camera_to_world @ MITSUBA_TO_OPENGL


def _loss_mask(view: CapturedView, silhouettes: Silhouettes) -> np.ndarray:
    """Return the pixels of the loss: they and their eight neighbours are covered completely by the object, the mesh and the photograph."""
    from scipy import ndimage

    inside = (view.shown > INSIDE) & silhouettes.mask(view.lens, view.camera_to_world)
    if view.mask is not None:
        inside &= view.mask > INSIDE
    mask_of_loss = ndimage.binary_erosion(inside, np.ones((3, 3)), border_value=1)
    mask_of_loss = mask_of_loss if mask_of_loss.any() else inside
    if not mask_of_loss.any():
        raise InputError(
            f"{printable(view.name)}: mesh and mask have no complete pixel in common; give a larger --resolution"
        )
    return mask_of_loss


def _banded(mask: np.ndarray, band: int) -> np.ndarray:
    """Return pixel weights: 1 inside, reduced within `band` pixels of the border."""
    from scipy import ndimage

    if not band:
        return mask.astype(np.float32)
    # The edge of the picture is not a border of the object.
    distance = ndimage.distance_transform_edt(np.pad(mask, band + 1, mode="edge"))
    assert isinstance(distance, np.ndarray)
    inner = distance[band + 1 : -band - 1, band + 1 : -band - 1] > band
    return np.where(mask, np.where(inner, 1.0, _BAND_WEIGHT), 0.0).astype(np.float32)


def _scene(
    views: CapturedViews, stems: Sequence[str], mesh: Mesh, chosen: Sequence[str], turn: np.ndarray | None
) -> bytes:
    """Return the scene. `turn` is the rotation (3, 3) of the light's map, None for none."""
    root = Xml.Element("scene", version="3.0.0")
    corners = np.array([mesh.vertices.min(0), mesh.vertices.max(0)])
    radius = float(np.linalg.norm(corners[1] - corners[0])) / 2
    distances = [float(np.linalg.norm(view.camera_to_world[:3, 3] - corners.mean(0))) for view in views]
    # Equal values for all cameras avoid one kernel per camera when views are rendered one by one.
    clip = max(min(distances) - radius, radius / 100) / 10, 10 * (max(distances) + radius)
    for view, stem in zip(views, stems, strict=True):
        root.append(sensor_element(view, stem, *clip))
    shape = Xml.SubElement(root, "shape", type="ply", id="asset")
    writing.add_value(shape, "string", "filename", MESH)
    _material(shape, chosen)
    light = Xml.SubElement(root, "emitter", type="envmap", id="light")
    writing.add_value(light, "string", "filename", LIGHT)
    if turn is not None:
        writing.add_pose(light, turn)
    return writing.encoded(root)


def _material(shape: Xml.Element, chosen: Sequence[str]) -> None:
    """Add a principled BSDF with textures of the atlas, inside a normal map if that is unknown."""
    textures = unknowns.textures(chosen, 1)
    if "normalmap" in textures:
        shape = Xml.SubElement(shape, "bsdf", type="normalmap")
        writing.add_texture(shape, "normalmap", textures.pop("normalmap")[0], raw=True)
    bsdf = Xml.SubElement(shape, "bsdf", type="principled")
    for name, (file, values) in textures.items():
        writing.add_texture(bsdf, name, file, raw=values.shape[2] == 1)
    if "roughness" not in textures:
        writing.add_value(bsdf, "float", "roughness", unknowns.ROUGHNESS)


def sensor_element(view: CapturedView, stem: str, near: float, far: float) -> Xml.Element:
    lens = view.lens
    sensor = Xml.Element("sensor", type="perspective", id=f"camera-{stem}")
    writing.add_value(sensor, "string", "fov_axis", "x")
    writing.add_value(sensor, "float", "fov", 2 * math.degrees(math.atan(lens.width / (2 * lens.fx))))
    # Mitsuba shifts the picture opposite to the principal point, in units of its sides.
    writing.add_value(sensor, "float", "principal_point_offset_x", 0.5 - lens.cx / lens.width)
    writing.add_value(sensor, "float", "principal_point_offset_y", 0.5 - lens.cy / lens.height)
    writing.add_value(sensor, "float", "near_clip", near)
    writing.add_value(sensor, "float", "far_clip", far)
    writing.add_pose(sensor, to_world(view.camera_to_world))
    writing.add_film(sensor, lens.width, lens.height)
    return sensor
