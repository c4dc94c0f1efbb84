"""Objects of a scene with the slots that hold them, and plugins that cannot be rendered."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from functools import cache
from typing import Any

import mitsuba as mi
import numpy as np

from unrender.core.errors import InputError
from unrender.rendering.mitsuba import mesh_layout
from unrender.rendering.renderer import ReplacedMesh

Holders = Mapping[Any, list[tuple[Any, str]]]
"""{object: (object that holds it, name of the slot)}, one pair per path to it."""

_SPECTRAL_ONLY = {
    "RegularSpectrum": "regular",
    "IrregularSpectrum": "irregular",
    "BlackBodySpectrum": "blackbody",
    "TimedSunskyEmitter": "timed_sunsky",
}
"""{class: plugin} of plugins that Mitsuba loads in RGB variants but cannot evaluate there."""
_PRIMITIVE_FIELD = "BasicVolumetricPrimitiveRadianceFieldIntegrator"


def refusal(scene: Any, objects: Iterable[Any]) -> str:
    """Return the reason why a scene's plugin cannot be rendered as its author intends; "" if all can.

    This function does not raise: an exception would keep the scene alive, and virtual calls reach all living objects.
    """
    names = {class_name(node) for node in objects}
    spectral = "" if str(mi.variant()).endswith("_spectral") else next(iter(names & _SPECTRAL_ONLY.keys()), "")
    if spectral:
        plugin = _SPECTRAL_ONLY[spectral]
        instead = "a sunsky" if plugin == "timed_sunsky" else "an rgb colour"
        return f"Mitsuba cannot evaluate the plugin {plugin} in the variant {mi.variant()}; give {instead} in its place"
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
            del cpptype
            if isinstance(value, mi.Object):
                self.put_object(name, value, flags)

        def put_value(self, name: str, ptr: Any, flags: Any, cpptype: Any) -> None:
            del name, ptr, flags, cpptype

        def put_object(self, name: str, obj: Any, flags: Any) -> None:
            del flags
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
