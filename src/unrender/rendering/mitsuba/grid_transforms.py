"""Where the extinction grids of a scene's media lie, read from the scene's description: live volumes do not tell their transforms."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

from unrender.core.errors import InputError
from unrender.io.volumes import read_grid
from unrender.rendering.mitsuba.description import parse
from unrender.rendering.mitsuba.scene_graph import all_shapes

__all__ = ["MediumKey", "attached_media", "extinction_transforms"]

MediumKey = tuple[str, str, int]
"""The id of a shape or sensor; "interior", "exterior" or "medium"; how many of the same name came before, since shapes of an XML file may
have no id."""


def attached_media(scene: mi.Scene) -> list[tuple[MediumKey, Any]]:
    """All participating media of a scene, once for each shape side or sensor that has one, in an order that two loads share."""
    shapes, sensors = all_shapes(scene), scene.sensors()
    found = [
        ((shape.id(), side), medium)
        for shape in shapes
        for side, medium in (("interior", shape.interior_medium()), ("exterior", shape.exterior_medium()))
    ]
    found += [((sensor.id(), "medium"), sensor.get_medium()) for sensor in sensors]
    return _numbered((owner, medium) for owner, medium in found if medium is not None)


def _numbered(slots: Iterable[tuple[tuple[str, str], Any]]) -> list[tuple[MediumKey, Any]]:
    before: Counter[tuple[str, str]] = Counter()
    found = []
    for owner, held in slots:
        found.append(((*owner, before[owner]), held))
        before[owner] += 1
    return found


def extinction_transforms(description: Path | Mapping[str, Any]) -> dict[MediumKey, np.ndarray]:
    """The affine map (4, 4) from [0, 1]³ to the world of each medium's extinction grid.

    Args:
        description: an XML file or a Mitsuba dictionary, of a scene that Mitsuba loads.

    Media and volumes that are ready-made objects have none.
    """
    nodes: Any = parse(description).state.nodes
    top = list(_children(nodes, nodes[0]).values())
    groups = [node for node in top if node.props.plugin_name() == "shapegroup"]
    slots = []
    for node in (*top, *(child for group in groups for child in _children(nodes, group).values())):
        if node.type in (mi.ObjectType.Shape, mi.ObjectType.Sensor):
            for name, child in _children(nodes, node).items():
                side = name if node.type == mi.ObjectType.Shape else "medium"
                # The parser does not know the type of media that are plugins in Python.
                if child.type == mi.ObjectType.Medium or side in ("interior", "exterior") or "sigma_t" in child.props:
                    owner = node.props.id(), side
                    slots.append((owner, _transform(nodes, child)))
    return {key: matrix for key, matrix in _numbered(slots) if matrix is not None}


def _children(nodes: Any, node: Any) -> dict[str, Any]:
    """The nodes that a node holds, by property."""
    props = node.props
    resolved = mi.Properties.Type.ResolvedReference
    return {name: nodes[props[name].index()] for name in props.keys() if props.type(name) == resolved}  # noqa: SIM118


def _transform(nodes: Any, medium: Any) -> np.ndarray | None:
    volume = _children(nodes, medium).get("sigma_t")
    if volume is None or volume.props.plugin_name() != "gridvolume":
        return None
    props = volume.props
    to_world = np.eye(4)
    if "to_world" in props:
        to_world = np.array(props["to_world"].matrix, np.float64).reshape(4, 4)
    if props.get("use_grid_bbox", False) and "filename" in props:
        try:
            box = np.array(read_grid(props["filename"]).box).reshape(2, 3)
        except InputError:  # found by Mitsuba on another path
            return None
        place = np.eye(4)
        place[:3, :3], place[:3, 3] = np.diag(box[1] - box[0]), box[0]
        return to_world @ place
    return to_world
