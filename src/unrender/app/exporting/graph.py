"""The description of a scene as a graph of plugins: look-up by parameter, replacement by recovered values, output as XML.

Mitsuba's parser makes the graph from a dictionary or from XML, and writes it as XML. It does not write the ids of plugins without
references; these ids are added here, since the keys of parameters contain them.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import mitsuba as mi
import numpy as np

from unrender.app.exporting.ready_made import BITMAPS, MESHES, VOLUMES, new_file
from unrender.core.errors import InputError
from unrender.core.text import reason_of
from unrender.io import images
from unrender.io.volumes import write_grid
from unrender.rendering.mitsuba import mesh_layout
from unrender.rendering.mitsuba.description import parse
from unrender.rendering.mitsuba.scene_graph import ObjectGraph

_LABEL = re.compile(r"n(\d+)")
_MARK = "unrender_node"
_IN_PYTHON = ("BSDF", "Emitter", "Texture", "Medium", "PhaseFunction", "Sensor", "Film", "Shape", "Volume")
_NAMELESS = re.compile(r"|object_\d+|_.*|elm__\d+")
_Kind = mi.Properties.Type


@dataclass(frozen=True)
class Place:
    """The place of a parameter in the description.

    Attributes:
        node: index of the plugin.
        path: the names below it, such as ("reflectance", "value").
        owner: the live object of that plugin.
        key: key of the parameter in `SceneGraph.live`.
    """

    node: int
    path: tuple[str, ...]
    owner: Any
    key: str


class SceneGraph:
    """A description (an XML file, or a dictionary without ready-made objects), and a live scene made from it whose objects identify their
    plugins.

    `nodes` are mutable `mitsuba.parser.SceneNode` objects, and `live` is the scene's `mitsuba.SceneParameters`.
    """

    def __init__(self, description: Path | Mapping[str, Any]):
        try:
            self._state = parse(description).state
            lively = parse(description)  # the instantiation consumes it
            for index, node in enumerate(lively.state.nodes):
                node.props.set_id(f"n{index}")
            self._scene: Any = lively.instantiate()
        except Exception as error:
            raise InputError(f"scene: its description cannot be read: {' '.join(str(error).split())[:400]}") from error
        self.nodes: Any = self._state.nodes
        objects = ObjectGraph(self._scene)
        for each in objects.nodes:  # the parser does not know the object type of plugins in Python
            if (label := _LABEL.fullmatch(each.id())) and self.nodes[int(label[1])].type == mi.ObjectType.Unknown:
                kinds = [kind for kind in _IN_PYTHON if isinstance(each, getattr(mi, kind))]
                self.nodes[int(label[1])].type = getattr(mi.ObjectType, kinds[0] if kinds else "Unknown")
        self.names = [node.props.id() for node in self.nodes]
        self.live = objects.parameters()  # the same keys as the parameters of a problem

    @property
    def root(self) -> Any:
        """Properties of the scene itself."""
        return self.nodes[0].props

    def children(self, index: int) -> dict[str, int]:
        """Return {property: index} of the children of a node."""
        return _children(self.nodes[index].props)

    def add(self, parent: int, name: str, kind: Any, plugin: str) -> int:
        """Add a plugin as the property `name` of `parent`; return its index."""
        node = mi.parser.SceneNode()
        node.type, node.props = kind, mi.Properties(plugin)
        self.nodes.append(node)
        self.names.append("")
        self.nodes[parent].props[name] = mi.Properties.ResolvedReference(len(self.nodes) - 1)
        return len(self.nodes) - 1

    def replace(self, index: int, plugin: str) -> Any:
        """Replace the plugin of a node; return its properties, which are empty."""
        self.nodes[index].props = mi.Properties(plugin)
        return self.nodes[index].props

    def child(self, parent: int, kind: Any, plugin: str) -> Any:
        """Replace the child of that object type by the plugin, or add it; return its properties, which are empty."""
        index = self.descendant(parent, kind)
        if index is None:
            return self.nodes[self.add(parent, plugin, kind, plugin)].props
        return self.replace(index, plugin)

    def descendant(self, parent: int, *kinds: Any) -> int | None:
        """Return the child of the first object type, its child of the next type, and so on; None if one is missing."""
        index: int | None = parent
        for kind in kinds:
            if index is not None:
                index = next((i for i in self.children(index).values() if self.nodes[i].type == kind), None)
        return index

    def of(self, kind: Any) -> list[int]:
        """Return the children of the scene that have the object type `kind`."""
        return [index for index in self.children(0).values() if self.nodes[index].type == kind]

    def used(self) -> set[int]:
        """Return all nodes that are reachable from the scene."""
        return reachable(self.nodes)

    def sensors(self) -> list[Any]:
        """Return the sensors of the live scene; their ids are n0 to nN, after their nodes."""
        return list(self._scene.sensors())

    def places(self, scene: Any) -> dict[str, Place]:
        """Return {key: place} of all parameters of `scene` (`mitsuba.SceneParameters`), which was made from the same description."""
        if [key.rpartition(".")[2] for key in scene.properties] != [
            key.rpartition(".")[2] for key in self.live.properties
        ]:
            raise InputError("scene: its description makes another scene when read once more")
        return {key: self._place(own) for key, own in zip(scene.properties, self.live.properties, strict=True)}

    def _place(self, key: str) -> Place:
        owner = self.live.properties[key][2]
        parts = key.split(".")
        depth = 1
        while not (label := _LABEL.fullmatch(owner.id())) and owner in self.live.hierarchy:
            above = self.live.hierarchy[owner][0]
            if above is None:
                break
            owner, depth = above, depth + 1
        node, path = int(label[1]) if label else 0, tuple(parts[-depth:])
        # The object of a texture does not have its id.
        while len(path) > 1 and path[0] in (children := self.children(node)):
            node, path = children[path[0]], path[1:]
        return Place(node, path, owner, key)

    # ------------------------------------------------------------------ writing

    def xml(self) -> bytes:
        """Return the description as Mitsuba's XML. Raises `InputError` for what Mitsuba cannot write."""
        for index, node in enumerate(self.nodes):
            node.props.set_id(f"n{index}")
            node.props[_MARK] = str(index)
        try:
            root = ElementTree.fromstring(mi.parser.write_string(self._state))
        except RuntimeError as error:
            raise InputError(f"export: Mitsuba cannot write this scene as XML: {reason_of(error, 300)}") from error
        elements: dict[int, ElementTree.Element] = {}
        for element in root.iter():
            for mark in [child for child in element if child.get("name") == _MARK]:
                elements[int(str(mark.get("value")))] = element
                element.remove(mark)
                element.text = None
        names = self._final_names(root, elements)
        for index, element in elements.items():
            element.attrib.pop("id", None)
            if index in names and element is not root:
                element.set("id", names[index])
        for reference in root.iter("ref"):
            reference.set("id", names[int(str(reference.get("id"))[1:])])
        for element in root:
            element.attrib.pop("name", None) if element.tag not in ("default", "ref") else None
        ElementTree.indent(root)
        return ElementTree.tostring(root, encoding="utf-8", xml_declaration=True) + b"\n"

    def _final_names(self, root: ElementTree.Element, elements: Mapping[int, ElementTree.Element]) -> dict[int, str]:
        """Return the ids that plugins have in the XML: those of direct children of the scene, of referenced plugins, and explicit ones."""
        referred = {int(str(reference.get("id"))[1:]) for reference in root.iter("ref")}
        own = set(self.children(0).values())
        taken: Counter[str] = Counter()
        names: dict[int, str] = {}
        for index in sorted(elements, key=lambda i: (i not in own, i)):
            name = self.names[index]
            by_default = name == elements[index].get("name") and index not in own  # a dictionary's key
            if not _NAMELESS.fullmatch(name) and not by_default and not taken[name]:
                names[index] = name
            elif index in referred:
                names[index] = f"shared-{index}"
            taken[names.get(index, "")] += 1
        return names


_REFRACTING = ("dielectric", "roughdielectric", "thindielectric", "plastic", "roughplastic")
_METALS = ("conductor", "roughconductor")
_SPECTRA = ("regular", "irregular")
_VERTEX = ("vertex_", "face_")


def reachable(nodes: Any) -> set[int]:
    """Return the indices of the `mitsuba.parser.SceneNode` objects that the first one, the scene, refers to directly or indirectly."""
    found: set[int] = set()
    waiting = [0]
    while waiting:
        index = waiting.pop()
        if index not in found:
            found.add(index)
            waiting += _children(nodes[index].props).values()
    return found


def _children(props: Any) -> dict[str, int]:
    return {name: props[name].index() for name in props.keys() if props.type(name) == _Kind.ResolvedReference}  # noqa: SIM118


def store(graph: SceneGraph, place: Place, value: np.ndarray, key: str, folder: Path) -> None:
    """Store `value` at `place` of a description whose live scene has it already; write maps and meshes to files in `folder`, named by
    `key`. Raises `InputError` if a description cannot hold this parameter."""
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
    mesh, old = place.owner, graph.nodes[place.node].props
    path = new_file(folder, MESHES, graph.names[place.node] or f"mesh-{place.node}", ".ply")
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
        path = new_file(folder, VOLUMES, name, ".vol")
        write_grid(path, value)
    elif plugin in ("bitmap", "envmap"):
        path = new_file(folder, BITMAPS, name, ".exr")
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
