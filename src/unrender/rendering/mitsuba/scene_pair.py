# Dr.Jit's stubs know less than its functions return.
# pyright: reportArgumentType=false, reportAttributeAccessIssue=false, reportReturnType=false

"""One scene description, loaded twice: the *current* and the *previous* state, and the tables that lead from one to the other.

Paths are traced in the current scene only. At a hit, the BSDF, emitter or shape of the previous state is found by a gather
from pointer id to pointer id. No adapter plugin is needed, and every BSDF that Mitsuba can nest is served.
"""

from __future__ import annotations

import re
import weakref
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from unrender.backend.variant import ensure
from unrender.core.errors import InputError
from unrender.rendering.mitsuba import emissive
from unrender.rendering.mitsuba.grid_transforms import attached_media, extinction_transforms
from unrender.rendering.mitsuba.integrators.majorant_supergrid import MajorantSupergrids
from unrender.rendering.mitsuba.integrators.specular import DELTA_EQUAL, DELTA_MASK, DELTA_SIMPLE
from unrender.rendering.renderer import ParameterInfo

SceneDescription = str | Path | dict | Callable[[], Any]
"""An XML file, a Mitsuba dictionary, or a function that returns one (called twice, so that ready-made objects such as
meshes are made twice)."""

# Delta lobes whose value in the previous state can be had by sampling that lobe alone, where their directions do not
# depend on the parameter.
_SIMPLE_DELTA = {"SmoothConductor", "SmoothDielectric", "ThinDielectric", "SmoothPlastic"}
_WRAPPERS = {"TwoSidedBRDF"}
_BENDERS = {"BumpMap", "NormalMap"}


def load(description: SceneDescription) -> Any:
    """One Mitsuba scene. Meshes are not merged, so that two loads have their shapes in the same order.

    Raises `InputError` in one line where the file is missing or Mitsuba refuses the description.
    """
    return load_resolved(description)[0]


def load_resolved(description: SceneDescription) -> tuple[Any, Any]:
    """As `load`, and what was loaded: the file's path, or the dictionary."""
    ensure()
    emissive.register()
    if callable(description):
        description = description()
    try:
        if isinstance(description, (str, Path)):
            path = Path(description)
            if not path.is_file():
                raise InputError(f"scene {path}: no such file")
            scene = mi.load_file(str(path), parallel=False, optimize=False)
        elif isinstance(description, dict):
            scene = mi.load_dict(description, parallel=False, optimize=False)
        else:
            raise InputError(f"scene: expected an .xml path or a Mitsuba dictionary, got {type(description).__name__}")
    except InputError:
        raise
    except Exception as error:
        name = str(description) if isinstance(description, (str, Path)) else "dictionary"
        raise InputError(f"scene {name}: Mitsuba could not load it: {_one_line(error)}") from error
    if not isinstance(scene, mi.Scene):
        raise InputError(f"scene: the description makes a {type(scene).__name__}, not a scene")
    if not scene.sensors():
        raise InputError("scene: it has no sensor, and nothing can be rendered without one")
    return scene, Path(description) if isinstance(description, str) else description


def _one_line(error: Exception) -> str:
    if own := re.search(r"InputError: (.+)", str(error)):  # of a plugin of ours, under Mitsuba's traceback
        return own[1]
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return " ".join(lines)[:400] or type(error).__name__


@dataclass(frozen=True)
class ParameterTraits:
    """How a parameter reaches the picture, read off the scene graph.

    Attributes:
        geometric: moves shapes, sensors or emitters, so that paths themselves change.
        bsdf: the outermost BSDF it belongs to, or None.
        reason: why one path cannot serve two values of it, "" if it can.
        blind: whether path replay cannot tell its derivative either, for the same reason.
        delta: how the BSDF's perfectly specular lobes follow it, one of `path_pair.DELTA_...`.
        medium: whether extinction or scattering of a participating medium depends on it.
        phase: whether it belongs to a phase function.
    """

    geometric: bool
    bsdf: Any
    reason: str
    blind: bool = False
    delta: int = DELTA_EQUAL
    medium: bool = False
    phase: bool = False


_living: weakref.WeakSet[ScenePair] = weakref.WeakSet()
"""Frozen kernels must be handed every scene whose objects they might call through a pointer."""


class ScenePair:
    """Two loads of one description.

    Args:
        description: what to load.

    Attributes:
        current, previous: `mitsuba.Scene`.
        current_parameters, previous_parameters: their `mitsuba.SceneParameters`.
        volumetric: whether there is a participating medium.
    """

    def __init__(self, description: SceneDescription):
        self.description = description
        self.current, resolved = load_resolved(description)
        self.current_parameters = mi.traverse(self.current)
        self.volumetric = bool(media(self.current))
        self._grid_transforms = extinction_transforms(resolved) if self.volumetric else {}
        self._check_media()
        self._previous: Any = None
        self._previous_parameters: Any = None
        self._tables: dict[str, Any] | None = None
        self._media: dict[tuple[bool, int], dict[str, Any]] = {}
        self._majorants: dict[bool, MajorantSupergrids] = {}
        _living.add(self)

    @property
    def previous(self) -> Any:
        """The second load, made when first asked for."""
        if self._previous is None:
            self._previous = load(self.description)
            self._previous_parameters = mi.traverse(self._previous)
        return self._previous

    def others(self) -> list[Any]:
        """Every scene but the current one that any pair of this process holds, the own previous one among them."""
        return [
            scene for pair in _living for scene in (pair.current, pair._previous) if scene not in (None, self.current)
        ]

    @property
    def previous_parameters(self) -> Any:
        """`mitsuba.SceneParameters` of the second load."""
        _ = self.previous
        return self._previous_parameters

    def check_separate(self, keys: list[str]) -> None:
        """Raise `InputError` where the two loads share the object that holds a parameter."""
        for key in keys:
            if self.current_parameters.properties[key][2] is self.previous_parameters.properties[key][2]:
                raise InputError(
                    f"parameter {key}: the scene dictionary holds a ready-made Mitsuba object, which two states would "
                    "share; give the scene as a function that returns the dictionary"
                )

    def tables(self) -> dict[str, Any]:
        """Pointer tables {"bsdf" | "emitter" | "shape" | "medium": UInt32}, from registry ids of current to those of previous."""
        if self._tables is None:
            current, previous = self.current.shapes_dr(), self.previous.shapes_dr()
            self._tables = {
                "bsdf": _table(current.bsdf(), previous.bsdf()),
                "emitter": _table(self.current.emitters_dr(), self.previous.emitters_dr()),
                "shape": _table(current, previous),
                "medium": _table(_media_ids(self.current), _media_ids(self.previous)),
            }
        return self._tables

    def media(self, previous: bool, sensor: int) -> dict[str, Any]:
        """Tables of one of the two scenes {"camera" | "emits": UInt32}: the registry id of the medium that a sensor says it stands in, 0
        for none; by registry ids, 1 for media that emit."""
        if (previous, sensor) not in self._media:
            scene = self.previous if previous else self.current
            camera = scene.sensors()[sensor].get_medium()
            found = {_id(medium): emissive.emits(medium) for medium in media(scene)}
            emits = np.zeros(max(found, default=0) + 1, np.uint32)
            for number, shines in found.items():
                emits[number] = shines
            tables = {"camera": dr.opaque(mi.UInt32, _id(camera)), "emits": mi.UInt32(emits)}
            self._media[previous, sensor] = tables
        return self._media[previous, sensor]

    def majorants(self, previous: bool, both: bool) -> dict[str, Any]:
        """The coarse grids of majorants of one of the two scenes, by its registry ids, from the values that it holds now; of `both`,
        bounds of both. {"frames" | "layout" | "every"} as in `MajorantSupergrids`, "majorants": its values; nothing where no medium
        has such a grid."""
        grids = self._grids(previous)
        if not grids:
            return {}
        majorants = grids.values()
        if both:
            other = self._grids(not previous)
            if grids.shapes() != other.shapes():
                return {}
            majorants = dr.maximum(majorants, other.values())
        return {"frames": grids.frames, "layout": grids.layout, "every": grids.every, "majorants": majorants}

    def _grids(self, previous: bool) -> MajorantSupergrids:
        if previous not in self._majorants or not self._majorants[previous].fits():
            scene = self.previous if previous else self.current
            attached = {key: _id(medium) for key, medium in attached_media(scene)}
            transforms = {attached[key]: matrix for key, matrix in self._grid_transforms.items() if key in attached}
            self._majorants[previous] = MajorantSupergrids({_id(medium): medium for medium in media(scene)}, transforms)
        return self._majorants[previous]

    def _check_media(self) -> None:
        """Raise `InputError` where the scene itself gives a medium values that make no sense: Mitsuba takes them as they are."""
        for key in self.current_parameters.keys():  # noqa: SIM118 (iterating gives pairs)
            if not parameter_traits(self.current_parameters, key).medium:
                continue
            low, high = _physical_range(self.current_parameters, key)
            values = to_tensor(self.current_parameters[key]).numpy()
            if not np.isfinite(values).all():
                raise InputError(f"scene: {key} holds values that are not finite")
            if low is not None and values.min(initial=np.inf) < low:
                raise InputError(f"scene: {key} must be at least {low:g}, got {values.min():g}")
            if high is not None and values.max(initial=-np.inf) > high:
                raise InputError(f"scene: {key} must be at most {high:g}, got {values.max():g}")

    @property
    def emissive(self) -> bool:
        """Whether there is a medium that emits."""
        return any(emissive.emits(medium) for medium in media(self.current))

    def parameter_traits(self, key: str) -> ParameterTraits:
        """How the parameter `key` reaches the picture."""
        traits = parameter_traits(self.current_parameters, key)
        if self.volumetric and traits.geometric:
            return replace(traits, reason=f"{traits.reason}, in a scene with media", blind=True)
        if self.volumetric and traits.delta == DELTA_MASK:
            # Connections to emitters pass masks, and their derivative would be needed there too.
            return replace(traits, reason="it is the opacity of a mask in a scene with media", blind=True)
        return traits

    def info(self) -> Mapping[str, ParameterInfo]:
        """`ParameterInfo` of every parameter of the scene."""
        return {key: self._info(key) for key in self.current_parameters.keys()}  # noqa: SIM118 (iterating gives pairs)

    def _info(self, key: str) -> ParameterInfo:
        flags = self.current_parameters.flags(key)
        value = self.current_parameters[key]
        try:
            shape = native_shape(value)
        except TypeError:
            why = f"its type {type(value).__name__} has no derivatives"
            return ParameterInfo((), False, False, why, perturbable=False)
        if re.match(r"object_\d{9,}\.", key):
            why = "its object has no id in the XML, so its name changes; give it one"
            return ParameterInfo(shape, False, False, why, perturbable=False)
        if isinstance(value, (int, float)):
            why = "it is a plain number, which Mitsuba compiles into its kernels"
            return ParameterInfo(shape, False, False, why, perturbable=False, compiled=True)
        if flags & (mi.ParamFlags.NonDifferentiable | mi.ParamFlags.ReadOnly):
            why = "Mitsuba marks it as not differentiable"
            if key.endswith(".data") and dr.is_tensor_v(value):
                why += ': its texture is stored in 8 bits, load it with format="variant" or from a float file'
            able = dr.is_float_v(value) and not flags & mi.ParamFlags.ReadOnly
            return ParameterInfo(shape, False, False, why, perturbable=able)
        if not dr.is_float_v(value):
            return ParameterInfo(shape, False, False, "it holds integers", perturbable=False)
        traits = self.parameter_traits(key)
        low, high = _physical_range(self.current_parameters, key)
        if traits.blind:
            return ParameterInfo(shape, False, False, traits.reason, low, high)
        return ParameterInfo(
            shape, True, not traits.reason, traits.reason, low, high, resizable=self._resizable(key, shape)
        )

    def _resizable(self, key: str, shape: tuple[int, ...]) -> bool:
        """Whether it is the data of a bitmap texture or a grid volume: these take another resolution when they are updated."""
        node = self.current_parameters.properties[key][2]
        axes = 4 if isinstance(node, mi.Volume) else 3 if isinstance(node, mi.Texture) else 0
        return key.endswith("data") and len(shape) == axes


def media(scene: Any) -> list[Any]:
    """All participating media of a scene, once for each place they are in, in an order that two loads share."""
    return [medium for _, medium in attached_media(scene)]


def _id(medium: Any) -> int:
    """Its registry id, 0 for None."""
    return int(dr.reinterpret_array(mi.UInt32, mi.MediumPtr(medium)).numpy()[0])


def _media_ids(scene: Any) -> Any:
    return mi.UInt32([0, *(_id(medium) for medium in media(scene))])


def _table(current: Any, previous: Any) -> Any:
    source = dr.reinterpret_array(mi.UInt32, current).numpy()
    target = dr.reinterpret_array(mi.UInt32, previous).numpy()
    if source.shape != target.shape:
        raise InputError("scene: two loads of the description differ in their shapes or emitters")
    table = np.zeros(int(source.max(initial=0)) + 1, np.uint32)
    table[source] = target
    return mi.UInt32(table)


def parameter_traits(parameters: Any, key: str) -> ParameterTraits:
    """How the parameter `key` of a traversed scene reaches the picture, from the chain of objects that holds it."""
    node = parameters.properties[key][2]
    leaf = key.rsplit(".", 1)[-1]
    chain: list[Any] = []
    while node is not None and node in parameters.hierarchy:
        chain.append(node)
        node = parameters.hierarchy[node][0]
    bsdfs = [n for n in chain if isinstance(n, mi.BSDF)]
    if bsdfs:
        return _bsdf_traits(bsdfs, chain)
    if any(isinstance(n, mi.Emitter) for n in chain):
        if leaf in ("to_world", "position", "direction", "cutoff_angle", "beam_width"):
            return ParameterTraits(True, None, "it moves an emitter")
        return ParameterTraits(False, None, "")
    if any(isinstance(n, mi.Medium) for n in chain):
        volume, phase = (any(isinstance(n, kind) for n in chain) for kind in (mi.Volume, mi.PhaseFunction))
        return ParameterTraits(False, None, "", medium=volume, phase=phase)
    if any(isinstance(n, mi.Sensor) for n in chain):
        return ParameterTraits(True, None, "it moves the sensor")
    if any(isinstance(n, mi.Shape) for n in chain):
        if leaf.startswith(("vertex_color", "face_color")) or (leaf.startswith(("vertex_", "face_")) and leaf not in (
            "vertex_positions", "vertex_normals", "vertex_texcoords"
        )):  # fmt: skip
            return ParameterTraits(False, None, "")  # a mesh attribute, read through the shape pointer
        return ParameterTraits(True, None, "it moves a shape")
    return ParameterTraits(True, None, "it is neither a material's nor an emitter's")


def _bsdf_traits(bsdfs: list[Any], chain: list[Any]) -> ParameterTraits:
    """How a parameter inside this nest of BSDFs (innermost first) reaches the picture: what its delta lobes make of it."""
    outer = bsdfs[-1]
    if not mi.has_flag(bsdfs[0].flags(), mi.BSDFFlags.Delta):
        return ParameterTraits(False, outer, "")  # whatever mirrors stand beside it do not change
    names = [b.class_name() for b in bsdfs if b.class_name() not in _WRAPPERS]
    if names == ["MaskBSDF"] and not _masks_delta(outer):
        return ParameterTraits(False, outer, "", delta=DELTA_MASK)
    inner = names[0]
    if inner in _SIMPLE_DELTA and all(name in _BENDERS for name in names[1:]):
        if not any(isinstance(c, mi.Texture) for c in chain):  # the index of refraction is no texture
            return ParameterTraits(False, outer, "it bends the direction of a perfectly specular lobe", blind=True)
        turned = "it lies under a bump or normal map that turns a specular lobe" if names[1:] else ""
        return ParameterTraits(False, outer, turned, delta=DELTA_SIMPLE)
    if inner in _BENDERS:
        return ParameterTraits(False, outer, "it bends the direction of a perfectly specular lobe", blind=True)
    return ParameterTraits(False, outer, "its BSDF mixes perfectly specular lobes with others", blind=True)


def _masks_delta(bsdf: Any) -> bool:
    """Whether what lies under a mask (the outermost BSDF) has perfectly specular lobes of its own."""
    return any(
        mi.has_flag(bsdf.flags(), kind) for kind in (mi.BSDFFlags.DeltaReflection, mi.BSDFFlags.DeltaTransmission)
    )


def _physical_range(parameters: Any, key: str) -> tuple[float | None, float | None]:
    """The range that makes physical sense, from the names Mitsuba gives to its parameters."""
    node = parameters.properties[key][2]
    names = key.split(".")
    role = next((n for n in reversed(names) if n not in ("value", "data", "color0", "color1", "scale")), "")
    while node is not None and not isinstance(node, (mi.BSDF, mi.Emitter, mi.Medium)):
        node = parameters.hierarchy[node][0] if node in parameters.hierarchy else None
    if isinstance(node, mi.Emitter):
        return (
            (0.0, None)
            if role in ("radiance", "intensity", "irradiance") or names[-1] in ("scale", "data")
            else (None, None)
        )
    if isinstance(node, mi.Medium):
        ranges = {"sigma_t": (0.0, None), "albedo": (0.0, 1.0), "emission": (0.0, None), "g": (-0.99, 0.99)}
        return ranges.get(role, (None, None))
    if not isinstance(node, mi.BSDF):
        return None, None
    if role in ("alpha", "alpha_u", "alpha_v", "roughness"):
        return 0.02, 1.0
    if role in ("eta", "k"):
        return 0.0, None
    if role == "normalmap":
        return 0.0, 1.0
    if role in (
        "reflectance", "diffuse_reflectance", "specular_reflectance", "specular_transmittance", "diffuse_transmittance",
        "transmittance", "base_color", "metallic", "specular", "anisotropic", "spec_tint", "sheen", "sheen_tint",
        "clearcoat", "clearcoat_gloss", "spec_trans", "flatness", "diff_trans", "opacity", "weight",
    ):  # fmt: skip
        return 0.0, 1.0
    return None, None


def native_shape(value: Any) -> tuple[int, ...]:
    """The shape of the tensor that stands for a Mitsuba value. Raises `TypeError` for what is no array."""
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


def to_tensor(value: Any) -> Any:
    """The tensor (`mi.TensorXf`, detached) that stands for a Mitsuba value."""
    shape = native_shape(value)
    if isinstance(value, (int, float)):
        return mi.TensorXf(np.float32(value))
    if dr.is_tensor_v(value):
        return mi.TensorXf(dr.detach(value))
    return mi.TensorXf(dr.ravel(dr.detach(value)), shape)


def from_tensor(tensor: Any, like: Any) -> Any:
    """The Mitsuba value of the type of `like` for a tensor; the inverse of `to_tensor`."""
    if dr.is_tensor_v(like):
        return type(like)(tensor.array, tuple(tensor.shape))
    if dr.depth_v(like) == 1:
        return type(like)(tensor.array)
    return dr.unravel(type(like), type(like[0])(tensor.array))
