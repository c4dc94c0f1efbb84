"""Elements of the scenes and problem files that imports write."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as Xml

import numpy as np
import tomli_w

from unrender.app.evaluation.scenes import HELD_OUT
from unrender.app.exporting.ready_made import file_name
from unrender.display.pictures import png
from unrender.io import toml_lines
from unrender.rendering.photographs import OF_PHOTOGRAPHS

PROBLEM, SCENE = "problem.toml", "scene.xml"
REFERENCES, MASKS, TEXTURES = "references", "masks", "textures"
"""Folder names of an import."""


def problem_text(
    name: str, views: Sequence[dict[str, Any]], held_out: bool, parameters: Sequence[dict], loss: Any, max_depth: int
) -> str:
    """Return a problem file. `views` and `parameters` are its tables, `loss` its loss; `held_out` marks it for evaluation only."""
    head = {
        "scene": SCENE,
        "name": f"{name} (held out)"[:200] if held_out else name[:200],
        "max_depth": max_depth,
        "loss": loss,
    }
    tables = [("parameters", table) for table in parameters] + [("views", view) for view in views]
    what = "Held-out photographs, for evaluation only." if held_out else "Photographs to recover an asset from."
    # Write each table under its own heading for readability; tomli_w would write one line per table.
    parts = [f"# {what} Written by `unrender import`.\n", tomli_w.dumps(head)]
    parts += [toml_lines.array_table(heading, table) for heading, table in tables]
    return "\n".join(parts)


def write_problems(
    folder: Path, name: str, views: Sequence[tuple[bool, dict]], parameters: Sequence[dict], loss: Any, max_depth: int
) -> None:
    """Write problem.toml of the training views and held-out.toml of the others, as far as there are any.

    `views` are (whether it is held out, its table). Unknowns of the photographs do not apply to other photographs.
    """
    for held_out, file in ((False, PROBLEM), (True, HELD_OUT)):
        listed = [table for apart, table in views if apart == held_out]
        moved = [table for table in parameters if not (held_out and table["key"] in OF_PHOTOGRAPHS)]
        if listed and moved:
            text = problem_text(name, listed, held_out, moved, loss, max_depth)
            (folder / file).write_text(text, encoding="utf-8")


def stems(names: Iterable[str]) -> list[str]:
    """Return the names of the files of some photographs, without their endings."""
    return [f"{index:04d}-{file_name(Path(name).stem)}" for index, name in enumerate(names)]


def views(
    held_out: Iterable[bool], stems: Iterable[str], masks: Iterable[str], known: Iterable[dict[str, Any]]
) -> list[tuple[bool, dict[str, Any]]]:
    """Return whether each view is held out, and its table with its own sensor, the stem of its mask, "" for none, and `known` fields."""
    listed = []
    for index, (apart, stem, mask, own) in enumerate(zip(held_out, stems, masks, known, strict=True)):
        fields: dict[str, Any] = {"reference": f"{REFERENCES}/{stem}.exr", "sensor": index}
        listed.append((apart, fields | ({"mask": f"{MASKS}/{mask}.png"} if mask else {}) | own))
    return listed


def turned_light(rotations: np.ndarray) -> list[dict[str, Any]]:
    """Return the fields of views with which the light has these rotations (N, 3, 3), where the scene's light has the first."""
    from scipy.spatial.transform import Rotation

    vectors = Rotation.from_matrix(rotations @ rotations[0].T).as_rotvec()
    return [{"with": {"light.rotation": vector.tolist()}} for vector in vectors]


def encoded(scene: Xml.Element) -> bytes:
    Xml.indent(scene)
    return Xml.tostring(scene, encoding="utf-8", xml_declaration=True) + b"\n"


def add_film(sensor: Xml.Element, width: int, height: int) -> None:
    """Add an RGB film with a box filter."""
    film = Xml.SubElement(sensor, "film", type="hdrfilm")
    add_value(film, "integer", "width", width)
    add_value(film, "integer", "height", height)
    add_value(film, "string", "pixel_format", "rgb")
    Xml.SubElement(film, "rfilter", type="box")


def add_pose(parent: Xml.Element, matrix: np.ndarray) -> None:
    """Add `to_world`, (3, 3) or (4, 4)."""
    transform = Xml.SubElement(parent, "transform", name="to_world")
    Xml.SubElement(transform, "matrix", value=" ".join(map(repr, matrix.ravel().tolist())))


def write_mask(weights: np.ndarray, path: Path) -> None:
    """Write pixel weights (H, W) in [0, 1] as a PNG file of three equal channels."""
    path.write_bytes(png(np.repeat(weights[..., None], 3, 2).astype(np.float32)))


def add_value(parent: Xml.Element, kind: str, name: str, value: object) -> None:
    """Add a property of a plugin; `kind` is "string", "float", ..."""
    text = repr(value) if isinstance(value, float) else str(value)
    Xml.SubElement(parent, kind, name=name, value=text)


def add_texture(parent: Xml.Element, name: str, file: str, raw: bool, pixels: bool = False) -> None:
    """Add a bitmap texture as the property `name` of a BSDF.

    The values of `raw` textures are not colours. Texels that are `pixels` of a picture, whose first row is at v = 1, are not interpolated.
    """
    texture = Xml.SubElement(parent, "texture", type="bitmap", name=name)
    for key, value in (("filename", f"{TEXTURES}/{file}"), ("format", "variant"), ("wrap_mode", "clamp")):
        add_value(texture, "string", key, value)
    if raw:
        add_value(texture, "boolean", "raw", "true")
    if pixels:
        add_value(texture, "string", "filter_type", "nearest")
        transform = Xml.SubElement(texture, "transform", name="to_uv")
        Xml.SubElement(transform, "scale", x="1", y="-1")
        Xml.SubElement(transform, "translate", x="0", y="1")
