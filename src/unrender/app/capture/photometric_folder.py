"""Photographs of one camera under known lights as a problem: a plate with a colour and a normal map, seen from afar.

A texel is a pixel. The plate fills the picture, faces the camera, and casts no shadow on itself: where the object does, a photograph
disagrees with the others, which the loss (L1) bears.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from xml.etree import ElementTree as Xml

import numpy as np
from scipy import ndimage

from unrender.app.capture.overlays import png
from unrender.app.capture.photometric import LitViews, least_squares
from unrender.app.capture.writing import (
    MASKS,
    PROBLEM,
    REFERENCES,
    SCENE,
    TEXTURES,
    add_texture,
    add_value,
    problem_text,
    write_exr,
)
from unrender.app.evaluation.held_out import HELD_OUT
from unrender.app.exporting.ready_made import file_name
from unrender.core.errors import InputError
from unrender.rendering.exposure import EXPOSURE
from unrender.rendering.mitsuba import turntable_light

__all__ = ["NAMES", "OWN", "write"]

NAMES = ("colour", "normal", "exposure")
"""The unknowns that such a problem may have."""
_COLOUR, _NORMAL = "base-colour.exr", "normal.exr"
OWN = frozenset({PROBLEM, HELD_OUT, SCENE, REFERENCES, MASKS, TEXTURES})
"""What `write` puts into a folder."""
_KEYS = {
    "colour": "plate.bsdf.nested_bsdf.reflectance.data",
    "normal": "plate.bsdf.normalmap.data",
    "exposure": EXPOSURE,
}
_BRIGHTEST = 0.8
"""Reflectance of the brightest pixels but one in a hundred."""
_FAR, _DISTANCE = 1e4, 100.0
"""Of the light, and of the camera in half the plate's width: nearly orthographic, and recorded kernels make its rays themselves."""


def write(folder: Path, name: str, views: LitViews, chosen: Sequence[str]) -> None:
    """Write the problem to an empty folder.

    Args:
        folder: exists.
        name: of the problem.
        views: of photographs.
        chosen: the unknowns, of `NAMES`.

    Raises:
        InputError: the mask leaves no whole pixel, or an unknown is none of such a problem.
    """
    if others := [one for one in chosen if one not in NAMES]:
        raise InputError(
            f"--unknowns {others[0]}: of one camera under known lights, expected some of {', '.join(NAMES)}"
        )
    for part in (REFERENCES, MASKS, TEXTURES):
        (folder / part).mkdir()
    inside: np.ndarray = np.asarray(ndimage.binary_erosion(views.mask > 0.999, np.ones((3, 3)), border_value=1))
    if not inside.any():
        raise InputError(f"{name}: the mask leaves no whole pixel; give a larger --resolution")
    chosen_views = views.training
    seen: np.ndarray = views.values[chosen_views]
    _, colour = least_squares(seen[:, inside], views.directions[chosen_views])
    strength = max(float(np.quantile(colour.max(1), 0.99)) / _BRIGHTEST, 1e-4)
    height, width = views.mask.shape
    write_exr(np.full((height, width, 3), np.median(colour) / strength, np.float32), folder / TEXTURES / _COLOUR)
    write_exr(np.broadcast_to(np.array([0.5, 0.5, 1.0], np.float32), (height, width, 3)), folder / TEXTURES / _NORMAL)
    (folder / SCENE).write_bytes(_scene(views, strength))
    (folder / MASKS / "mask.png").write_bytes(png(np.repeat(inside[..., None], 3, 2).astype(np.float32)))
    tables: list[list[dict[str, object]]] = [[], []]
    for index, (photograph, values) in enumerate(zip(views.names, views.values, strict=True)):
        file = f"{REFERENCES}/{index:04d}-{file_name(Path(photograph).stem)}.exr"
        write_exr(values, folder / file, half=True)
        tables[views.held_out[index]].append({"reference": file, "sensor": index, "mask": f"{MASKS}/mask.png"})
    for held_out, file in ((False, PROBLEM), (True, HELD_OUT)):
        moved = [one for one in chosen if not (held_out and one == "exposure")]
        unknowns = [{"key": _KEYS[one], **({} if one == "exposure" else {"bounds": [0.0, 1.0]})} for one in moved]
        if tables[held_out] and unknowns:
            text = problem_text(name, tables[held_out], held_out, unknowns, "L1", 2)
            (folder / file).write_text(text, encoding="utf-8")


def _scene(views: LitViews, strength: float) -> bytes:
    """The camera looks along -z at a plate of width 2; a sensor for each light, told apart by time."""
    root = Xml.Element("scene", version="3.0.0")
    height, width = views.mask.shape
    for index, photograph in enumerate(views.names):
        sensor = Xml.SubElement(
            root, "sensor", type="perspective", id=f"light-{index:04d}-{file_name(Path(photograph).stem)}"
        )
        for name in ("shutter_open", "shutter_close"):
            add_value(sensor, "float", name, float(index))
        add_value(sensor, "string", "fov_axis", "x")
        add_value(sensor, "float", "fov", 2 * math.degrees(math.atan(1 / _DISTANCE)))
        transform = Xml.SubElement(sensor, "transform", name="to_world")
        Xml.SubElement(transform, "lookat", origin=f"0, 0, {_DISTANCE:g}", target="0, 0, 0", up="0, 1, 0")
        film = Xml.SubElement(sensor, "film", type="hdrfilm")
        add_value(film, "integer", "width", width)
        add_value(film, "integer", "height", height)
        add_value(film, "string", "pixel_format", "rgb")
        Xml.SubElement(film, "rfilter", type="box")
    plate = Xml.SubElement(root, "shape", type="rectangle", id="plate")
    transform = Xml.SubElement(plate, "transform", name="to_world")
    Xml.SubElement(transform, "scale", x="1", y=repr(height / width), z="1")
    normal = Xml.SubElement(plate, "bsdf", type="normalmap")
    add_value(normal, "boolean", "use_shadowing_function", "false")
    add_texture(normal, "normalmap", _NORMAL, raw=True, pixels=True)
    add_texture(Xml.SubElement(normal, "bsdf", type="diffuse"), "reflectance", _COLOUR, raw=True, pixels=True)
    light = Xml.SubElement(root, "emitter", type=turntable_light.PLUGIN, id="light")
    add_value(light, "string", "turns", turntable_light.text(np.array([_towards(d) for d in views.directions])))
    add_value(light, "float", "distance", _FAR)
    lamp = Xml.SubElement(light, "emitter", type="directional", name="map")
    Xml.SubElement(lamp, "vector", name="direction", x="0", y="0", z="-1")
    Xml.SubElement(lamp, "rgb", name="irradiance", value=repr(np.pi * strength))
    Xml.indent(root)
    return Xml.tostring(root, encoding="utf-8", xml_declaration=True) + b"\n"


def _towards(direction: np.ndarray) -> np.ndarray:
    """The shortest rotation that takes z, from where the lamp shines, to a direction with z > 0, (3, 3)."""
    x, y, z = direction
    k = np.array([[0, 0, x], [0, 0, y], [-x, -y, 0]])
    return np.eye(3) + k + k @ k / (1 + z)
