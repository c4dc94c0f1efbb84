"""How a parameter reaches the image, read off the scene graph."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Literal

import mitsuba as mi

from unrender.rendering.mitsuba import poses
from unrender.rendering.mitsuba.integrators.specular import DELTA_MASK, DELTA_SIMPLE
from unrender.rendering.mitsuba.mesh_layout import FACES, NORMALS, POSITIONS, TEXCOORDS
from unrender.rendering.mitsuba.scene_graph import ObjectGraph
from unrender.rendering.parameter_errors import Role

__all__ = [
    "ParameterTraits",
    "brightness",
    "is_nonlinear",
    "is_of_vertices",
    "normals_key",
    "parameter_traits",
    "role",
    "transform_obstacle",
    "update_obstacle",
]

# Delta lobes whose value in the previous state can be had by sampling that lobe alone, where their directions do not
# depend on the parameter.
_SIMPLE_DELTA = {"SmoothConductor", "SmoothDielectric", "ThinDielectric", "SmoothPlastic"}
_WRAPPERS = {"TwoSidedBRDF"}
_BENDERS = {"BumpMap", "NormalMap"}
_MIXED = "its BSDF mixes perfectly specular lobes with others"
_COMPUTED_OR_FIXED = (NORMALS, TEXCOORDS)
_REFUTED = {
    "RoughDielectric": {"alpha", "alpha_u", "alpha_v", "eta"},
    "PrincipledThin": {"roughness", "anisotropic"},
}
"""{class of a BSDF: slots whose path gradients disagree with finite differences}."""
_LIGHT = ("radiance", "intensity", "irradiance")
_REFLECTANCE = ("reflectance", "diffuse_reflectance", "specular_reflectance", "base_color")
_DIRECTIONS = (NORMALS, "sun_direction", "direction")

_OUTLINES = {
    "BSplineCurve": ("control_points",),
    "LinearCurve": ("control_points",),
    "Ellipsoids": ("data",),
    "EllipsoidsMesh": ("data",),
    "SDFGrid": ("grid",),
}
"""{class of a shape: parameters that change its outline}."""


@dataclass(frozen=True)
class ParameterTraits:
    """How a parameter reaches the image, read off the scene graph.

    Attributes:
        geometric: whether it moves shapes, sensors or emitters, so that paths themselves change.
        reason: why one path cannot serve two values of it, "" if it can.
        replayable: whether path replay gives its derivative; if not, for the same reason.
        delta_lobes: the BSDFs of shapes whose perfectly specular lobes follow it, each with one of the `DELTA_...` constants.
        medium: whether extinction or scattering of a participating medium depends on it.
        phase: whether it belongs to a phase function.
        light: whether it moves an emitter that has no shape, so that no acceleration structure follows it.
    """

    geometric: bool
    reason: str
    replayable: bool = True
    delta_lobes: tuple[tuple[Any, int], ...] = ()
    medium: bool = False
    phase: bool = False
    light: bool = False

    @property
    def shares_paths(self) -> bool:
        """Whether one path serves two values of it."""
        return not self.reason

    @property
    def changes_delta(self) -> bool:
        """Whether perfectly specular lobes change with it."""
        return bool(self.delta_lobes)


def parameter_traits(parameters: mi.SceneParameters, key: str, graph: ObjectGraph) -> ParameterTraits:
    """Return how the parameter `key` of a traversed scene reaches the image.

    A shared object reaches it by several chains of owners. Each one may forbid what the others allow.
    """
    leaf = key.rsplit(".", 1)[-1]
    node = parameters.properties[key][2]
    if isinstance(node, mi.Mesh) and _is_attribute(leaf):
        readers = graph.attribute_readers(node, leaf)
        chains = [chain for reader in readers for chain in graph.chains(reader) if node in chain]
        return functools.reduce(_joined, [_traits_of(chain, key) for chain in chains], ParameterTraits(False, ""))
    chains = list(graph.chains(node))
    used = [
        chain for chain in chains if len(chain) > 2
    ] or chains  # a texture that the scene holds, too, has no effect there
    return functools.reduce(_joined, [_traits_of(chain, key) for chain in used])


def _is_attribute(leaf: str) -> bool:
    """Whether a mesh's parameter is an attribute that textures read."""
    return leaf.startswith(("vertex_", "face_")) and leaf not in (POSITIONS, *_COMPUTED_OR_FIXED)


def _joined(one: ParameterTraits, other: ParameterTraits) -> ParameterTraits:
    first = other if not other.replayable and one.replayable else one
    lobes = dict(one.delta_lobes)
    mixed = any(lobes.get(bsdf, kind) != kind for bsdf, kind in other.delta_lobes)
    return ParameterTraits(
        one.geometric or other.geometric,
        first.reason or one.reason or other.reason or (_MIXED if mixed else ""),
        one.replayable and other.replayable and not mixed,
        tuple((lobes | dict(other.delta_lobes)).items()),
        one.medium or other.medium,
        one.phase or other.phase,
        one.light and other.light,
    )


def _traits_of(chain: list[Any], key: str) -> ParameterTraits:
    """From one chain of objects, the one that holds the parameter first."""
    leaf = key.rsplit(".", 1)[-1]
    bsdfs = [n for n in chain if isinstance(n, mi.BSDF)]
    if bsdfs:
        if bsdfs[0].class_name() == "RoughPlastic" and leaf in ("alpha", "eta"):
            why = "Mitsuba's roughplastic tabulates its transmittance from it without a derivative"
            return ParameterTraits(False, why, replayable=False)
        if _REFUTED.get(bsdfs[0].class_name(), set()) & set(key.split(".")):
            why = f"path gradients of it disagree with finite differences ({bsdfs[0].class_name()})"
            return ParameterTraits(False, why, replayable=False)
        return _bsdf_traits(bsdfs, chain)
    if any(isinstance(n, mi.Emitter) for n in chain):
        if leaf in ("to_world", "position", "direction", "cutoff_angle", "beam_width"):
            return ParameterTraits(True, "it moves an emitter", light=True)
        if leaf == "sun_direction":
            why = "it moves the sun's disk, whose border path gradients do not follow"
            return ParameterTraits(False, why, replayable=False)
        return ParameterTraits(False, "")
    if any(isinstance(n, mi.Medium) for n in chain):
        if any(
            n.class_name() == "BlendPhaseFunction" and not isinstance(held, mi.PhaseFunction)
            for held, n in pairwise(chain)
        ):
            why = "Mitsuba's blendphase passes no derivative to its weight"
            return ParameterTraits(False, why, replayable=False, phase=True)
        if any(n.class_name() == "SGGXPhaseFunction" for n in chain):
            why = "path gradients of it disagree with finite differences (SGGXPhaseFunction)"
            return ParameterTraits(False, why, replayable=False, phase=True)
        volume, phase = (any(isinstance(n, kind) for n in chain) for kind in (mi.Volume, mi.PhaseFunction))
        return ParameterTraits(False, "", medium=volume, phase=phase)
    if any(isinstance(n, mi.Sensor) for n in chain):
        return ParameterTraits(True, "it moves the sensor")
    shapes = [n for n in chain if isinstance(n, mi.Shape)]
    if shapes:
        if shapes[-1].is_sensor():
            return ParameterTraits(True, "it moves a shape that carries a sensor", replayable=False)
        return ParameterTraits(True, "it moves a shape")
    return ParameterTraits(True, "it is neither a material's nor an emitter's")


def _bsdf_traits(bsdfs: list[Any], chain: list[Any]) -> ParameterTraits:
    """How a parameter inside this nest of BSDFs (innermost first) reaches the image: what its delta lobes make of it."""
    outer = bsdfs[-1]
    if not mi.has_flag(bsdfs[0].flags(), mi.BSDFFlags.Delta):
        return ParameterTraits(False, "")  # whatever mirrors stand beside it do not change
    names = [b.class_name() for b in bsdfs if b.class_name() not in _WRAPPERS]
    if names == ["MaskBSDF"] and not _masks_delta(outer):
        return ParameterTraits(False, "", delta_lobes=((outer, DELTA_MASK),))
    inner = names[0]
    if inner in _SIMPLE_DELTA and all(name in _BENDERS for name in names[1:]):
        if not any(isinstance(c, mi.Texture) for c in chain):  # the index of refraction is no texture
            return ParameterTraits(False, "it bends the direction of a perfectly specular lobe", replayable=False)
        turned = "it lies under a bump or normal map that turns a specular lobe" if names[1:] else ""
        return ParameterTraits(False, turned, delta_lobes=((outer, DELTA_SIMPLE),))
    if inner in _BENDERS:
        return ParameterTraits(False, "it bends the direction of a perfectly specular lobe", replayable=False)
    return ParameterTraits(False, _MIXED, replayable=False)


def _masks_delta(bsdf: Any) -> bool:
    """Whether what lies under a mask (the outermost BSDF) has perfectly specular lobes of its own."""
    return any(
        mi.has_flag(bsdf.flags(), kind) for kind in (mi.BSDFFlags.DeltaReflection, mi.BSDFFlags.DeltaTransmission)
    )


def transform_obstacle(scene: mi.Scene, parameters: mi.SceneParameters, key: str) -> str:
    """Return why the object whose transformation is `key` has no pose, "" where it has one."""
    node: Any = parameters.properties[key][2]
    if isinstance(node, mi.Emitter) and not (poses.is_posable(node) and node in scene.emitters()):
        return f"it places an emitter ({node.class_name()}), which has no pose"
    if isinstance(node, mi.Sensor) and not any(node.id() == sensor.id() for sensor in scene.sensors()):
        return "it places a sensor of a batch, which has no pose of its own; give the sensors to the scene one by one"
    if isinstance(node, mi.Shape) and node.is_sensor():
        return "it places a shape that carries a sensor, which has no pose"
    return ""


def update_obstacle(parameters: mi.SceneParameters, key: str) -> str:
    """Return why a parameter cannot be given another value, "" where it can."""
    node, leaf = parameters.properties[key][2], key.rpartition(".")[2]
    if leaf not in _OUTLINES.get(node.class_name(), ()):
        return ""
    why = "it changes the outline of a shape that is no mesh, whose derivative has not been shown to be right"
    if leaf == "grid":
        why = "Mitsuba corrupts memory when the distances of an sdfgrid change"
    return f"{why}; recover a mesh's {POSITIONS} instead"


def role(parameters: mi.SceneParameters, key: str, shape: tuple[int, ...]) -> Role:
    """Return what the values of a parameter stand for.

    Args:
        parameters: of the scene.
        key: of the parameter.
        shape: of its array.
    """
    vectors = math.prod(shape) % 3 == 0 if len(shape) == 1 else bool(shape) and shape[-1] == 3
    if not vectors:
        return "value"
    names, node = key.split("."), parameters.properties[key][2]
    if names[-1] in _DIRECTIONS:
        return "direction"
    while node is not None:  # the texture of a normal map, however it is wrapped
        if isinstance(node, mi.BSDF):
            return "normal" if node.class_name() == "NormalMap" and "normalmap" in names else "value"
        node = parameters.hierarchy[node][0] if node in parameters.hierarchy else None
    return "value"


def brightness(parameters: mi.SceneParameters, key: str) -> Literal["", "light", "reflectance"]:
    """Return what the picture is proportional to: an emitter's light, a surface's reflectance, or neither."""
    names, node = key.split("."), parameters.properties[key][2]
    while node is not None and not isinstance(node, (mi.BSDF, mi.Emitter)):
        node = parameters.hierarchy[node][0] if node in parameters.hierarchy else None
    if isinstance(node, mi.Emitter):
        emits = names[-1] in ("scale", "data") or any(name in _LIGHT for name in names)
        return "light" if emits else ""
    return "reflectance" if isinstance(node, mi.BSDF) and any(name in _REFLECTANCE for name in names) else ""


def is_nonlinear(parameters: mi.SceneParameters, key: str, singular: float | None) -> bool:
    """Return whether the picture changes its form with a parameter: of a sensor, of an emitter other than its light, of an index."""
    node = parameters.properties[key][2]
    while node is not None and not isinstance(node, (mi.BSDF, mi.Emitter, mi.Sensor, mi.Medium)):
        node = parameters.hierarchy[node][0] if node in parameters.hierarchy else None
    if isinstance(node, mi.Emitter):
        return brightness(parameters, key) != "light"
    return singular is not None or isinstance(node, mi.Sensor)


def is_of_vertices(parameters: mi.SceneParameters, key: str) -> bool:
    """Whether a parameter has values at the vertices of a mesh that images depend on: their positions, or an attribute."""
    owner, _, name = key.rpartition(".")
    return name.startswith("vertex_") and name not in _COMPUTED_OR_FIXED and f"{owner}.{FACES}" in parameters


def normals_key(key: str) -> str:
    """The key of the normals that Mitsuba computes when the parameter `key` changes, "" where it computes none."""
    owner, _, name = key.rpartition(".")
    return f"{owner}.{NORMALS}" if name == POSITIONS else ""
