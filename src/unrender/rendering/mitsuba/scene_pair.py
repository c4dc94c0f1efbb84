"""A scene description loaded twice, as the *current* and the *previous* state, with tables that map objects of one to the other.

Paths are traced in the current scene only. At a hit, a gather from pointer id to pointer id gives the BSDF, emitter or shape of the
previous state. This needs no adapter plugin, and supports every BSDF that Mitsuba can nest.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import replace
from functools import partial
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from unrender.core.errors import InputError
from unrender.rendering.mitsuba import emissive, film, mesh_layout, scene_loading
from unrender.rendering.mitsuba.camera_media import camera_media, medium_id
from unrender.rendering.mitsuba.integrators.base import pointer_table
from unrender.rendering.mitsuba.integrators.emitters import emitter_tables
from unrender.rendering.mitsuba.integrators.majorant_supergrid import MajorantSupergrids
from unrender.rendering.mitsuba.integrators.moved_vertices import bounding_ellipsoids
from unrender.rendering.mitsuba.integrators.specular import DELTA_MASK
from unrender.rendering.mitsuba.loaded_scene import LoadedScene
from unrender.rendering.mitsuba.parameters import (
    ParameterTraits,
    brightness,
    is_nonlinear,
    is_of_vertices,
    native_shape,
    parameter_traits,
    role,
    transform_obstacle,
    update_obstacle,
)
from unrender.rendering.mitsuba.pixel_filter import is_box
from unrender.rendering.mitsuba.poses import is_bare
from unrender.rendering.mitsuba.ranges import Range
from unrender.rendering.mitsuba.scene_graph import object_ids
from unrender.rendering.mitsuba.scene_loading import (
    SceneDescription,
    attached_media,
    extinction_transforms,
    is_loaded,
    media,
)
from unrender.rendering.renderer import ParameterInfo, ReplacedMesh, SampleRequest
from unrender.rendering.turns import Turns

SINGLE = (
    "scene: a loaded mi.Scene has one state, but a control variate or meta-estimation needs two; give the .xml file or "
    "the dictionary instead, or use images.Plain()"
)
"""Error message for a pair of states of a scene that the user has loaded."""


class ScenePair:
    """Two loads of one description.

    Args:
        description: what to load.
        moving: ids of shapes that move; spheres among them become meshes.
        replaced: {id of a shape: its new mesh}; not for a scene that the user has loaded.
        turns: rotations of lights for each sensor, see `LoadedScene`; not for a scene that the user has loaded.

    Attributes:
        single: whether there is one state only, since the user has loaded the scene.
        volumetric: whether there is a participating medium.
        resolutions: (height, width) of each sensor's film, after cropping.
    """

    def __init__(
        self,
        description: SceneDescription,
        moving: AbstractSet[str] = frozenset(),
        replaced: Mapping[str, ReplacedMesh] | None = None,
        turns: Turns | None = None,
    ):
        self.description, self.moving, self.replaced, self.turns = description, moving, dict(replaced or {}), turns
        self.single = is_loaded(description)
        if self.single and self.replaced:
            raise InputError("meshes of a loaded scene cannot be replaced; give the .xml file or the dictionary")
        self._current, self._previous = LoadedScene(description, moving, self.replaced, turns), None
        self.volumetric = bool(media(self.current))
        known = self.volumetric and not self.single
        self._grid_transforms = extinction_transforms(self._current.source) if known else {}
        self._check_media()
        sizes = (sensor.film().crop_size() for sensor in self.current.sensors())
        self.resolutions = [(int(size[1]), int(size[0])) for size in sizes]
        self._tables: dict[str, mi.UInt32] | None = None
        self._moved: dict[frozenset[str], dict[str, Any]] = {}
        self._moved_values: tuple[list[list[int]], Any, dict[str, mi.Float]] | None = None
        self._media: dict[tuple[bool, int | None], dict[str, mi.UInt32]] = {}
        self._cameras: dict[bool, list[int]] = {}
        self._majorants: dict[bool, MajorantSupergrids] = {}
        self._films: film.Films | None = None
        self._emitters: dict[bool, tuple[np.ndarray, dict[str, Any]]] = {}

    def loaded(self, previous: bool = False) -> LoadedScene:
        """Return the first load or, with `previous`, the second one, which is loaded on first use."""
        if not previous:
            return self._current
        if self.single:
            raise InputError(SINGLE)
        if self._previous is None:
            self._previous = LoadedScene(self.description, self.moving, self.replaced, self.turns)
            self._previous.share_values(self._current)
        return self._previous

    def as_described(self) -> LoadedScene:
        """Return the first load, or a load with the original spheres and lights if some of them became others."""
        changed = self._current.meshed or self.turns
        return LoadedScene(self.description, replaced=self.replaced) if changed else self._current

    @property
    def current(self) -> mi.Scene:
        """Scene of the first load."""
        return self._current.scene

    @property
    def previous(self) -> mi.Scene:
        """Scene of the second load."""
        return self.loaded(previous=True).scene

    @property
    def current_parameters(self) -> mi.SceneParameters:
        """Parameters of the first load."""
        return self._current.parameters

    def clear_gradients(self) -> None:
        """Clear the gradients of all leaves of both scenes."""
        self._current.clear_gradients()
        if self._previous is not None:
            self._previous.clear_gradients()

    def films(self, request: SampleRequest) -> film.Films | None:
        """Return the film data that the rays of a request need; None if all pixels belong to one sensor with a box filter."""
        if self._films is None:
            self._films = film.Films.of(self.current.sensors())
        if request.sensors is None and is_box(self.current.sensors()[request.sensor].film()):
            return None
        return replace(self._films, which=request.sensors)

    def check_separate(self, keys: list[str]) -> None:
        """Raise `InputError` if there is one load only, or if both loads share the object that holds a parameter."""
        if self.single:
            raise InputError(SINGLE)
        for key in keys:
            if self.current_parameters.properties[key][2] is self.loaded(previous=True).parameters.properties[key][2]:
                raise InputError(
                    f"parameter {key}: the scene dictionary holds a ready-made Mitsuba object, which two states would "
                    "share; give the scene as a function that returns the dictionary"
                )

    def tables(self) -> dict[str, mi.UInt32]:
        """Return pointer tables {"bsdf" | "emitter" | "shape" | "medium": UInt32} from registry ids of current to those of previous.

        They contain every object of the scene, including children of shape groups, nested BSDFs and media on both sides of a shape.
        """
        if self._tables is None:
            self._tables = self.loaded().graph.tables(self.loaded(previous=True).graph)
        return self._tables

    def emitter_tables(self, previous: bool, probabilities: np.ndarray) -> dict[str, Any]:
        """Return the tables of the emitters (`integrators.emitters`), cached for the last probabilities."""
        known = self._emitters.get(previous)
        if known is None or not np.array_equal(known[0], probabilities):
            tables = emitter_tables(self.loaded(previous).scene, probabilities)
            known = self._emitters[previous] = np.array(probabilities), tables
        return known[1]

    def moved_tables(self, moving: AbstractSet[str]) -> dict[str, Any]:
        """Return the tables of `MovedPair.sample` for the current values of both scenes. `moving`: ids of the meshes that may move."""
        meshes = [
            (now, before)
            for now, before in zip(self.current.shapes(), self.previous.shapes(), strict=True)
            if now.id() in moving
        ]
        if frozenset(moving) not in self._moved:
            current: Any = self.current.shapes_dr()
            previous: Any = self.previous.shapes_dr()
            ids: Any = dr.reinterpret_array(mi.UInt32, current).numpy()  # pyright: ignore[reportAttributeAccessIssue]
            triangles, first = np.zeros(int(ids.max(initial=0)) + 1, np.uint32), 1
            for number, shape in zip(ids, self.current.shapes(), strict=True):
                if shape.id() in moving:
                    triangles[number] = first
                    first += shape.face_count()
            self._moved[frozenset(moving)] = {
                "shape": pointer_table(current, previous),
                "shape_back": pointer_table(previous, current),
                "triangles": mi.UInt32(triangles),
                "emitters": self._emitter_bounds(moving),
            }
        positions = [[dr.detach(mesh_layout.positions(mesh)) for mesh in states] for states in meshes]
        # Identical memory has identical tables: it cannot be overwritten while it is referenced here.
        indices = [[mesh.index for mesh in states] for states in positions]
        if self._moved_values is None or self._moved_values[0] != indices:
            with dr.suspend_grad():
                ratios = [mesh_layout.areas(before) / mesh_layout.areas(now) for now, before in meshes]
                values = {
                    "area_ratios": dr.concat([mi.Float(1), *ratios]),
                    "ellipsoids": bounding_ellipsoids(positions),
                }
            dr.eval(values)
            self._moved_values = indices, positions, values
        return self._moved[frozenset(moving)] | self._moved_values[2]

    def _emitter_bounds(self, moving: AbstractSet[str]) -> mi.Float | None:
        """Return bounding ellipsoids of all emitters; None with an environment, or if an emitter moves."""
        shapes = [emitter.get_shape() for emitter in self.current.emitters()]
        shapes = [shape for shape in shapes if shape is not None]
        if self.current.environment() is not None or any(shape.id() in moving for shape in shapes):
            return None
        boxes = [shape.bbox() for shape in shapes]
        corners = [[mi.Float(np.ravel([np.array(box.corner(k)) for k in range(8)]))] for box in boxes]
        return bounding_ellipsoids(corners) if corners else None

    def delta_table(self, all_traits: Sequence[ParameterTraits]) -> mi.UInt32:
        """Return how perfectly specular lobes depend on these parameters: one of the `DELTA_...` constants by registry id of the BSDFs
        of the current and, through the pointer tables, of the previous scene."""
        changing = {bsdf: kind for traits in all_traits for bsdf, kind in traits.delta_lobes}
        numbers = object_ids("bsdf", changing)
        kinds = dict(zip(numbers.tolist(), changing.values(), strict=True))
        pointers = object_ids("bsdf", self.loaded().graph.of("bsdf"))
        if kinds and not self.single:  # avoids the second load otherwise
            previous = self.tables()["bsdf"].numpy()
            kinds |= {int(previous[number]): kind for number, kind in kinds.items()}
        table = np.zeros(max(int(pointers.max(initial=0)), *kinds, 0) + 1, np.uint32)
        for number, kind in kinds.items():
            table[number] = kind
        return mi.UInt32(table)

    def media(self, previous: bool, sensor: int | None) -> dict[str, mi.UInt32]:
        """Return tables of one scene: "camera", registry id of the medium around the sensor or around each sensor, 0 for none; and
        "emits", 1 for media that emit, by registry id."""
        if (previous, sensor) not in self._media:
            scene = self.previous if previous else self.current
            if previous not in self._cameras:
                self._cameras[previous] = [medium_id(medium) for medium in camera_media(scene, quiet=previous)]
            cameras = self._cameras[previous]
            camera = mi.UInt32(cameras) if sensor is None else dr.opaque(mi.UInt32, cameras[sensor])
            emission = {medium_id(medium): emissive.emits(medium) for medium in media(scene)}
            emits = np.zeros(max(emission, default=0) + 1, np.uint32)
            for number, value in emission.items():
                emits[number] = value
            tables = {"camera": camera, "emits": mi.UInt32(emits)}
            self._media[previous, sensor] = tables
        return self._media[previous, sensor]

    def majorants(self, previous: bool, both: bool) -> dict[str, mi.UInt32]:
        """Return the majorant supergrids of one scene for its current values, by its registry ids; with `both`, bounds of both scenes.
        The keys are "frames", "layout" and "every" as in `MajorantSupergrids`, and "majorants", its values. Empty without such grids."""
        grids = self._grids(previous)
        if not grids:
            return {}
        majorants = grids.values()
        if both:
            other = self._grids(not previous)
            if grids.shapes() != other.shapes():
                return {}
            majorants = dr.maximum(majorants, other.values())
        return {"frames": grids.frames, "layout": grids.layout, "every": grids.every, "majorants": majorants}  # pyright: ignore[reportReturnType]

    def _grids(self, previous: bool) -> MajorantSupergrids:
        if previous not in self._majorants or not self._majorants[previous].fits():
            scene = self.previous if previous else self.current
            attached = {key: medium_id(medium) for key, medium in attached_media(scene)}
            transforms = {attached[key]: matrix for key, matrix in self._grid_transforms.items() if key in attached}
            self._majorants[previous] = MajorantSupergrids(
                {medium_id(medium): medium for medium in media(scene)}, transforms
            )
        return self._majorants[previous]

    def _check_media(self) -> None:
        """Raise `InputError` for unphysical medium values in the scene, which Mitsuba does not check."""
        for key in self.current_parameters.keys():  # noqa: SIM118 (iterating gives pairs)
            if not self._traits(key).medium:
                continue
            physical = self.physical_range(key)
            low, high = physical.low, physical.high
            values = self._current.value(key).numpy()
            if not np.isfinite(values).all():
                raise InputError(f"scene: {key} holds values that are not finite")
            if low is not None and values.min(initial=np.inf) < low:
                raise InputError(f"scene: {key} must be at least {low:g}, got {values.min():g}")
            if high is not None and values.max(initial=-np.inf) > high:
                raise InputError(f"scene: {key} must be at most {high:g}, got {values.max():g}")

    @property
    def emissive(self) -> bool:
        """True if a medium emits."""
        return any(emissive.emits(medium) for medium in media(self.current))

    @property
    def radiance_field(self) -> bool:
        """True if all media emit in every direction."""
        return all(emissive.is_positive(medium) for medium in media(self.current))

    def parameter_traits(self, key: str) -> ParameterTraits:
        traits = self._traits(key)
        if self.volumetric and traits.geometric:
            return replace(traits, reason=f"{traits.reason}, in a scene with media", replayable=False)
        if self.volumetric and any(kind == DELTA_MASK for _, kind in traits.delta_lobes):
            # Emitter-sampling connections pass through masks, so their derivative would be needed there as well.
            return replace(traits, reason="it is the opacity of a mask in a scene with media", replayable=False)
        return traits

    def _traits(self, key: str) -> ParameterTraits:
        if key in self._current.poses:
            pose = self._current.poses.key(key)
            bare = is_bare(self.current, pose.target)
            return ParameterTraits(not pose.smooth, "it moves an object rigidly", light=bare, turns=pose.smooth)
        return parameter_traits(self.current_parameters, key, self.loaded().graph)

    def physical_range(self, key: str) -> Range:
        """Return the physical range of a parameter, from the slots that read it."""
        return self._current.readers.range_of(self.current_parameters, key)

    def info(self) -> Mapping[str, ParameterInfo]:
        """Return `ParameterInfo` of every parameter of the scene."""
        infos = {key: self._info(key) for key in self.current_parameters.keys()}  # noqa: SIM118 (iterating gives pairs)
        return {key: self._with_meaning(key, info) if info.perturbable else info for key, info in infos.items()}

    def _with_meaning(self, key: str, info: ParameterInfo) -> ParameterInfo:
        """Return `info` with the role, brightness, linearity and file conversion of the parameter."""
        known, limits, described = self.current_parameters, self.physical_range(key), self.description
        form, meaning = is_nonlinear(known, key, info.singular), role(known, key, info.shape)
        conversion = scene_loading.conversion(known, key, described)
        if meaning in ("normal", "direction") or info.welded or key.endswith(f".{mesh_layout.TEXCOORDS}"):
            conversion = replace(conversion, takes_number=False)
        info = replace(info, nonlinear=form, lobe=limits.lobe, scattering=limits.scattering, conversion=conversion)
        return replace(info, role=meaning, brightness=brightness(known, key))

    def _info(self, key: str) -> ParameterInfo:
        flags = self.current_parameters.flags(key)
        value = self.current_parameters[key]
        try:
            shape = native_shape(value)
        except TypeError:
            reason = transform_obstacle(self.current, self.current_parameters, key) if key.endswith("to_world") else ""
            reason = reason or f"its type {type(value).__name__} has no derivatives"
            return ParameterInfo((), False, False, reason, perturbable=False)
        if re.match(r"object_\d{9,}\.", key):
            reason = "its object has no id in the XML, so its name changes; give it one"
            return ParameterInfo(shape, False, False, reason, perturbable=False)
        if isinstance(value, (int, float)):
            reason = "it is a plain number, which Mitsuba compiles into its kernels"
            return ParameterInfo(shape, False, False, reason, perturbable=False, compiled=True)
        if reason := "it holds no values" if 0 in shape else self._obstacle(key):
            return ParameterInfo(shape, False, False, reason, perturbable=False)
        limits = self.physical_range(key)
        if flags & (mi.ParamFlags.NonDifferentiable | mi.ParamFlags.ReadOnly):
            reason = "Mitsuba marks it as not differentiable"
            if key.endswith(".data") and dr.is_tensor_v(value):
                reason += '; its texture is stored with 8 bits: load it with format="variant" or from a float file'
            able = dr.is_float_v(value) and not flags & mi.ParamFlags.ReadOnly
            return ParameterInfo(
                shape, False, False, reason, limits.low, limits.high, perturbable=able, singular=limits.singular
            )
        if not dr.is_float_v(value):
            return ParameterInfo(shape, False, False, "it holds integers", perturbable=False)
        traits = self.parameter_traits(key)
        return ParameterInfo(
            shape,
            traits.replayable,
            traits.replayable and traits.shares_paths,
            traits.reason,
            limits.low,
            limits.high,
            singular=limits.singular,
            resizable=traits.replayable and self._resizable(key, shape),
            mesh=partial(self._mesh, key) if is_of_vertices(self.current_parameters, key) else None,
            welded=key.endswith(f".{mesh_layout.POSITIONS}"),
        )

    def _obstacle(self, key: str) -> str:
        return update_obstacle(self.current_parameters, key) or self._current.colours.obstacle(key)

    def _mesh(self, key: str) -> tuple[np.ndarray, np.ndarray]:
        """Return positions and faces of the mesh at whose vertices a parameter has values, as loaded."""
        (owner, _, name), mesh = key.rpartition("."), self.current_parameters.properties[key][2]
        moved = name == mesh_layout.POSITIONS
        faces = mesh_layout.faces(mesh) if moved else self.current_parameters[f"{owner}.{mesh_layout.FACES}"]
        points = self._current.value(f"{owner}.{mesh_layout.POSITIONS}").numpy().reshape(-1, 3)
        return points if moved else mesh_layout.at_vertices(mesh, points), np.array(faces).reshape(-1, 3).astype(
            np.int64
        )

    def _resizable(self, key: str, shape: tuple[int, ...]) -> bool:
        """Return whether it is the data of a bitmap texture or a grid volume, which accept another resolution."""
        node = self.current_parameters.properties[key][2]
        axes = 4 if isinstance(node, mi.Volume) else 3 if isinstance(node, mi.Texture) else 0
        return key.endswith("data") and len(shape) == axes
