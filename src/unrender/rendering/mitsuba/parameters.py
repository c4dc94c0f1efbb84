"""How a parameter reaches the image, read off the scene graph."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import mitsuba as mi

from unrender.rendering.mitsuba.integrators.specular import DELTA_EQUAL, DELTA_MASK, DELTA_SIMPLE

__all__ = [
    "ParameterTraits",
    "is_of_vertices",
    "normals_key",
    "parameter_traits",
    "transform_obstacle",
    "update_obstacle",
]

# Delta lobes whose value in the previous state can be had by sampling that lobe alone, where their directions do not
# depend on the parameter.
_SIMPLE_DELTA = {"SmoothConductor", "SmoothDielectric", "ThinDielectric", "SmoothPlastic"}
_WRAPPERS = {"TwoSidedBRDF"}
_BENDERS = {"BumpMap", "NormalMap"}
_COMPUTED_OR_FIXED = ("vertex_normals", "vertex_texcoords")

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
        bsdf: the outermost BSDF it belongs to, or None.
        reason: why one path cannot serve two values of it, "" if it can.
        replayable: whether path replay gives its derivative; if not, for the same reason.
        delta: how the BSDF's perfectly specular lobes follow it, one of the `DELTA_...` constants of the integrators.
        medium: whether extinction or scattering of a participating medium depends on it.
        phase: whether it belongs to a phase function.
    """

    geometric: bool
    bsdf: mi.BSDF | None
    reason: str
    replayable: bool = True
    delta: int = DELTA_EQUAL
    medium: bool = False
    phase: bool = False

    @property
    def shares_paths(self) -> bool:
        """Whether one path serves two values of it."""
        return not self.reason

    @property
    def changes_delta(self) -> bool:
        """Whether perfectly specular lobes change with it."""
        return self.delta != DELTA_EQUAL


def parameter_traits(parameters: mi.SceneParameters, key: str) -> ParameterTraits:
    """How the parameter `key` of a traversed scene reaches the image, from the chain of objects that holds it."""
    node = parameters.properties[key][2]
    leaf = key.rsplit(".", 1)[-1]
    chain: list[Any] = []
    while node is not None and node in parameters.hierarchy:
        chain.append(node)
        node = parameters.hierarchy[node][0]
    bsdfs = [n for n in chain if isinstance(n, mi.BSDF)]
    if bsdfs:
        if bsdfs[0].class_name() == "RoughPlastic" and leaf in ("alpha", "eta"):
            why = "Mitsuba's roughplastic tabulates its transmittance from it without a derivative"
            return ParameterTraits(False, bsdfs[-1], why, replayable=False)
        return _bsdf_traits(bsdfs, chain)
    if any(isinstance(n, mi.Emitter) for n in chain):
        if leaf in ("to_world", "position", "direction", "cutoff_angle", "beam_width"):
            return ParameterTraits(True, None, "it moves an emitter")
        return ParameterTraits(False, None, "")
    if any(isinstance(n, mi.Medium) for n in chain):
        if any(n.class_name() == "BlendPhaseFunction" for n in chain) and ".weight." in key:
            why = "Mitsuba's blendphase passes no derivative to its weight"
            return ParameterTraits(False, None, why, replayable=False, phase=True)
        volume, phase = (any(isinstance(n, kind) for n in chain) for kind in (mi.Volume, mi.PhaseFunction))
        return ParameterTraits(False, None, "", medium=volume, phase=phase)
    if any(isinstance(n, mi.Sensor) for n in chain):
        return ParameterTraits(True, None, "it moves the sensor")
    shapes = [n for n in chain if isinstance(n, mi.Shape)]
    if shapes:
        if leaf.startswith(("vertex_", "face_")) and leaf not in ("vertex_positions", *_COMPUTED_OR_FIXED):
            return ParameterTraits(False, None, "")  # a mesh attribute, read through the shape pointer
        if shapes[-1].is_sensor():
            return ParameterTraits(True, None, "it moves a shape that carries a sensor", replayable=False)
        return ParameterTraits(True, None, "it moves a shape")
    return ParameterTraits(True, None, "it is neither a material's nor an emitter's")


def _bsdf_traits(bsdfs: list[Any], chain: list[Any]) -> ParameterTraits:
    """How a parameter inside this nest of BSDFs (innermost first) reaches the image: what its delta lobes make of it."""
    outer = bsdfs[-1]
    if not mi.has_flag(bsdfs[0].flags(), mi.BSDFFlags.Delta):
        return ParameterTraits(False, outer, "")  # whatever mirrors stand beside it do not change
    names = [b.class_name() for b in bsdfs if b.class_name() not in _WRAPPERS]
    if names == ["MaskBSDF"] and not _masks_delta(outer):
        return ParameterTraits(False, outer, "", delta=DELTA_MASK)
    inner = names[0]
    if inner in _SIMPLE_DELTA and all(name in _BENDERS for name in names[1:]):
        if not any(isinstance(c, mi.Texture) for c in chain):  # the index of refraction is no texture
            return ParameterTraits(
                False, outer, "it bends the direction of a perfectly specular lobe", replayable=False
            )
        turned = "it lies under a bump or normal map that turns a specular lobe" if names[1:] else ""
        return ParameterTraits(False, outer, turned, delta=DELTA_SIMPLE)
    if inner in _BENDERS:
        return ParameterTraits(False, outer, "it bends the direction of a perfectly specular lobe", replayable=False)
    return ParameterTraits(False, outer, "its BSDF mixes perfectly specular lobes with others", replayable=False)


def _masks_delta(bsdf: Any) -> bool:
    """Whether what lies under a mask (the outermost BSDF) has perfectly specular lobes of its own."""
    return any(
        mi.has_flag(bsdf.flags(), kind) for kind in (mi.BSDFFlags.DeltaReflection, mi.BSDFFlags.DeltaTransmission)
    )


def transform_obstacle(scene: mi.Scene, parameters: mi.SceneParameters, key: str) -> str:
    """Return why the object whose transformation is `key` has no pose, "" where it has one."""
    node: Any = parameters.properties[key][2]
    if isinstance(node, mi.Emitter):
        return f"it places an emitter ({node.class_name()}), which has no pose"
    if isinstance(node, mi.Sensor) and not any(node.id() == sensor.id() for sensor in scene.sensors()):
        return "it places a sensor of a batch, which has no pose of its own; give the sensors to the scene one by one"
    if isinstance(node, mi.Shape) and node.is_emitter():
        return "it places a shape that emits light, which has no pose"
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
    return f"{why}; recover a mesh's vertex_positions instead"


def is_of_vertices(parameters: mi.SceneParameters, key: str) -> bool:
    """Whether a parameter has values at the vertices of a mesh that images depend on: their positions, or an attribute."""
    owner, _, name = key.rpartition(".")
    return name.startswith("vertex_") and name not in _COMPUTED_OR_FIXED and f"{owner}.faces" in parameters


def normals_key(key: str) -> str:
    """The key of the normals that Mitsuba computes when the parameter `key` changes, "" where it computes none."""
    owner, _, name = key.rpartition(".")
    return f"{owner}.vertex_normals" if name == "vertex_positions" else ""
