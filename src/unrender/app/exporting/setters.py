"""Replacement of the values in the description of a scene by recovered values."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

from unrender.app.exporting.graph import Place, SceneGraph
from unrender.app.exporting.ready_made import BITMAPS, MESHES, VOLUMES, file_name
from unrender.core.errors import InputError
from unrender.io import images
from unrender.io.volumes import write_grid
from unrender.rendering.mitsuba import mesh_layout

_REFRACTING = ("dielectric", "roughdielectric", "thindielectric", "plastic", "roughplastic")
_METALS = ("conductor", "roughconductor")
_SPECTRA = ("regular", "irregular")
_VERTEX = ("vertex_", "face_")


def store(graph: SceneGraph, place: Place, value: np.ndarray, key: str, folder: Path) -> None:
    """Store `value` at `place` of the description; write maps and meshes to files in `folder`.

    Args:
        graph: the description; its live scene already has all recovered values.
        value: recovered value.
        key: key of the parameter, which names its file.
        folder: folder of the exported scene.

    Raises:
        InputError: a description cannot hold this parameter.
    """
    node, path = graph.nodes[place.node], place.path
    if isinstance(place.owner, mi.Mesh) and len(path) == 1 and path[0].startswith(_VERTEX):
        _mesh(graph, place, folder)
    elif path == ("data",):
        _map(node.props, value, key.removesuffix(".data"), folder)
    elif path == ("value",):
        _replace_texture(graph, place.node, value)
    elif len(path) == 2 and path[1] == "value":
        _colour(graph, place, path[0], value)
    elif len(path) == 3 and path[0] == "bsdf" and path[2] == "value":  # the default material of a shape
        material = graph.add(place.node, "bsdf", mi.ObjectType.BSDF, "diffuse")
        graph.nodes[material].props[path[1]] = _native(value)
    elif len(path) == 3 and path[1:] == ("value", "value"):  # a constant volume of a medium
        node.props[path[0]] = _native(value)
    elif len(path) == 1:
        _number(node.props, path[0], value)
    else:
        raise InputError(f"a {node.props.plugin_name()} has nowhere to write it")


def _mesh(graph: SceneGraph, place: Place, folder: Path) -> None:
    """Write the current mesh, in world space."""
    mesh, old = place.owner, graph.nodes[place.node].props
    path = _path(folder, MESHES, graph.names[place.node] or f"mesh-{place.node}", ".ply")
    mesh.write_ply(str(path))
    properties = {name: old[name] for name in old.keys() if old.type(name) in _REFERENCES or name == "flip_normals"}  # noqa: SIM118
    props = graph.replace(place.node, "ply")
    props["filename"] = str(path)
    for name, value in properties.items():
        props[name] = value
    if mesh.has_face_normals() or not mesh_layout.has_normals(mesh):
        props["face_normals"] = True


_REFERENCES = (mi.Properties.Type.ResolvedReference, mi.Properties.Type.Reference)


def _map(props: Any, value: np.ndarray, name: str, folder: Path) -> None:
    plugin = props.plugin_name()
    if plugin == "gridvolume":
        path = _path(folder, VOLUMES, name, ".vol")
        write_grid(path, value)
    elif plugin in ("bitmap", "envmap"):
        path = _path(folder, BITMAPS, name, ".exr")
        # Mitsuba repeats the first column behind the last one, and the last before the first.
        images.write(value[:, 1:-1, :3] if plugin == "envmap" else value, path)
    else:
        raise InputError(f"a {plugin} reads its values from no file that could be written")
    for other in ("bitmap", "data", "grid"):
        _forget(props, other)
    props["filename"] = str(path)
    if plugin == "bitmap":
        props["format"] = "variant"  # float32, as recovered


def _replace_texture(graph: SceneGraph, index: int, value: np.ndarray) -> None:
    """Replace a constant texture by its value in each of its parents."""
    for parent in range(len(graph.nodes)):
        for name, child in graph.children(parent).items():
            if child == index:
                graph.nodes[parent].props[name] = _native(value)


def _colour(graph: SceneGraph, place: Place, name: str, value: np.ndarray) -> None:
    props = graph.nodes[place.node].props
    if props.plugin_name() in _METALS and name in ("eta", "k"):
        _forget(props, "material")
        for part in ("eta", "k"):
            live: Any = graph.live[f"{place.key.rsplit('.', 2)[0]}.{part}.value"]
            props[part] = _native(np.array(live.numpy() if part != name else value))
        return
    props[name] = _native(value)


def _number(props: Any, name: str, value: np.ndarray) -> None:
    if name == "x_fov":
        _forget(props, "focal_length")
        props["fov_axis"] = "x"
        name = "fov"
    elif name == "eta" and props.plugin_name() in _REFRACTING:
        props["ext_ior"] = 1.0
        name = "int_ior"
    elif name in ("eta", "specular"):  # each determines the other
        _forget(props, "specular" if name == "eta" else "eta")
    elif name == "position":
        _forget(props, "to_world")
    if props.plugin_name() in _SPECTRA:
        props[name] = ", ".join(repr(float(x)) for x in value.reshape(-1))
    elif value.size == 1:
        props[name] = float(value.reshape(-1)[0])
    elif value.shape == (3,):
        props[name] = mi.ScalarPoint3d(*map(float, value)) if name != "color" else _native(value)
    else:
        raise InputError(f"a {props.plugin_name()} takes no array of shape {value.shape} as its {name}")


def _native(value: np.ndarray) -> Any:
    """Return a number or a colour in the type that a description holds."""
    flat = [float(x) for x in np.reshape(value, -1)]
    if len(flat) not in (1, 3):
        raise InputError(f"expected a number or a colour, got an array of shape {np.shape(value)}")
    return flat[0] if len(flat) == 1 else mi.ScalarColor3d(*flat)


def _forget(props: Any, name: str) -> None:
    if name in props:
        del props[name]


def _path(folder: Path, kind: str, name: str, ending: str) -> Path:
    path = folder / kind / (file_name(name) + ending)
    path.parent.mkdir(parents=True, exist_ok=True)
    return path
