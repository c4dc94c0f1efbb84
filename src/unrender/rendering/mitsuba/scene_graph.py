"""The objects of a loaded scene and every place where each is used, children of shape groups and nested BSDFs included.

`mitsuba.traverse` names an object by the first place that holds it. A shared object has several, and each decides how its parameters
reach the picture.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from functools import cache
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from unrender.core.errors import InputError

__all__ = ["SceneGraph", "all_shapes", "object_ids"]

_KINDS = {"bsdf": "BSDF", "emitter": "Emitter", "medium": "Medium", "shape": "Shape"}


class SceneGraph:
    """The objects below a scene.

    Args:
        scene: a loaded scene.

    Attributes:
        nodes: every object once, in the order in which Mitsuba names them. Two loads of a description have equal orders.
    """

    def __init__(self, scene: Any):
        self._scene = scene
        self._owners: dict[Any, list[Any]] = {scene: []}
        scene.traverse(_visitor(mi.variant())(scene, self._owners))
        self.nodes = list(self._owners)

    def of(self, kind: str) -> list[Any]:
        """Return the objects of a kind: "bsdf", "emitter", "medium" or "shape"."""
        return [node for node in self.nodes if isinstance(node, getattr(mi, _KINDS[kind]))]

    def attribute_readers(self, shape: Any, name: str) -> list[Any]:
        """Return the textures of a shape's BSDF that read its attribute `name`."""
        return [
            node
            for node in self.nodes
            if node.class_name() == "MeshAttribute"
            and re.search(r'name = "(.*)"', str(node))[1] == name  # pyright: ignore[reportOptionalSubscript]
            and any(shape in chain for chain in self.chains(node))
        ]

    def chains(self, node: Any, above: tuple[Any, ...] = ()) -> Iterator[list[Any]]:
        """Yield every chain of objects from `node` up to the scene; `above` is what the caller passed on its way to `node`."""
        owners = [owner for owner in self._owners.get(node, ()) if owner not in above]
        if not owners:
            yield [node]
        for owner in owners:
            for chain in self.chains(owner, (*above, node)):
                yield [node, *chain]

    def tables(self, other: SceneGraph) -> dict[str, mi.UInt32]:
        """Return tables from the registry ids of this scene's objects to those of another load, by kind.

        Raises:
            InputError: the two loads differ, or a path can meet an object that the traversal does not show.
        """
        if [type(node) for node in self.nodes] != [type(node) for node in other.nodes]:
            raise InputError("scene: two loads of the description have different objects; expected equal ones, or use --method plain")
        found = {}
        for kind in _KINDS:
            source, target = object_ids(kind, self.of(kind)), object_ids(kind, other.of(kind))
            table = np.zeros(int(source.max(initial=0)) + 1, np.uint32)
            table[source] = target
            found[kind] = mi.UInt32(table)
        self._check_complete()
        return found

    def _check_complete(self) -> None:
        """Raise `InputError` for an object that a path can meet and that its owner's `traverse` does not show."""
        shown = {kind: set(self.of(kind)) for kind in _KINDS}
        shapes = [shape for shape in all_shapes(self._scene) if shape.class_name() != "Instance"]  # its children are hit, not it
        for owner in (*shapes, *self._scene.emitters(), *self._scene.sensors()):
            for kind, item in _held(owner):
                if item is not None and item not in shown[kind]:
                    name = owner.id() or owner.class_name()
                    raise InputError(
                        f"scene: the {kind} of {name} ({item.class_name()}) is hidden from mitsuba.traverse, so its previous state cannot "
                        "be found; announce it in the plugin's traverse(), or use --method plain"
                    )


def _held(owner: Any) -> list[tuple[str, Any]]:
    """What a path can reach from a shape, an emitter or a sensor by a pointer."""
    if isinstance(owner, mi.Shape):
        media = [("medium", owner.interior_medium()), ("medium", owner.exterior_medium())]
        return [("shape", owner), ("bsdf", owner.bsdf()), ("emitter", owner.emitter()), *media]
    found = [("medium", owner.get_medium())]
    return [*found, ("emitter", owner)] if isinstance(owner, mi.Emitter) else found


def all_shapes(scene: Any) -> list[Any]:
    """Return all shapes that have surfaces or media of their own: those of the scene, and the children of its shape groups behind them."""
    shapes = scene.shapes()
    if not any(shape.class_name() == "Instance" for shape in shapes):
        return shapes
    known = {*shapes}
    others = [shape for shape in SceneGraph(scene).of("shape") if shape not in known]
    return shapes + [shape for shape in others if not shape.class_name().startswith("ShapeGroup")]


def object_ids(kind: str, items: Iterable[Any]) -> np.ndarray:
    """Return the registry ids of objects of one kind, (N,)."""
    items = list(items)
    if not items:
        return np.zeros(0, np.uint32)
    pointers: Any = getattr(mi, f"{_KINDS[kind]}Ptr")(items)
    numbers: Any = dr.reinterpret_array(mi.UInt32, pointers)
    return numbers.numpy()


@cache
def _visitor(variant: str) -> type:
    del variant  # the base class exists only under a variant

    class Visitor(mi.TraversalCallback):
        """Notes the owners of everything below a node. Visits each object once."""

        def __init__(self, node: Any, owners: dict[Any, list[Any]]):
            super().__init__()
            self.node, self.owners = node, owners

        def put(self, name: str, value: Any, flags: int, cpptype: Any = None) -> None:
            """Take a value or an object."""
            if isinstance(value, mi.Object):
                self.put_object(name, value, flags)

        def put_value(self, name: str, value: Any, flags: int, cpptype: Any = None) -> None:
            """Ignore a value."""

        def put_object(self, name: str, value: Any, flags: int) -> None:
            """Note an object and go on below it."""
            if value is None:
                return
            if value not in self.owners:
                self.owners[value] = [self.node]
                value.traverse(Visitor(value, self.owners))
            elif self.node not in self.owners[value]:
                self.owners[value].append(self.node)

    return Visitor
