"""Mitsuba's answer to the renderer port."""

from __future__ import annotations

import copy
from collections.abc import Iterable, Mapping
from collections.abc import Set as AbstractSet
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from unrender.core.errors import InputError
from unrender.core.suggestions import did_you_mean
from unrender.core.trees import Tree
from unrender.rendering.mitsuba import poses
from unrender.rendering.mitsuba.boundary_term import moved_shape, obstacles
from unrender.rendering.mitsuba.camera_term import lens_parameters, moved_sensor, sensor_obstacle, translation_obstacle
from unrender.rendering.mitsuba.equal_objects import merge_notices
from unrender.rendering.mitsuba.light_paths import LightPaths
from unrender.rendering.mitsuba.loaded_scene import LoadedScene
from unrender.rendering.mitsuba.path_cache.session import CachingSession
from unrender.rendering.mitsuba.pixel_format import LuminanceSession, formats
from unrender.rendering.mitsuba.scene_graph import has_instances
from unrender.rendering.mitsuba.scene_loading import SceneDescription
from unrender.rendering.mitsuba.scene_pair import ScenePair
from unrender.rendering.mitsuba.session import MitsubaSession
from unrender.rendering.mitsuba.sphere_meshes import moving_targets
from unrender.rendering.mitsuba.tensors import tensor
from unrender.rendering.renderer import (
    Camera,
    LossWeights,
    ParameterInfo,
    PictureFormat,
    ReplacedMesh,
    Space,
    differentiated,
)


class MitsubaRenderer:
    """A Mitsuba scene, held twice (current and previous state), with path replay gradients.

    Args:
        description: an XML file, a Mitsuba dictionary, a function that returns one, or a loaded `mi.Scene`, of which there is one state
            only: no pairs.
        max_depth: longest path in segments, >= 1; None for that of the scene's integrator (`LightPaths`).
        keys: parameters that will be asked for, if known. Spheres that these move become meshes, so that path gradients reach them.
        replaced: {id of a shape: `ReplacedMesh`}, what its mesh is to be in place of the description's.

    Parameters are `mi.TensorXf` of the shape that `parameters()` tells: a number is (), a colour (3,), a bitmap (H, W, C),
    vertex positions (3 V,). Geometry moves through Mitsuba's `prb` kernel, whose gradient leaves out visibility; where meshes move, by
    their vertices or as a whole (`poses.py`), `boundary_term.py` adds it. Of sensors, `camera_term.py` has the whole derivative. Poses of
    shapes that are no meshes have no path gradient.

    Attributes:
        light_paths: settings of the light paths.
        max_depth: longest path in segments.
        notices: one line for each setting of the scene that is not used.

    Raises `InputError` where Mitsuba refuses the description.
    """

    def __init__(
        self,
        description: SceneDescription,
        max_depth: int | None = None,
        keys: Iterable[str] = (),
        replaced: Mapping[str, ReplacedMesh] | None = None,
    ):
        self._given_depth, keys = max_depth, tuple(keys)
        self.pair = ScenePair(description, moving_targets(keys), replaced)
        source, volumetric = self.pair.loaded().source, self.pair.volumetric
        self.light_paths = LightPaths.of(self.pair.current, source, volumetric, max_depth)
        self.max_depth = self.light_paths.max_depth
        self.notices = (
            *self.light_paths.notices,
            *merge_notices(keys, self.pair.loaded().equal),
            *(f"{name}: a sphere that moves is rendered as a mesh" for name in self.pair.loaded().meshed),
        )
        self._formats = formats(self.pair.current.sensors())
        self._poses = self._pose_keys()
        self._info: dict[str, ParameterInfo] = {**self.pair.info(), **lens_parameters(self.pair)}
        sensors = {sensor.id(): index for index, sensor in enumerate(self.pair.current.sensors())}
        found = self._obstacles({pose.target for pose in self._poses.values()})
        self._info |= {
            key: poses.info(pose, found[pose.target] or self._translates(pose), sensors.get(pose.target))
            for key, pose in self._poses.items()
        }
        self._sampler: mi.Sampler = mi.load_dict({"type": "independent"})
        self._sessions: dict[
            tuple[tuple[str, ...], frozenset[str]], MitsubaSession | CachingSession | LuminanceSession
        ] = {}
        self._stock: StockSession | None = None
        self._differential_bsdf, self._differential = False, None
        self._checked: set[tuple[tuple[str, ...], frozenset[str], Space | None]] = set()

    def parameters(self) -> Mapping[str, ParameterInfo]:
        """Every parameter of the scene by its `mitsuba.traverse` key."""
        return self._info

    def values(self, keys: list[str]) -> Tree:
        """The scene's own values, as loaded."""
        return {
            key: self.array(self._poses[key].loaded()) if key in self._poses else self.pair.loaded().value(key)
            for key in keys
        }

    def resolutions(self) -> list[tuple[int, int]]:
        """(height, width) of each sensor's film, after cropping."""
        return self.pair.resolutions

    def formats(self) -> list[PictureFormat]:
        return self._formats

    def cameras(self) -> Mapping[int, Camera]:
        found = {}
        for index, sensor in enumerate(self.pair.current.sensors()):
            keys = f"{sensor.id()}.rotation", f"{sensor.id()}.translation"
            if keys[0] in self._poses:
                place = np.array(sensor.world_transform().matrix, np.float64).reshape(4, 4, -1)[:3, 3, 0]
                found[index] = Camera(*keys, place)
        return found

    def array(self, values: np.ndarray) -> mi.TensorXf:
        """`mi.TensorXf` with these values, in memory of its own."""
        return tensor(values)

    def prepare(
        self, keys: list[str], space: Space | None, derivatives: bool | AbstractSet[str] = True
    ) -> MitsubaSession | CachingSession | LuminanceSession:
        """The session for these parameters: see `Renderer.prepare`. Sessions are kept, so that asking again costs nothing.

        Poses and other parameters that move geometry cannot be prepared together: the scenes that posed shapes live in are not rebuilt.
        """
        names, wanted = tuple(keys), differentiated(keys, derivatives)
        if (names, wanted, space) not in self._checked:
            for key in keys:
                self._check(key, space, key in wanted)
            self._check_targets(keys)
            if space is not None:
                self.pair.check_separate([key for key in keys if key not in self._poses])
            self._checked.add((names, wanted, space))
        if (names, wanted) not in self._sessions:
            chosen = {key: self._poses[key] for key in keys if key in self._poses and not self._is_written(key, keys)}
            rest = [key for key in keys if key not in chosen]
            session = MitsubaSession(
                self.pair, rest, chosen, wanted, self.light_paths, self._sampler, self._differential_bsdf
            )
            session = self._caching(session, keys, wanted)
            grey = self._formats[0].colour == "luminance"
            self._sessions[names, wanted] = LuminanceSession(session) if grey else session
        return self._sessions[names, wanted]

    def _caching(
        self, session: MitsubaSession, keys: list[str], derivatives: AbstractSet[str]
    ) -> MitsubaSession | CachingSession:
        """The session that keeps its paths where it can."""
        if self._differential_bsdf:
            return session
        try:
            return CachingSession(self.pair, session, keys, sorted(derivatives), self.light_paths)
        except InputError:
            return session

    def with_meshes(self, meshes: Mapping[str, ReplacedMesh], keys: Iterable[str]) -> MitsubaRenderer:
        """See `Remeshable`."""
        return MitsubaRenderer(self.pair.description, self._given_depth, keys, self.pair.replaced | dict(meshes))

    def with_differential_bsdf(self) -> MitsubaRenderer:
        """See `DifferentialBsdfRenderer`. Of the same scenes."""
        if self._differential_bsdf:
            return self
        if self._differential is None:
            self._differential = copy.copy(self)
            self._differential._differential_bsdf, self._differential._sessions = True, {}
        return self._differential

    def stock(self) -> StockSession:
        if self.pair.replaced:
            raise InputError("method stock: a mesh has other triangles than the scene's own")
        if any(form.colour == "xyz" for form in self._formats):
            raise InputError(
                "method stock: a film has the pixel_format xyz, which it would compare with RGB: give it rgb"
            )
        if self._stock is None:
            self._stock = StockSession(self.pair.description, self.pair.moving, self.pair.volumetric, self.light_paths)
        return self._stock

    def _pose_keys(self) -> dict[str, poses.PoseKey]:
        """Return the poses that the scene has: of lights alone beside media, which posed shapes in scenes of their own do not meet."""
        written, instances = self.pair.loaded().poses, has_instances(self.pair.current)
        return {
            key: pose
            for key, pose in poses.keys(self.pair.current).items()
            if (pose.light or not self.pair.volumetric) and (key in written or not (pose.light or instances))
        }

    def _is_written(self, key: str, keys: Iterable[str]) -> bool:
        """Return whether a pose is written into the scene: a light's always, and others beside a shape that emits light, with which the
        scene's acceleration structure changes, and beside instances, which Mitsuba does not take into another scene."""
        scene = self.pair.loaded()
        if self._poses[key].light or has_instances(scene.scene):
            return True
        lit = any(other in self._poses and self._poses[other].light and moved_shape(scene, other) for other in keys)
        return lit and key in scene.poses

    def _check_targets(self, keys: list[str]) -> None:
        """Raise `InputError` where two parameters place the same object."""
        poses.slots({key: self._poses[key] for key in keys if key in self._poses})
        written = self.pair.loaded().poses
        for key in keys:
            if key in written and (other := next((name for name in written.written(key) if name in keys), "")):
                raise InputError(f"parameter {key}: {other} places the same object; keep one of them")

    def _translates(self, pose: poses.PoseKey) -> str:
        """Why a pose has no derivative because it moves a sensor to another place, "" where that is not so."""
        moves = pose.part == "translation" and any(sensor.id() == pose.target for sensor in self.pair.current.sensors())
        return translation_obstacle(self.pair) if moves else ""

    def _obstacles(self, targets: set[str]) -> dict[str, str]:
        """{shape or sensor that moves: why it has no path gradient, "" where it has}."""
        sensors = {sensor.id() for sensor in self.pair.current.sensors() if sensor.get_shape() is None}
        lamps = {emitter.id() for emitter in self.pair.current.emitters() if emitter.get_shape() is None}
        found = obstacles(self.pair, targets - sensors - lamps)
        found |= {target: sensor_obstacle(self.pair, target) for target in targets & sensors}
        return found | dict.fromkeys(targets & lamps, "path gradients do not follow it")

    def _carries(self, key: str) -> bool:
        """Whether paths of two values of a parameter, which moves a mesh, can be related: see `MovedPair`."""
        scene = self.pair.loaded()
        kinds = {shape.class_name() for shape in scene.scene.shapes()}
        if key in self._poses and self._poses[key].light:
            return False
        return bool(moved_shape(scene, key)) and not moved_sensor(scene, key) and not kinds & {"Instance", "ShapeGroup"}

    def _check(self, key: str, space: Space | None, derivatives: bool) -> None:
        if key not in self._info:
            raise InputError(f"parameter {key}: the scene has none of that name{did_you_mean(key, self._info)}")
        info = self._info[key]
        if derivatives and not info.differentiable and key in self._poses:
            raise InputError(
                f"parameter {key}: it cannot be recovered by path gradients, since {info.reason}: --method smoothed"
            )
        if derivatives and not info.differentiable:
            raise InputError(f"parameter {key}: it cannot be recovered by path gradients, since {info.reason}")
        target = moved_sensor(self.pair.loaded(), key) or moved_shape(self.pair.loaded(), key)
        if self.light_paths.hide_emitters and (target or key in self._poses):
            raise InputError(f"parameter {key}: the scene's hide_emitters does not go with what moves: leave it out")
        if derivatives and target and key not in self._poses and (why := self._obstacles({target})[target]):
            raise InputError(f"parameter {key}: it cannot be recovered by path gradients, since {why}")
        if not info.perturbable:
            raise InputError(f"parameter {key}: it cannot be perturbed, since {info.reason}")
        if space == "path" and not (info.shares_paths or (derivatives and self._carries(key))):
            instead = ", --method plain or --method smoothed" if info.rigid else ""
            raise InputError(
                f'parameter {key}: {info.reason}, which space="path" cannot carry; use space="primary"{instead}'
            )


class StockSession:
    """A load of the scene for `mi.render` alone: its own film, with the reconstruction filter that the scene gives it.

    Args:
        description: what to load.
        moving: ids of shapes that move; the spheres among them become meshes.
        volumetric: whether there is a participating medium, which takes `prbvolpath` in place of `prb`.
        paths: settings of the light paths.
    """

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
        scene.detach()  # of leaves that were differentiated before, the derivative graph is gone
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
        if channels in (2, 4):  # a film with alpha, which references have not
            image = image[:, :, : channels - 1]
        if channels <= 2:  # of luminance, in all three channels
            image = image * dr.ones(mi.TensorXf, (1, 1, 3))
        seen = mi.TensorXf(dr.detach(image))
        dr.backward(dr.sum(image * weigh(seen), axis=None))
        gradient = scene.take_gradients()
        dr.eval(seen)
        return seen, gradient
