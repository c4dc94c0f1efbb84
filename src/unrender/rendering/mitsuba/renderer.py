"""Implementation of the renderer protocol with Mitsuba."""

from __future__ import annotations

import copy
from collections.abc import Iterable, Mapping, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from unrender.backend import variant
from unrender.core.errors import InputError
from unrender.core.text import did_you_mean
from unrender.core.trees import Tree
from unrender.rendering.mitsuba import poses, turned_lights
from unrender.rendering.mitsuba.camera_media import copied_media_notices, unbounded_notices
from unrender.rendering.mitsuba.edges import moving_targets
from unrender.rendering.mitsuba.film_response import is_spectral
from unrender.rendering.mitsuba.geometry_notices import contact_notices, jump_notices, shadow_notices, specular_notices
from unrender.rendering.mitsuba.geometry_terms import (
    lens_parameters,
    moved_sensor,
    moved_shape,
    obstacles,
    sensor_obstacle,
    translation_obstacle,
)
from unrender.rendering.mitsuba.light_paths import LightPaths, mask_notices, null_notices
from unrender.rendering.mitsuba.loaded_scene import LoadedScene
from unrender.rendering.mitsuba.parameters import shows, tensor
from unrender.rendering.mitsuba.path_cache.session import CachingSession
from unrender.rendering.mitsuba.pixel_format import LuminanceSession, formats
from unrender.rendering.mitsuba.rigid_motions import lengths
from unrender.rendering.mitsuba.scene_graph import has_instances
from unrender.rendering.mitsuba.scene_loading import SceneDescription, merge_notices
from unrender.rendering.mitsuba.scene_pair import ScenePair
from unrender.rendering.mitsuba.session import MitsubaSession
from unrender.rendering.picture_format import PictureFormat
from unrender.rendering.renderer import (
    Camera,
    Derivatives,
    LossWeights,
    ParameterInfo,
    ReplacedMesh,
    Space,
    differentiated,
)
from unrender.rendering.turns import Turns


class MitsubaRenderer:
    """A Mitsuba scene, loaded twice (current and previous state), with path replay gradients.

    Args:
        description: an XML file, a Mitsuba dictionary, a function that returns one, or a loaded `mi.Scene`. The latter has one state only
            and cannot render pairs.
        max_depth: maximum path length in segments, >= 1; None for that of the scene's integrator (`LightPaths`).
        keys: parameters that will be recovered, if known. Spheres that these move become meshes, so that they have path gradients.
        replaced: {id of a shape: `ReplacedMesh`}, meshes that replace those of the description.
        turns: rotations of distant lights for each sensor; None for the lights as described.

    Parameters are `mi.TensorXf` of the shape that `parameters()` states: a number is (), a colour (3,), a bitmap (H, W, C), vertex
    positions (3 V,). Moving geometry uses Mitsuba's `prb` kernel, whose gradient omits visibility. For meshes that move, by their
    vertices or rigidly (`poses.py`), `geometry_terms.py` adds it, and has the full derivative by sensors. Poses of shapes
    other than meshes have no path gradient.

    Attributes:
        joins_views: whether requests may have the seeds of several views.
        max_depth: maximum path length in segments.
        requested_depth: the argument `max_depth`.
        turns, turnable: see `TurnsLights`.
        notices: one line for each setting of the scene that is not used.

    Raises `InputError` if Mitsuba refuses the description.
    """

    joins_views = True

    def __init__(
        self,
        description: SceneDescription,
        max_depth: int | None = None,
        keys: Iterable[str] = (),
        replaced: Mapping[str, ReplacedMesh] | None = None,
        turns: Turns | None = None,
    ):
        self.requested_depth, self._keys = max_depth, (keys := tuple(keys))
        self.pair = ScenePair(description, moving_targets(keys), replaced, turns)
        self.light_paths = LightPaths.of(self.pair.current, self.pair.volumetric, max_depth)
        self.max_depth = self.light_paths.max_depth
        scene, graph = self.pair.current, self.pair.loaded().graph
        self._surface_notices = (
            *graph.missing_attributes(),
            *contact_notices(scene, keys),
            *jump_notices(scene, graph, keys),
            *(f"{name}: the moving sphere is rendered as a mesh" for name in self.pair.loaded().meshed),
        )
        self.notices = (
            *self.light_paths.notices,
            *mask_notices(scene, graph.of("bsdf"), keys),
            *null_notices(scene, graph.of("bsdf"), self.pair.volumetric, self.max_depth),
            *unbounded_notices(scene),
            *copied_media_notices(scene, graph, keys),
            *specular_notices(scene, keys),
            *shadow_notices(scene, keys),
            *self._surface_notices,
        )
        self._formats = formats(self.pair.current.sensors())
        self._poses = self._pose_keys()
        self._info: dict[str, ParameterInfo] = {**self.pair.info(), **lens_parameters(self.pair)}
        sensors = {sensor.id(): index for index, sensor in enumerate(self.pair.current.sensors())}
        obstacles_of = self._obstacles({pose.target for pose in self._poses.values()})
        lengths_by_id = lengths(self.pair.current)
        self._info |= {
            key: poses.info(
                pose,
                ("" if pose.smooth and not self.pair.volumetric else obstacles_of[pose.target])
                or self._translates(pose),
                sensors.get(pose.target),
                lengths_by_id.get(pose.target, 1.0),
            )
            for key, pose in self._poses.items()
        }
        self.turns, self.turnable = turns, () if self.pair.single else turned_lights.turnable(self.pair.current)
        names = [] if turns is None else [name for name, _ in turns.rotations]
        self._turned = {f"{name}.rotation": poses.PoseKey(name, "rotation", None, light=True) for name in names}
        self._info |= {key: poses.info(pose, "views know it", None) for key, pose in self._turned.items()}
        self._sampler: mi.Sampler = mi.load_dict({"type": "independent"})
        self._sessions: dict[
            tuple[tuple[str, ...], frozenset[str]], MitsubaSession | CachingSession | LuminanceSession
        ] = {}
        self._stock: StockSession | None = None
        self._differential_bsdf, self._differential = False, None
        self._aovs: dict[str, MitsubaRenderer] = {}
        self._checked: set[tuple[tuple[str, ...], frozenset[str], Space | None]] = set()

    def parameters(self) -> Mapping[str, ParameterInfo]:
        """Return every parameter of the scene by key: the keys of `mitsuba.traverse`, and those of poses (`poses.py`)."""
        return self._info

    def values(self, keys: list[str]) -> Tree:
        known = self._poses | self._turned
        return {key: self.array(known[key].loaded()) if key in known else self.pair.loaded().value(key) for key in keys}

    def resolutions(self) -> list[tuple[int, int]]:
        """Return (height, width) of each sensor's film, after cropping."""
        return self.pair.resolutions

    def formats(self) -> list[PictureFormat]:
        return self._formats

    def cameras(self) -> Mapping[int, Camera]:
        result = {}
        for index, sensor in enumerate(self.pair.current.sensors()):
            keys = f"{sensor.id()}.rotation", f"{sensor.id()}.translation"
            if keys[0] in self._poses:
                place = np.array(sensor.world_transform().matrix, np.float64).reshape(4, 4, -1)[:3, 3, 0]
                result[index] = Camera(*keys, place)
        return result

    def array(self, values: np.ndarray) -> mi.TensorXf:
        """Return the values as `mi.TensorXf` in its own memory."""
        self._check_variant()
        return tensor(values)

    def _check_variant(self) -> None:
        if (own := self.pair.loaded().variant) != mi.variant():
            raise InputError(f"scene: it was loaded under {own}, and {mi.variant()} is set; call unrender.use({own!r})")

    def prepare(
        self, keys: list[str], space: Space | None, derivatives: Derivatives = True
    ) -> MitsubaSession | CachingSession | LuminanceSession:
        """Return the session for these parameters. Sessions are cached, so repeated calls are free.

        Poses and other parameters that move geometry cannot be prepared together, since the scenes of posed shapes are not rebuilt.
        """
        self._check_variant()
        names, differentiable = tuple(keys), differentiated(keys, derivatives)
        if (names, differentiable, space) not in self._checked:
            for key in keys:
                self._check(key, space, key in differentiable)
            self._check_targets(keys)
            if space is not None:
                self.pair.check_separate([key for key in keys if key not in self._poses])
            self._checked.add((names, differentiable, space))
        if (names, differentiable) not in self._sessions:
            chosen = {key: self._poses[key] for key in keys if key in self._poses and not self._is_written(key, keys)}
            rest = [key for key in keys if key not in chosen]
            session = MitsubaSession(
                self.pair, rest, chosen, differentiable, self.light_paths, self._sampler, self._differential_bsdf
            )
            session = self._caching(session, keys, differentiable)
            is_luminance = self._formats[0].colour == "luminance"
            self._sessions[names, differentiable] = LuminanceSession(session) if is_luminance else session
        return self._sessions[names, differentiable]

    def _caching(
        self, session: MitsubaSession, keys: list[str], derivatives: AbstractSet[str]
    ) -> MitsubaSession | CachingSession:
        """Return a session that caches its paths if the parameters allow it, else the session itself."""
        if self._differential_bsdf or self.light_paths.aov or is_spectral():
            return session
        try:
            return CachingSession(self.pair, session, keys, sorted(derivatives), self.light_paths)
        except InputError:
            return session

    def with_meshes(self, meshes: Mapping[str, ReplacedMesh], keys: Iterable[str]) -> MitsubaRenderer:
        replaced = self.pair.replaced | dict(meshes)
        return MitsubaRenderer(self.pair.description, self.requested_depth, keys, replaced, self.pair.turns)

    def with_turns(self, turns: Turns | None, keys: Iterable[str]) -> MitsubaRenderer:
        """Return a renderer of the scene with other rotations of distant lights for each sensor; None for the lights as described."""
        if turns == self.turns:
            return self
        return MitsubaRenderer(self.pair.description, self.requested_depth, keys, self.pair.replaced, turns)

    def with_differential_bsdf(self) -> MitsubaRenderer:
        """Return a renderer of the same loaded scenes with differential BSDF sampling; this renderer if it renders an AOV."""
        if self._differential_bsdf or self.light_paths.aov:
            return self
        if self._differential is None:
            self._differential = copy.copy(self)
            self._differential._differential_bsdf, self._differential._sessions = True, {}
        return self._differential

    def merge_notices(self, tied: Sequence[AbstractSet[str]]) -> list[str]:
        """Return a line for each unknown whose object Mitsuba merges with equal ones; `tied` are parameters that have one value."""
        return merge_notices(self._keys, self.pair.loaded().equal, tied)

    def with_aov(self, name: str) -> MitsubaRenderer:
        """Return a renderer of the same scenes with an AOV in place of radiance. Raises `InputError` with media and in spectral
        variants."""
        if self.pair.volumetric:
            raise InputError(f"{name} is a property of surfaces, and the scene has media; leave it out")
        if is_spectral():
            raise InputError(f"{name}: spectral variants render radiance only; leave it out, or use an RGB variant")
        if name not in self._aovs:
            renderer = self._aovs[name] = copy.copy(self)
            renderer.notices = self._surface_notices  # an AOV has no light paths
            renderer.light_paths = LightPaths(1, hide_emitters=self.light_paths.hide_emitters, aov=name)
            renderer._formats, renderer._sessions = [PictureFormat(signed=True, aov=name)] * len(self._formats), {}
            renderer._checked, renderer._differential = set(), None
            reason = f"path gradients of moving sensors do not support {name}"
            moving = {key: info for key, info in self._info.items() if info.viewpoint}
            renderer._info = self._info | {
                key: replace(x, differentiable=False, reason=reason) for key, x in moving.items()
            }
            unseen = [key for key, x in renderer._info.items() if x.perturbable and not self._shows(name, key)]
            renderer._info |= {key: replace(renderer._info[key], shown=False) for key in unseen}
        return self._aovs[name]

    def _shows(self, aov: str, key: str) -> bool:
        """Return whether an AOV can depend on a parameter."""
        if key in self._poses:  # emitters without a shape are not seen
            shapeless = {emitter.id() for emitter in self.pair.current.emitters() if emitter.get_shape() is None}
            return self._poses[key].target not in shapeless
        return key in self._turned or shows(aov, self.pair.current_parameters, key, self.pair.loaded().graph)

    def stock(self) -> StockSession:
        if self.pair.replaced:
            raise InputError("method stock: remeshing is not supported; use another method")
        if any(form.colour == "xyz" for form in self._formats):
            raise InputError("method stock: the pixel_format xyz is not supported; set the film to rgb")
        if self._stock is None:
            self._stock = StockSession(self.pair.description, self.pair.moving, self.pair.volumetric, self.light_paths)
        return self._stock

    def _pose_keys(self) -> dict[str, poses.PoseKey]:
        """Return the poses of the scene. With media only lights have poses, since a posed shape in a scene of its own does not see the
        media."""
        written, instances = self.pair.loaded().poses, has_instances(self.pair.current)
        return {
            key: pose
            for key, pose in poses.keys(self.pair.current).items()
            if (pose.light or not self.pair.volumetric)
            and (key in written or not (pose.light or instances or variant.is_gpu()))
        }

    def _is_written(self, key: str, keys: Iterable[str]) -> bool:
        """Return whether a pose is written into the scene instead of transforming rays.

        This holds for lights. It holds for other poses if an emitting shape moves too, since that changes the scene's acceleration
        structure. It also holds in scenes with instances, which Mitsuba cannot add to another scene, and on a GPU, which traces one scene.
        """
        scene = self.pair.loaded()
        if self._poses[key].light or has_instances(scene.scene) or variant.is_gpu():
            return True
        lit = any(other in self._poses and self._poses[other].light and moved_shape(scene, other) for other in keys)
        return lit and key in scene.poses

    def _check_targets(self, keys: list[str]) -> None:
        poses.slots({key: self._poses[key] for key in keys if key in self._poses})
        written = self.pair.loaded().poses
        for key in keys:
            if key in written and (other := next((name for name in written.written(key) if name in keys), "")):
                raise InputError(f"parameter {key}: {other} places the same object; leave out one of them")

    def _translates(self, pose: poses.PoseKey) -> str:
        """Return the reason why the translation of a sensor has no derivative; "" for other poses or if it has one."""
        moves = pose.part == "translation" and any(sensor.id() == pose.target for sensor in self.pair.current.sensors())
        return translation_obstacle(self.pair) if moves else ""

    def _obstacles(self, targets: set[str]) -> dict[str, str]:
        """Return {shape or sensor that moves: reason why it has no path gradient, "" if it has one}."""
        sensors = {sensor.id() for sensor in self.pair.current.sensors() if sensor.get_shape() is None}
        lights = {emitter.id() for emitter in self.pair.current.emitters() if emitter.get_shape() is None}
        result = obstacles(self.pair, targets - sensors - lights, self.light_paths.aov)
        result |= {target: sensor_obstacle(self.pair, target) for target in targets & sensors}
        return result | dict.fromkeys(targets & lights, "path gradients do not support it")

    def _relates_paths(self, key: str) -> bool:
        """Return whether paths of two values of a parameter that moves a mesh can be related, see `MovedPair`."""
        scene = self.pair.loaded()
        shapes, moved = scene.scene.shapes(), moved_shape(scene, key)
        if not moved or moved_sensor(scene, key) or any(shape.id() == moved and shape.is_emitter() for shape in shapes):
            return False
        return not {shape.class_name() for shape in shapes} & {"Instance", "ShapeGroup"}

    def _check(self, key: str, space: Space | None, derivatives: bool) -> None:
        if key not in self._info:
            raise InputError(f"parameter {key}: the scene has none of that name{did_you_mean(key, self._info)}")
        info = self._info[key]
        if derivatives and not info.differentiable:
            raise InputError(f"parameter {key}: it cannot be recovered by path gradients, since {info.reason}")
        target = moved_sensor(self.pair.loaded(), key) or moved_shape(self.pair.loaded(), key)
        if self.light_paths.hide_emitters and (target or key in self._poses):
            raise InputError(
                f"parameter {key}: hide_emitters is not supported with moving objects; leave it out of the scene"
            )
        if derivatives and target and key not in self._poses and (obstacle := self._obstacles({target})[target]):
            raise InputError(f"parameter {key}: it cannot be recovered by path gradients, since {obstacle}")
        if not info.perturbable:
            raise InputError(f"parameter {key}: it cannot be perturbed, since {info.reason}")
        if space == "path" and not (info.shares_paths or (derivatives and self._relates_paths(key))):
            instead = ", --method plain or --method smoothed" if info.rigid else ""
            raise InputError(
                f'parameter {key}: {info.reason}, so space="path" cannot share its paths; use space="primary"{instead}'
            )


class StockSession:
    """A load of the scene for `mi.render` alone, with the scene's own film and reconstruction filter, by `prbvolpath` if `volumetric`, else
    `prb`. Moving spheres become meshes."""

    def __init__(self, description: SceneDescription, moving: AbstractSet[str], volumetric: bool, paths: LightPaths):
        self._loaded = LoadedScene(description, moving)
        kind = "prbvolpath" if volumetric else "prb"
        self._integrator: Any = mi.load_dict(
            {
                "type": kind,
                "max_depth": paths.max_depth,
                "rr_depth": paths.rr_depth,
                "hide_emitters": paths.hide_emitters,
            }
        )

    def gradient(
        self, parameters: Tree, sensor: int, spp: int, seeds: tuple[int, int], weigh: LossWeights
    ) -> tuple[mi.TensorXf, Tree]:
        scene = self._loaded
        scene.detach()  # the derivative graph of leaves from an earlier step no longer exists
        scene.set_parameters(parameters, parameters.keys())
        image = mi.render(
            scene.scene,
            scene.parameters,
            sensor=sensor,
            integrator=self._integrator,
            spp=spp,
            seed=mi.UInt32(seeds[0]),
            seed_grad=mi.UInt32(seeds[1]),  # pyright: ignore[reportArgumentType]
        )
        channels = image.shape[2]
        if channels in (2, 4):  # drop alpha, which references do not have
            image = image[:, :, : channels - 1]
        if channels <= 2:  # repeat luminance in all three channels
            image = image * dr.ones(mi.TensorXf, (1, 1, 3))
        detached = mi.TensorXf(dr.detach(image))
        dr.backward(dr.sum(image * weigh(detached), axis=None))
        gradient = scene.take_gradients()
        dr.eval(detached)
        return detached, gradient
