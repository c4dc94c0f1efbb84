"""The description of a scene as a graph of plugins: look-up by parameter, changes, output as XML.

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

from unrender.core.errors import InputError
from unrender.rendering.mitsuba.description import parse
from unrender.rendering.mitsuba.scene_graph import ObjectGraph

_LABEL = re.compile(r"n(\d+)")
_MARK = "unrender_node"
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
    """A description, and a live scene made from it whose objects identify their plugins.

    Args:
        description: an XML file, or a dictionary without ready-made objects.

    Attributes:
        nodes: mutable `mitsuba.parser.SceneNode` objects.
        names: the original id of each node.
        live: `mitsuba.SceneParameters` of the live scene.
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
        for emitter in self._scene.emitters():  # the parser does not know the object type of plugins in Python
            if (label := _LABEL.fullmatch(emitter.id())) and self.nodes[int(label[1])].type == mi.ObjectType.Unknown:
                self.nodes[int(label[1])].type = mi.ObjectType.Emitter
        self.names = [node.props.id() for node in self.nodes]
        self.live = ObjectGraph(self._scene).parameters()  # the same keys as the parameters of a problem

    @property
    def root(self) -> Any:
        """Properties of the scene itself."""
        return self.nodes[0].props

    def children(self, index: int) -> dict[str, int]:
        """Return {property: index} of the children of a node."""
        props = self.nodes[index].props
        return {name: props[name].index() for name in props.keys() if props.type(name) == _Kind.ResolvedReference}  # noqa: SIM118

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
        reachable: set[int] = set()
        waiting = [0]
        while waiting:
            index = waiting.pop()
            if index not in reachable:
                reachable.add(index)
                waiting += self.children(index).values()
        return reachable

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
        while len(path) > 1 and path[0] in (
            children := self.children(node)
        ):  # the object of a texture does not have its id
            node, path = children[path[0]], path[1:]
        return Place(node, path, owner, key)

    # ------------------------------------------------------------------ writing

    def xml(self) -> bytes:
        """Return the description as Mitsuba's XML."""
        for index, node in enumerate(self.nodes):
            node.props.set_id(f"n{index}")
            node.props[_MARK] = str(index)
        root = ElementTree.fromstring(mi.parser.write_string(self._state))
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
