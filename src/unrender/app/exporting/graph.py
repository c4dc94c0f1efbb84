"""A scene's description as a graph of plugins: found by parameter, changed, written as XML.

Mitsuba's parser makes the graph from a dictionary and from XML alike, and writes it. What it does not write are the names of plugins to
which nothing refers; without those no parameter could be named again.
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
    """Where the description holds a parameter.

    Attributes:
        node: index of the plugin.
        path: the names below it, such as ("reflectance", "value").
        owner: the live object of that plugin.
        key: of the parameter in `SceneGraph.live`.
    """

    node: int
    path: tuple[str, ...]
    owner: Any
    key: str


class SceneGraph:
    """A description, and a live scene made of it whose objects tell which plugin they come from.

    Args:
        description: an XML file, or a dictionary without ready-made objects.

    Attributes:
        nodes: `mitsuba.parser.SceneNode`, to be changed.
        names: the id of each node, as given.
        live: `mitsuba.SceneParameters` of the live scene.
    """

    def __init__(self, description: Path | Mapping[str, Any]):
        try:
            self._state = parse(description).state
            lively = parse(description)  # which is used up
            for index, node in enumerate(lively.state.nodes):
                node.props.set_id(f"n{index}")
            self._scene: Any = lively.instantiate()
        except Exception as error:
            raise InputError(f"scene: its description cannot be read: {' '.join(str(error).split())[:400]}") from error
        self.nodes: Any = self._state.nodes
        for emitter in self._scene.emitters():  # of plugins in Python, the parser does not know of what kind they are
            if (label := _LABEL.fullmatch(emitter.id())) and self.nodes[int(label[1])].type == mi.ObjectType.Unknown:
                self.nodes[int(label[1])].type = mi.ObjectType.Emitter
        self.names = [node.props.id() for node in self.nodes]
        self.live = ObjectGraph(self._scene).parameters()  # named as a problem's parameters are

    @property
    def root(self) -> Any:
        """Properties of the scene itself."""
        return self.nodes[0].props

    def children(self, index: int) -> dict[str, int]:
        """The nodes that a node holds, by property."""
        props = self.nodes[index].props
        return {name: props[name].index() for name in props.keys() if props.type(name) == _Kind.ResolvedReference}  # noqa: SIM118

    def add(self, parent: int, name: str, kind: Any, plugin: str) -> int:
        """A new plugin as the property `name` of `parent`: its index."""
        node = mi.parser.SceneNode()
        node.type, node.props = kind, mi.Properties(plugin)
        self.nodes.append(node)
        self.names.append("")
        self.nodes[parent].props[name] = mi.Properties.ResolvedReference(len(self.nodes) - 1)
        return len(self.nodes) - 1

    def replace(self, index: int, plugin: str) -> Any:
        """The properties of a node, emptied, now of another plugin."""
        self.nodes[index].props = mi.Properties(plugin)
        return self.nodes[index].props

    def child(self, parent: int, kind: Any, plugin: str) -> Any:
        """The properties of the child of that kind of object, emptied, of that plugin; a new one where there is none."""
        index = self.descendant(parent, kind)
        if index is None:
            return self.nodes[self.add(parent, plugin, kind, plugin)].props
        return self.replace(index, plugin)

    def descendant(self, parent: int, *kinds: Any) -> int | None:
        """The child of a kind of object, its child of the next kind, and so on; None where one is missing."""
        found: int | None = parent
        for kind in kinds:
            if found is not None:
                found = next((i for i in self.children(found).values() if self.nodes[i].type == kind), None)
        return found

    def of(self, kind: Any) -> list[int]:
        """The children of the scene that are of a kind of object."""
        return [index for index in self.children(0).values() if self.nodes[index].type == kind]

    def used(self) -> set[int]:
        """The nodes that the scene holds, however deep."""
        found: set[int] = set()
        waiting = [0]
        while waiting:
            index = waiting.pop()
            if index not in found:
                found.add(index)
                waiting += self.children(index).values()
        return found

    def sensors(self) -> list[Any]:
        """Of the live scene; their ids tell their nodes, n0 to nN."""
        return list(self._scene.sensors())

    def places(self, scene: Any) -> dict[str, Place]:
        """Where each parameter of `scene` (`mitsuba.SceneParameters`), made of the same description, is held, by its key."""
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
        ):  # a texture, whose object does not tell its id
            node, path = children[path[0]], path[1:]
        return Place(node, path, owner, key)

    # ------------------------------------------------------------------ writing

    def xml(self) -> bytes:
        """The description as Mitsuba's XML."""
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
        """The names that plugins keep: of the scene's own parts, of what is referred to, and those given on purpose."""
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
