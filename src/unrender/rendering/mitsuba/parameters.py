"""Effect of a parameter on the image, derived from the scene graph, and conversion of Mitsuba values to tensors.

The tensor of a number is (), of a colour (3,), of a bitmap (H, W, C), of a grid (Z, Y, X, C).
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Literal

import drjit as dr
import mitsuba as mi
import numpy as np

from unrender.core import arrays
from unrender.rendering.mitsuba import poses
from unrender.rendering.mitsuba.integrators.specular import DELTA_MASK, DELTA_SIMPLE
from unrender.rendering.mitsuba.mesh_layout import FACES, NORMALS, POSITIONS, TEXCOORDS
from unrender.rendering.mitsuba.scene_graph import ObjectGraph, attribute, children
from unrender.rendering.parameter_errors import Role

# BSDFs whose delta lobes have directions that do not depend on the parameter. Sampling that lobe alone gives its value in the
# previous state.
_SIMPLE_DELTA = {"SmoothConductor", "SmoothDielectric", "ThinDielectric", "SmoothPlastic"}
_WRAPPERS = {"TwoSidedBRDF"}
_NORMAL_PERTURBATIONS = {"BumpMap", "NormalMap"}
MOVED_MIRROR = (
    "path gradients do not follow the directions of a moving perfectly specular lobe (conductor, dielectric, plastic); "
    "use --method smoothed, or a rough BSDF"
)
_MIXED = "its BSDF mixes perfectly specular lobes with others"
_COMPUTED_OR_FIXED = (NORMALS, TEXCOORDS)
_REFUTED = {"RoughDielectric": {"alpha", "alpha_u", "alpha_v", "eta"}, "PrincipledThin": {"roughness", "anisotropic"}}
"""{class of a BSDF: slots whose path gradients disagree with finite differences}."""
_LIGHT = ("radiance", "intensity", "irradiance")
_REFLECTANCE = (
    "reflectance", "diffuse_reflectance", "specular_reflectance", "diffuse_transmittance", "specular_transmittance", "base_color",
)  # fmt: skip
_DIRECTIONS = (NORMALS, "sun_direction", "direction")
_NORMALISED = {"TabulatedPhaseFunction": "values"}
"""{class of a plugin: list of values that it normalises, so that a common factor changes no image}. Pictures depend on the factor of the
entries of an SGGX matrix, though little."""

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
    """Effect of a parameter on the image, derived from the scene graph.

    Attributes:
        geometric: whether it moves shapes, sensors or emitters, so that the paths change.
        reason: reason why one path cannot be shared by two values of it; "" if it can.
        replayable: whether path replay gives its derivative; if not, `reason` states why.
        delta_lobes: BSDFs of shapes whose perfectly specular lobes depend on it, each with one of the `DELTA_...` constants.
        medium: whether extinction or scattering of a participating medium depends on it.
        phase: whether it belongs to a phase function.
        light: whether it moves an emitter without a shape, which needs no acceleration structure.
        turns: whether it turns an emitter without a shape, whose radiance changes continuously.
    """

    geometric: bool
    reason: str
    replayable: bool = True
    delta_lobes: tuple[tuple[Any, int], ...] = ()
    medium: bool = False
    phase: bool = False
    light: bool = False
    turns: bool = False

    @property
    def shares_paths(self) -> bool:
        """True if two values of the parameter can share one path."""
        return not self.reason

    @property
    def changes_delta(self) -> bool:
        """True if perfectly specular lobes depend on the parameter."""
        return bool(self.delta_lobes)


def parameter_traits(parameters: mi.SceneParameters, key: str, graph: ObjectGraph) -> ParameterTraits:
    """Return the traits of the parameter `key` of a traversed scene.

    A shared object affects the image through several chains of owners. The result combines the restrictions of all chains.
    """
    traits = [_traits_of(chain, key) for chain in _chains(parameters, key, graph)]
    return functools.reduce(_combined, traits) if traits else ParameterTraits(False, "")


def shows(aov: str, parameters: mi.SceneParameters, key: str, graph: ObjectGraph) -> bool:
    """Return whether an AOV, one of `AOVS`, can depend on the parameter `key` of a traversed scene."""
    if (leaf := key.rpartition(".")[2]) in _COMPUTED_OR_FIXED:  # the albedo of a rough conductor depends on its normals
        return aov == "albedo" or (aov == "sh_normal" and leaf == NORMALS)
    hidden = (mi.Emitter, mi.Medium) if aov == "albedo" else (mi.Emitter, mi.Medium, mi.BSDF)
    chains = _chains(parameters, key, graph)
    return any(not any(isinstance(node, hidden) for node in chain) for chain in chains)


def _chains(parameters: mi.SceneParameters, key: str, graph: ObjectGraph) -> list[list[Any]]:
    """Return the chains of objects through which a parameter affects the image. Each begins with the object that reads it."""
    leaf, node = key.rsplit(".", 1)[-1], parameters.properties[key][2]
    is_attribute = leaf.startswith(("vertex_", "face_")) and leaf not in (POSITIONS, *_COMPUTED_OR_FIXED)
    if isinstance(node, mi.Mesh) and is_attribute:
        readers = (texture for texture in graph.nodes if attribute(texture)[0] == leaf)
        return [chain for reader in readers for chain in graph.chains(reader) if node in chain]
    chains = list(graph.chains(node))
    # a texture that the scene itself holds has no effect there
    return [chain for chain in chains if len(chain) > 2] or chains


def _combined(one: ParameterTraits, other: ParameterTraits) -> ParameterTraits:
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
    """Return the traits along one chain of objects, which begins with the object that holds the parameter."""
    leaf = key.rsplit(".", 1)[-1]
    bsdfs = [n for n in chain if isinstance(n, mi.BSDF)]
    if bsdfs:
        if bsdfs[0].class_name() == "RoughPlastic" and leaf in ("alpha", "eta"):
            reason = "Mitsuba's roughplastic tabulates its transmittance from it without a derivative"
            return ParameterTraits(False, reason, replayable=False)
        if _REFUTED.get(bsdfs[0].class_name(), set()) & set(key.split(".")):
            reason = f"path gradients of it disagree with finite differences ({bsdfs[0].class_name()})"
            return ParameterTraits(False, reason, replayable=False)
        return _bsdf_traits(bsdfs, chain)
    if any(isinstance(n, mi.Emitter) for n in chain):
        if leaf in ("to_world", "position", "direction", "cutoff_angle", "beam_width"):
            return ParameterTraits(True, "it moves an emitter", light=True)
        if leaf == "sun_direction":
            reason = "it moves the sun's disk, and path gradients do not support its boundary"
            return ParameterTraits(False, reason, replayable=False)
        if leaf == "data" and any(
            n.class_name() == "EnvironmentMapEmitter" and not poses.keeps_lengths(n) for n in chain
        ):
            reason = "Mitsuba samples its light with a wrong density, because its to_world is no rotation or reflection"
            return ParameterTraits(False, reason, replayable=False)
        return ParameterTraits(False, "")
    if any(isinstance(n, mi.Medium) for n in chain):
        if any(
            n.class_name() == "BlendPhaseFunction" and not isinstance(child, mi.PhaseFunction)
            for child, n in pairwise(chain)
        ):
            reason = "Mitsuba's blendphase passes no derivative to its weight"
            return ParameterTraits(False, reason, replayable=False, phase=True)
        if any(n.class_name() == "SGGXPhaseFunction" for n in chain):
            reason = "path gradients of it disagree with finite differences (SGGXPhaseFunction)"
            return ParameterTraits(False, reason, replayable=False, phase=True)
        volume, phase = (any(isinstance(n, kind) for n in chain) for kind in (mi.Volume, mi.PhaseFunction))
        return ParameterTraits(False, "", medium=volume, phase=phase)
    if any(isinstance(n, mi.Sensor) for n in chain):
        return ParameterTraits(True, "it moves the sensor")
    shapes = [n for n in chain if isinstance(n, mi.Shape)]
    if shapes:
        if shapes[-1].is_sensor():
            return ParameterTraits(True, "it moves a shape that carries a sensor", replayable=False)
        if any(is_mirror_or_glass(shape.bsdf()) for shape in shapes):
            return ParameterTraits(True, f"it moves a shape, and {MOVED_MIRROR}", replayable=False)
        return ParameterTraits(True, "it moves a shape")
    return ParameterTraits(True, "it is neither a material's nor an emitter's")


def _bsdf_traits(bsdfs: list[Any], chain: list[Any]) -> ParameterTraits:
    """Return the traits of a parameter inside nested BSDFs (innermost first), which depend on their delta lobes."""
    outer = bsdfs[-1]
    if not mi.has_flag(bsdfs[0].flags(), mi.BSDFFlags.Delta):
        return ParameterTraits(False, "")  # mirrors elsewhere in the nest do not change
    names = [b.class_name() for b in bsdfs if b.class_name() not in _WRAPPERS]
    passes = any(isinstance(x, mi.BSDF) and mi.has_flag(x.flags(), mi.BSDFFlags.Null) for _, x in children(bsdfs[0]))
    if names == ["MaskBSDF"] and not passes and not is_mirror_or_glass(outer):
        return ParameterTraits(False, "", delta_lobes=((outer, DELTA_MASK),))
    inner = names[0]
    if inner in _SIMPLE_DELTA and all(name in _NORMAL_PERTURBATIONS for name in names[1:]):
        if not any(isinstance(c, mi.Texture) for c in chain):  # the index of refraction is not a texture
            return ParameterTraits(False, "it changes the direction of a perfectly specular lobe", replayable=False)
        reason = "it is inside a bump or normal map that rotates a specular lobe" if names[1:] else ""
        return ParameterTraits(False, reason, delta_lobes=((outer, DELTA_SIMPLE),))
    if inner in _NORMAL_PERTURBATIONS:
        return ParameterTraits(False, "it changes the direction of a perfectly specular lobe", replayable=False)
    return ParameterTraits(False, _MIXED, replayable=False)


def is_mirror_or_glass(bsdf: Any) -> bool:
    """Return whether a BSDF, or the one inside a mask, has lobes with a single direction other than straight on."""
    return bsdf is not None and any(
        mi.has_flag(bsdf.flags(), kind) for kind in (mi.BSDFFlags.DeltaReflection, mi.BSDFFlags.DeltaTransmission)
    )


def transform_obstacle(scene: mi.Scene, parameters: mi.SceneParameters, key: str) -> str:
    """Return the reason why the object whose transformation is `key` has no pose; "" if it has one."""
    node: Any = parameters.properties[key][2]
    if isinstance(node, mi.Emitter) and not (poses.is_posable(node) and node in scene.emitters()):
        return f"it places an emitter ({node.class_name()}), which has no pose"
    if isinstance(node, mi.Sensor) and not any(node.id() == sensor.id() for sensor in scene.sensors()):
        return "it places a sensor of a batch, which has no pose of its own; give the sensors to the scene one by one"
    if isinstance(node, mi.Shape) and node.is_sensor():
        return "it places a shape that carries a sensor, which has no pose"
    return ""


def update_obstacle(parameters: mi.SceneParameters, key: str) -> str:
    """Return the reason why a parameter cannot be set to another value; "" if it can."""
    node, leaf = parameters.properties[key][2], key.rpartition(".")[2]
    if leaf not in _OUTLINES.get(node.class_name(), ()):
        return ""
    reason = "it changes the outline of a shape that is not a mesh, for which derivatives are not validated"
    if leaf == "grid":
        reason = "Mitsuba corrupts memory when the distances of an sdfgrid change"
    return f"{reason}; recover a mesh's {POSITIONS} instead"


def is_one_direction(key: str, value: Any) -> bool:
    """Return whether a parameter is a single direction, such as the sun's."""
    return key.rpartition(".")[2] in _DIRECTIONS and dr.size_v(value) == 3 and dr.width(value) == 1


def role(parameters: mi.SceneParameters, key: str, shape: tuple[int, ...]) -> Role:
    """Return the meaning of a parameter's values."""
    vectors = math.prod(shape) % 3 == 0 if len(shape) == 1 else bool(shape) and shape[-1] == 3
    names, node = key.split("."), parameters.properties[key][2]
    if vectors and names[-1] in _DIRECTIONS:
        return "direction"
    if _NORMALISED.get(node.class_name()) == names[-1] and math.prod(shape) > 1:
        return "ratios"
    bsdf = _holder(parameters, key, mi.BSDF)  # the normal or bump map, however its texture is wrapped
    if bsdf is None:
        return "value"
    if bsdf.class_name() == "BumpMap" and "nested_texture" in names and len(shape) > 1:
        return "height"
    return "normal" if vectors and bsdf.class_name() == "NormalMap" and "normalmap" in names else "value"


def _holder(parameters: mi.SceneParameters, key: str, *kinds: type) -> Any:
    """Return the nearest object of these classes that holds a parameter, or None."""
    node = parameters.properties[key][2]
    while node is not None and not isinstance(node, kinds):
        node = parameters.hierarchy[node][0] if node in parameters.hierarchy else None
    return node


def brightness(parameters: mi.SceneParameters, key: str) -> Literal["", "light", "reflectance"]:
    """Return the quantity that the image is proportional to: an emitter's light, a surface's reflectance, or neither."""
    names, node = key.split("."), _holder(parameters, key, mi.BSDF, mi.Emitter)
    if isinstance(node, mi.Emitter):
        emits = names[-1] in ("scale", "data") or any(name in _LIGHT for name in names)
        return "light" if emits else ""
    return "reflectance" if isinstance(node, mi.BSDF) and any(name in _REFLECTANCE for name in names) else ""


def is_nonlinear(parameters: mi.SceneParameters, key: str, singular: float | None) -> bool:
    """Return whether a parameter changes the form of the image, not its brightness: sensors, emitters except for their light, and
    indices of refraction."""
    node = _holder(parameters, key, mi.BSDF, mi.Emitter, mi.Sensor, mi.Medium)
    if isinstance(node, mi.Emitter):
        return brightness(parameters, key) != "light"
    return singular is not None or isinstance(node, mi.Sensor)


def is_of_vertices(parameters: mi.SceneParameters, key: str) -> bool:
    """Return whether a parameter has values at the vertices of a mesh that images depend on: positions or an attribute."""
    owner, _, name = key.rpartition(".")
    return name.startswith("vertex_") and name not in _COMPUTED_OR_FIXED and f"{owner}.{FACES}" in parameters


def normals_key(key: str) -> str:
    """Return the key of the normals that Mitsuba recomputes when the parameter `key` changes; "" if there are none."""
    owner, _, name = key.rpartition(".")
    return f"{owner}.{NORMALS}" if name == POSITIONS else ""


def tensor(values: np.ndarray) -> mi.TensorXf:
    """Return a tensor of these values in its own memory."""
    return mi.TensorXf(arrays.owned(values, mi.Float), np.shape(values))


class LatestTensors:
    """Tensors of parameters in successive states. Equal values have the tensor of the state before, so that the scene is not updated: for
    some BSDFs and for meshes that takes longer than a small picture."""

    def __init__(self) -> None:
        self._latest: dict[str, tuple[np.ndarray, mi.TensorXf]] = {}

    def of(self, key: str, value: np.ndarray) -> mi.TensorXf:
        """Return the tensor of a parameter's value."""
        latest = self._latest.get(key)
        if latest is None or not np.array_equal(latest[0], value):
            latest = self._latest[key] = np.array(value), tensor(value)
        return latest[1]


def native_shape(value: Any) -> tuple[int, ...]:
    """Return the shape of the tensor for a Mitsuba value. Raise `TypeError` for a value that is not an array."""
    if isinstance(value, (int, float)):
        return ()
    if not dr.is_array_v(value) or dr.is_matrix_v(value) or dr.is_special_v(value):
        raise TypeError(type(value).__name__)
    if dr.is_tensor_v(value):
        return tuple(value.shape)
    if dr.depth_v(value) == 1:
        return () if len(value) == 1 else (len(value),)
    if dr.depth_v(value) == 2 and dr.width(value) == 1:
        return (len(value),)
    raise TypeError(type(value).__name__)


def to_tensor(value: Any) -> mi.TensorXf:
    """Return the tensor (`mi.TensorXf`, detached) for a Mitsuba value."""
    shape = native_shape(value)
    if isinstance(value, (int, float)):
        return mi.TensorXf(np.float32(value))  # pyright: ignore[reportArgumentType]
    if dr.is_tensor_v(value):
        return mi.TensorXf(dr.detach(value))
    return mi.TensorXf(dr.ravel(dr.detach(value)), shape)  # pyright: ignore[reportArgumentType]


def from_tensor(tensor: mi.TensorXf, like: Any) -> Any:
    """Return the Mitsuba value of the type of `like` for a tensor; the inverse of `to_tensor`."""
    if dr.is_tensor_v(like):
        return type(like)(tensor.array, tuple(tensor.shape))
    if dr.depth_v(like) == 1:
        return type(like)(tensor.array)
    return dr.unravel(type(like), type(like[0])(tensor.array))


def is_broadcast(values: np.ndarray) -> bool:
    """Return whether an array has one state, or repeats one along its first axis without copies. Values are not compared."""
    return len(values) == 1 or np.asarray(values).strides[0] == 0
