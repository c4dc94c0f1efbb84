"""Objects of a loaded scene: every use of each, including children of shape groups and nested BSDFs, and the slots that hold them.

`mitsuba.traverse` names an object by the first place that holds it. A shared object has several places. Each place determines how the
object's parameters affect the image, and each holder caches values that depend on them.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Collection, Iterable, Iterator, Mapping
from functools import cache
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from unrender.core.errors import InputError
from unrender.rendering.mitsuba import mesh_layout
from unrender.rendering.renderer import ReplacedMesh

_KINDS = {"bsdf": "BSDF", "emitter": "Emitter", "medium": "Medium", "shape": "Shape"}
TURNED = "TurnedLight"
"""Name of the Python class of the lights of `turned_lights.py`."""
_ATTRIBUTE = re.compile(r'name = "(.*)",\s+scale = "(.*)"')


class ObjectGraph:
    """All objects of a scene.

    Attributes:
        nodes: every object once. Two loads of a description have the same order.
        owners: {object: its holders}, in the order of visits; the scene has none.
        slots: {object: (object that holds it, name of the slot)}, one pair per path to it.
        properties, hierarchy: attributes of `mitsuba.SceneParameters`.
    """

    def __init__(self, scene: Any):
        self._scene = scene
        self.owners: dict[Any, list[Any]] = {scene: []}
        self.slots: dict[Any, list[tuple[Any, str]]] = {scene: []}
        self.hierarchy: dict[Any, tuple[Any, int]] = {scene: (None, 0)}
        self.properties: dict[str, tuple[Any, Any, Any, int]] = {}
        self.names: set[str] = set()
        _visitor(mi.variant())(self, scene).visit()
        self.nodes = list(self.owners)

    def parameters(self) -> mi.SceneParameters:
        """Return the parameters like `mitsuba.traverse`. A texture that the scene itself holds has the name of its first use in a
        material or light."""
        return mesh_layout.parameters(self.properties, self.hierarchy)

    def notify_other_owners(self, node: Any) -> None:
        """Notify every owner of a shared object that changed. Mitsuba only notifies those along its first place."""
        notified, owner = set(), node
        while owner is not None:
            notified.add(owner)
            owner = self.hierarchy[owner][0]
        for chain in self.chains(node):
            for owner in chain[1:]:
                if owner not in notified and not isinstance(owner, (mi.Shape, mi.Scene, mi.Sensor)):
                    owner.parameters_changed([])
                    notified.add(owner)

    def of(self, kind: str) -> list[Any]:
        """Return the objects of a kind: "bsdf", "emitter", "medium" or "shape"."""
        return [node for node in self.nodes if isinstance(node, getattr(mi, _KINDS[kind]))]

    def attributed(self, ids: Collection[str]) -> list[str]:
        """Return the shapes of these ids whose materials read attributes of vertices.

        Raises `InputError` if such a material has a volume texture too: Mitsuba evaluates both at one point, in different spaces.
        """
        chains = [(node, chain) for node in self.nodes if isinstance(node, mi.Texture) for chain in self.chains(node)]
        readers = {shape for node, chain in chains if attribute(node)[0].startswith("vertex_") for shape in chain}
        volumes = {shape for node, chain in chains if class_name(node) == "VolumeAdapter" for shape in chain}
        shapes = [shape for shape in self._scene.shapes() if shape.id() in ids and shape in readers]
        if both := [shape.id() for shape in shapes if shape in volumes]:
            raise InputError(
                f"{both[0]}: a mesh whose material reads attributes of vertices and a volume cannot be posed; leave out one of them, "
                f"or use {both[0]}.vertex_positions"
            )
        return [shape.id() for shape in shapes]

    def missing_attributes(self) -> list[str]:
        """Return one notice for each attribute that a texture reads from a shape without it, or from vertices in a moved instance.

        Mitsuba reads 0 in place of the first. It interpolates the second at the point in the world between vertices that are not moved.
        """
        lines = []
        moved = [str(shape) for shape in self._scene.shapes() if shape.class_name() == "Instance" and _is_moved(shape)]
        for node in self.nodes:
            if not (name := attribute(node)[0]):
                continue
            for chain in self.chains(node):
                shapes: list[Any] = [x for x in chain if isinstance(x, mi.Shape)]
                names = [f'name = "{shape.id()}"' for shape in shapes[1:]]  # of shape groups
                if shapes and not dr.any(shapes[0].has_attribute(name)):
                    advice = "which a texture of its material reads as 0; store it in the mesh's PLY file"
                    lines.append(f"{shapes[0].id()}: it has no attribute {name}, {advice}")
                elif name.startswith("vertex_") and any(group in text for group in names for text in moved):
                    what = f"Mitsuba interpolates {name} wrongly in instances with to_world"
                    lines.append(f"{shapes[0].id()}: {what}, so that it may leave its range; use a bitmap")
        return sorted(set(lines))

    def chains(self, node: Any, above: tuple[Any, ...] = ()) -> Iterator[list[Any]]:
        """Yield every chain of objects from `node` up to the scene. `above` contains the nodes already visited."""
        owners = [owner for owner in self.owners.get(node, ()) if owner not in above]
        if not owners:
            yield [node]
        for owner in owners:
            for chain in self.chains(owner, (*above, node)):
                yield [node, *chain]

    def tables(self, other: ObjectGraph) -> dict[str, mi.UInt32]:
        """Return tables from the registry ids of this scene's objects to those of another load, by kind. Raises `InputError` if the loads
        differ, or a path can meet an object that the traversal does not show."""
        if [type(node) for node in self.nodes] != [type(node) for node in other.nodes]:
            raise InputError(
                "scene: two loads of the description have different objects; expected equal ones, or use --method plain"
            )
        result = {}
        for kind in _KINDS:
            source, target = object_ids(kind, self.of(kind)), object_ids(kind, other.of(kind))
            table = np.zeros(int(source.max(initial=0)) + 1, np.uint32)
            table[source] = target
            result[kind] = mi.UInt32(table)
        self.check_complete()
        return result

    def check_complete(self) -> None:
        """Raise `InputError` for an object that a path can meet but its owner's `traverse` does not show."""
        shown = {kind: set(self.of(kind)) for kind in _KINDS}
        # rays hit the children of an instance instead
        shapes = [shape for shape in all_shapes(self._scene) if shape.class_name() != "Instance"]
        for owner in (*shapes, *self._scene.emitters(), *self._scene.sensors()):
            for kind, item in _held(owner):
                if item is not None and item not in shown[kind]:
                    name = owner.id() or owner.class_name()
                    raise InputError(
                        f"scene: the {kind} of {name} ({item.class_name()}) is hidden from mitsuba.traverse, so its previous state is "
                        "unknown; declare it in the plugin's traverse(), or use --method plain"
                    )


def attribute(node: Any) -> tuple[str, float]:
    """Return the attribute of shapes that a texture reads and its scale; "" for other objects."""
    match = _ATTRIBUTE.search(str(node)) if class_name(node) == "MeshAttribute" else None
    return ("", 1.0) if match is None else (match[1], float(match[2]))


def _held(owner: Any) -> list[tuple[str, Any]]:
    """Return the objects that a path can access from a shape, an emitter or a sensor by a pointer."""
    if isinstance(owner, mi.Shape):
        media = [("medium", owner.interior_medium()), ("medium", owner.exterior_medium())]
        return [("shape", owner), ("bsdf", owner.bsdf()), ("emitter", owner.emitter()), *media]
    medium = [("medium", owner.get_medium())]
    return [*medium, ("emitter", owner)] if isinstance(owner, mi.Emitter) else medium


def all_shapes(scene: Any) -> list[Any]:
    """Return all shapes with their own surfaces or media: those of the scene, followed by the children of its shape groups."""
    shapes = scene.shapes()
    if not has_instances(scene):
        return shapes
    known = {*shapes}
    others = [shape for shape in ObjectGraph(scene).of("shape") if shape not in known]
    return shapes + [shape for shape in others if not shape.class_name().startswith("ShapeGroup")]


def _is_moved(instance: Any) -> bool:
    to_world: Any = mi.traverse(instance)["to_world"]
    return not np.allclose(np.array(to_world.matrix).reshape(4, 4), np.eye(4))


def has_instances(scene: Any) -> bool:
    """Return whether the scene has instances of shape groups."""
    return any(shape.class_name() == "Instance" for shape in scene.shapes())


def object_ids(kind: str, items: Iterable[Any]) -> np.ndarray:
    """Return the registry ids of objects of one kind, (N,)."""
    items = list(items)
    if not items:
        return np.zeros(0, np.uint32)
    pointers: Any = getattr(mi, f"{_KINDS[kind]}Ptr")(items)
    numbers: Any = dr.reinterpret_array(mi.UInt32, pointers)
    return numbers.numpy()


@cache
def _visitor(_variant: str) -> type:
    """Return the visitor class of a variant: its base class depends on the variant."""

    class Visitor(mi.TraversalCallback):
        """Visitor that adds everything below a node to a graph, each object once, with the names of `mitsuba.traverse`."""

        def __init__(self, graph: ObjectGraph, node: Any, depth: int = 0, name: str | None = None, flags: int = 0):
            super().__init__()
            if name is not None:
                count, plain = 1, name
                while name in graph.names:
                    name = f"{plain}_{count}"
                    count += 1
                graph.names.add(name)
            self.graph, self.node, self.depth, self.name = graph, node, depth, name
            self.flags = flags | +mi.ParamFlags.Differentiable
            self.deferred: list[tuple[str, Any, int]] = []

        def visit(self) -> None:
            """Visit the node's members. Textures of the scene, which have no id, come last, since their users name them."""
            self.node.traverse(self)
            for arguments in self.deferred:
                self._enter(*arguments)

        def put(self, name: str, value: Any, flags: int, cpptype: Any = None) -> None:
            if isinstance(value, mi.Object):
                self.put_object(name, value, flags)
            else:
                self.put_value(name, value, flags, cpptype)

        def put_value(self, name: str, value: Any, flags: int, cpptype: Any = None) -> None:
            """Add a value. None, such as the `sigma_a` of a hair BSDF with pigments, is not a parameter."""
            if (self.flags | flags) & mi.ParamFlags.NonDifferentiable:
                flags &= ~mi.ParamFlags.Discontinuous
            if value is not None:
                self.graph.properties[self.full(name)] = value, cpptype, self.node, self.flags | flags

        def put_object(self, name: str, value: Any, flags: int) -> None:
            if self.depth == 0 and isinstance(value, mi.Texture):
                self.deferred.append((name, value, flags))
            elif value is not None:
                self._enter(name, value, flags)

        def _enter(self, name: str, value: Any, flags: int) -> None:
            owners = self.graph.owners
            self.graph.slots.setdefault(value, []).append((self.node, name))
            if value not in owners:
                owners[value] = [self.node]
                self.graph.hierarchy[value], full = _placed(self, name, value)
                type(self)(self.graph, value, self.depth + 1, full, self.flags | flags).visit()
            elif self.node not in owners[value]:
                owners[value].append(self.node)

        def full(self, name: str) -> str:
            return name if self.name is None else f"{self.name}.{name}"

    return Visitor


def _placed(visitor: Any, name: str, value: Any) -> tuple[tuple[Any, int], str]:
    """Return holder and depth of an object, and its full name. A turned light keeps those that it has in the description."""
    if type(visitor.node).__name__ == TURNED:
        return visitor.graph.hierarchy[visitor.node], value.id()
    return (visitor.node, visitor.depth + 1), visitor.full(name)


Holders = Mapping[Any, list[tuple[Any, str]]]
"""{object: (object that holds it, name of the slot)}, one pair per path to it."""

_SPECTRAL_ONLY = {"RegularSpectrum": "regular", "IrregularSpectrum": "irregular", "BlackBodySpectrum": "blackbody"}
"""{class: plugin} of plugins that Mitsuba loads in RGB variants but cannot evaluate there."""
_TIMED_SKY = "TimedSunskyEmitter"  # class of an emitter that Mitsuba loads but cannot evaluate in loops, in any variant
_PRIMITIVE_FIELD = "BasicVolumetricPrimitiveRadianceFieldIntegrator"


def refusal(scene: Any, objects: Iterable[Any]) -> str:
    """Return the reason why a scene's plugin cannot be rendered as its author intends; "" if all can.

    This function does not raise: an exception would keep the scene alive, and virtual calls reach all living objects.
    """
    names = {class_name(node) for node in objects}
    variant = str(mi.variant())
    if _TIMED_SKY in names:
        return f"Mitsuba cannot evaluate the plugin timed_sunsky in the variant {variant}; give a sunsky in its place"
    spectral = "" if variant.endswith("_spectral") else next(iter(names & _SPECTRAL_ONLY.keys()), "")
    if spectral:
        instead = f"use the variant {variant.replace('rgb', 'spectral')}, or give an rgb colour in its place"
        return f"Mitsuba cannot evaluate the plugin {_SPECTRAL_ONLY[spectral]} in the variant {variant}; {instead}"
    if type(scene.integrator()).__name__ == _PRIMITIVE_FIELD:
        return (
            "the integrator volprim_rf_basic renders ellipsoids as a radiance field, but path tracing treats them as surfaces; "
            "give the field as a medium of type emissive"
        )
    if "DirectionalArea" in names:
        return (
            "camera paths cannot sample a directionalarea emitter, so the image would lack its light; "
            "give a directional, spot or projector emitter in its place"
        )
    return ""


def children(node: Any) -> list[tuple[str, Any]]:
    """Return the objects that an object holds, with the names of their slots."""
    callback = _callback(mi.variant())()
    node.traverse(callback)
    return callback.objects


def class_name(node: Any) -> str:
    """Return the class of an object without its number format: "BitmapTextureImpl" for "BitmapTextureImpl[float32]"."""
    return node.class_name().partition("[")[0]


@cache
def _callback(variant: str | None) -> Any:
    del variant  # a cache key only: the base class belongs to the active variant

    class Children(mi.TraversalCallback):
        def __init__(self) -> None:
            super().__init__()
            self.objects: list[tuple[str, Any]] = []

        def put(self, name: str, value: Any, flags: Any, cpptype: Any = None) -> None:
            if isinstance(value, mi.Object):
                self.put_object(name, value, flags)

        def put_value(self, name: str, ptr: Any, flags: Any, cpptype: Any) -> None:
            del name, ptr, flags, cpptype

        def put_object(self, name: str, obj: Any, flags: Any) -> None:
            if obj is not None:
                self.objects.append((name, obj))

    return Children


def replace_meshes(scene: Any, meshes: Mapping[str, ReplacedMesh]) -> None:
    """Replace the meshes of a scene's shapes, by id. Raise `InputError` if a shape is not a mesh, or texture coordinates do not match."""
    if not meshes:
        return
    parameters = mesh_layout.traverse(scene)
    shapes = {shape.id(): shape for shape in scene.shapes()}
    for name, mesh in meshes.items():
        shape = shapes.get(name)
        if shape is None or not shape.is_mesh():
            raise InputError(f"{name}: the scene has no mesh of this id")
        if mesh_layout.has_texcoords(shape) != (mesh.uv is not None):
            raise InputError(f"{name}: texture coordinates are missing, or the mesh has none")
        parameters[f"{name}.{mesh_layout.FACES}"] = mi.UInt32(mesh.faces.ravel().astype(np.uint32))
        parameters[f"{name}.{mesh_layout.POSITIONS}"] = mi.Float(mesh.vertices.ravel().astype(np.float32))
        if mesh.uv is not None:
            parameters[f"{name}.{mesh_layout.TEXCOORDS}"] = mi.Float(mesh.uv.ravel().astype(np.float32))
    parameters.update()


def scene_of(objects: Iterable[Any]) -> Any:
    """Return a scene of existing objects. Each keeps its id, which Mitsuba would otherwise take from the dictionary."""
    listed = [*objects]
    ids = [item.id() for item in listed]
    free = (key for n in itertools.count() if (key := f"object_{n}") not in ids)
    named: dict[str, Any] = {"type": "scene"}
    for name, item in zip(ids, listed, strict=True):  # an id in a file may have a dot, a key of a dictionary may not
        named[next(free) if not name or "." in name or name in named else name] = item
    scene = mi.load_dict(named, parallel=False, optimize=False)
    for name, item in zip(ids, listed, strict=True):
        if "." in name:
            item.set_id(name)
    return scene
