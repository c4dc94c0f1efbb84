"""Images and gradients of a Mitsuba scene for a fixed set of parameters, by recorded kernels."""

from __future__ import annotations

from collections.abc import Callable
from collections.abc import Set as AbstractSet
from dataclasses import replace
from functools import cached_property, partial
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from unrender.backend import variant
from unrender.core.errors import InputError
from unrender.core.trees import Tree
from unrender.rendering.mitsuba.camera_paths import DroppedSamples, Kernel, Paths
from unrender.rendering.mitsuba.frozen import FrozenFunction, are_recordable, for_every_sensor, shapes_are_recordable
from unrender.rendering.mitsuba.geometry_terms import (
    BoundaryTerm,
    CameraTerm,
    moved_sensor,
    moved_shape,
    moving_geometry,
    no_tangents,
)
from unrender.rendering.mitsuba.integrators.aov import AovKernel
from unrender.rendering.mitsuba.integrators.differential_bsdf import RoughLobes
from unrender.rendering.mitsuba.integrators.emitters import connection_moments, own_probabilities
from unrender.rendering.mitsuba.integrators.moved_pair import MovedPair
from unrender.rendering.mitsuba.integrators.path import PathPair, PrbKernel
from unrender.rendering.mitsuba.integrators.volpath import VolumePair
from unrender.rendering.mitsuba.light_paths import LightPaths
from unrender.rendering.mitsuba.loaded_scene import detach_all, loaded_scenes, share_addresses
from unrender.rendering.mitsuba.parameters import LatestTensors, is_broadcast, tensor
from unrender.rendering.mitsuba.passes import (
    AdjointPairPass,
    AdjointPass,
    ConnectionsPass,
    ImagePairPass,
    ImagePass,
    LaunchSize,
    MovedPairPass,
    Pass,
    PosesPass,
    TangentPass,
    VerticesPass,
)
from unrender.rendering.mitsuba.poses import PosedScene, PoseKey
from unrender.rendering.mitsuba.scene_graph import has_instances
from unrender.rendering.mitsuba.scene_pair import ScenePair
from unrender.rendering.renderer import EmitterMoments, Rendering, SampleRequest, Space

_LANES = 1 << 22  # maximum number of paths per launch of a batch, which fits a small machine's memory


class MitsubaSession:
    """Kernels for one set of parameters. Equal arguments give equal results, independent of other sessions.

    Each call sets both scenes to its own parameters, and all others to the scene's own values.

    Args:
        pair: both loads of the scene, which sessions share.
        keys: parameters, including poses that are written into the scene.
        poses: {key: its meaning} of the poses that transform rays.
        derivatives: parameters that are leaves of the derivative graph in every pass. Others change without a derivative.
        paths, sampler: settings of the light paths; sampler that is cloned.
        differential_bsdf: whether adjoints and tangents of one state use differential BSDF sampling of roughness, see `RoughLobes`.

    Attributes:
        dropped: samples that were not finite.

    Raises `InputError` for poses together with other parameters that move geometry, or poses with and without a derivative; and if
    `differential_bsdf` supports no parameter.
    """

    def __init__(
        self,
        pair: ScenePair,
        keys: list[str],
        poses: dict[str, PoseKey],
        derivatives: AbstractSet[str],
        paths: LightPaths,
        sampler: mi.Sampler,
        differential_bsdf: bool = False,
    ):
        traits = {key: pair.parameter_traits(key) for key in keys}
        scene = pair.loaded()
        cameras = [key for key in (*keys, *poses) if moved_sensor(scene, key)]
        moving = moving_geometry(scene, traits, derivatives)
        if poses and moving is not None:
            raise InputError(
                f"parameter {moving}: it moves geometry, which cannot be combined with the pose {next(iter(poses))}"
            )
        self._boundary, self._camera, self._apart, self._geometric, self._replays = None, None, None, False, True
        moved = {key: moved_shape(scene, key) for key in (*keys, *poses) if key not in cameras}
        moved |= {key: "" for key in keys if key in scene.poses and key not in derivatives}
        self._moving, self._still_sensors = frozenset(moved.values()) - {""}, not cameras
        lit = any(shape.is_emitter() and shape.id() in self._moving for shape in pair.current.shapes())
        self._related = bool(self._moving) and not (lit or variant.is_gpu() or has_instances(pair.current))
        self._only_meshes = not any(key in poses or traits[key].geometric for key, shape in moved.items() if not shape)
        fixed = {key: pose for key, pose in poses.items() if key not in derivatives}
        if derivatives:
            everything = [key for key in (*keys, *poses) if key in derivatives]
            cameras = [key for key in cameras if key in derivatives]
            if fixed and (other := next((key for key in everything if key in poses or key in cameras), None)):
                raise InputError(
                    f"parameter {other}: path gradients move it in the scene itself, which cannot be combined with the pose "
                    f"{next(iter(fixed))} without a derivative; use perturbed renders for both"
                )
            shapes = {moved[key] for key in everything if key not in cameras} - {""}
            self._boundary = BoundaryTerm(pair, shapes, paths) if shapes else None
            self._camera = CameraTerm(pair, cameras, paths.max_depth, not shapes) if cameras else None
            self._geometric = any(key in poses or traits[key].geometric for key in everything if key not in cameras)
            self._replays = len(cameras) < len(everything)
            keys = [*keys, *(key for key in poses if key in derivatives)]
            own = [key for key, of in traits.items() if key in derivatives and (of.changes_delta or of.turns)]
            if self._geometric and own and not paths.aov:  # derivatives that `prb` lacks
                self._apart = MitsubaSession(pair, keys, {}, frozenset(own), paths, sampler)
        self._pair, self._keys, self._poses, self._attached = pair, keys, fixed, frozenset(derivatives)
        self._attributed = scene.graph.attributed({pose.target for pose in fixed.values()})
        self._posed, self._posed_previous = None, None
        if fixed:
            scene.set_parameters({})  # restore shapes that an earlier session has moved
            self._posed = PosedScene(pair.current, fixed, self._attributed)
            share_addresses(self._posed.scenes())
        self._at, self._state_tensors = dict[bool, mi.Float](), LatestTensors()
        self._light, self._sampler = paths, sampler
        self._traits = [trait for key, trait in traits.items() if key in derivatives]
        # A recording does not capture the parameters of a phase function, and its replay gives no gradient by them.
        self._recordable = not any(trait.phase for trait in traits.values()) and shapes_are_recordable(pair.current)
        self._delta_table = pair.delta_table(self._traits)
        served = [key for key in keys if key in derivatives] if differential_bsdf and derivatives else None
        self._rough = RoughLobes(pair, served, self._geometric)
        self._functions: dict[tuple[Any, ...], FrozenFunction] = {}
        self.dropped = DroppedSamples(at_once=not derivatives)

    @cached_property
    def _path_kernel(self) -> Kernel:
        if self._light.aov:
            return AovKernel(self._light.aov)
        delta = any(traits.changes_delta for traits in self._traits)
        if not self._pair.volumetric:
            turning = any(traits.turns for traits in self._traits)
            depths, differential = (self._light.max_depth, self._light.rr_depth), self._rough.differential
            return PathPair(*depths, changing_delta=delta, differential=differential, turning_emitters=turning)
        media = any(traits.medium for traits in self._traits)
        emission, field = self._pair.emissive, self._pair.radiance_field
        return VolumePair(
            self._light.max_depth,
            self._light.rr_depth,
            changing_delta=delta,
            differentiate_media=media,
            emission=emission,
            radiance_field=emission and field,
        )

    @cached_property
    def _geometry_kernel(self) -> Kernel:
        return self._path_kernel if self._light.aov else PrbKernel(self._light.max_depth, self._light.rr_depth)

    @cached_property
    def _moved_kernel(self) -> MovedPair:
        return MovedPair(self._light.max_depth, self._light.rr_depth, shared=self._only_meshes)

    @cached_property
    def _unrelated_kernel(self) -> MovedPair:
        return MovedPair(self._light.max_depth, self._light.rr_depth, share=0.0, shared=self._only_meshes)

    # ------------------------------------------------------------------ rendering

    def image(self, parameters: Tree, request: SampleRequest) -> Rendering:
        batched = parameters and self._posed is not None and not self._attached
        if batched and request.groups == 1 and request.pixels is None:
            stacked = {key: np.array(value.numpy())[None] for key, value in parameters.items()}
            return Rendering(self.image_batch(stacked, request), None, None)
        self.set_parameters(parameters)
        radiance = self.kernel(ImagePass(), request)()
        dr.eval(radiance)
        return Rendering(self.develop(radiance, request), None, Paths(request, radiance))

    def image_batch(self, parameters: Tree, request: SampleRequest) -> mi.TensorXf:
        """Render many states with the same random numbers, see `RenderSession.image_batch`.

        States that differ in poses only share launches of as many states as the memory allows. Otherwise each state is one replay.
        """
        count = len(next(iter(parameters.values())))
        shape = (*self._pair.resolutions[request.sensor], 3)
        shared = all(is_broadcast(parameters[key]) for key in self._keys if key in parameters)
        together = self._posed is not None and shared
        size = max(1, _LANES // (self.count(request) * request.spp)) if together else 1
        images = []
        for start in range(0, count, size):
            part = {key: value[start : start + size] for key, value in parameters.items()}
            images.append(self._batch(part, request))
        flat = images[0] if len(images) == 1 else dr.concat(images)
        return mi.TensorXf(flat, (count, *shape))

    def _batch(self, parameters: Tree, request: SampleRequest) -> mi.Float:
        """Return the concatenated pixels of states that share everything except their poses."""
        count = len(next(iter(parameters.values())))
        at = {key: self._state_tensors.of(key, values[0]) for key, values in parameters.items()}
        if self._posed is None or self._attached:
            self.set_parameters(at)
            radiance = self.kernel(ImagePass(), request)()
        else:
            detach_all()  # tangents that come and go would make Dr.Jit record kernels again
            self._pair.loaded().set_parameters({key: at[key] for key in self._keys if key in at})
            numbers = self._posed.numbers(parameters, count)
            radiance = self.kernel(PosesPass(self._posed, count), request)(tensor(numbers).array)
        dr.eval(radiance)
        return self.dropped.develop(radiance, request.spp, 1, (count, self.count(request), 3)).array

    def image_pair(self, current: Tree, previous: Tree, request: SampleRequest, space: Space) -> Rendering:
        """Render unbiased images of two states on the same paths or, with "primary", from the same random numbers."""
        self.set_parameters(current)
        # A virtual call reaches both scenes' objects, and its adjoint accumulates gradients in all that are attached.
        self.set_parameters(previous, previous=True, attach=request.both_gradients)
        space = "primary" if self._light.aov or (self._geometric and not self._related) else space
        if space == "primary" and (self._light.aov or not (self._geometric and self._related)):
            radiance = self.kernel(ImagePass(), request)()
            radiance_previous = self.kernel(ImagePass(previous=True), request)()
        else:
            task: Pass = ImagePairPass()
            if self._geometric:
                tracer = self._moved_kernel if space == "path" else self._unrelated_kernel
                task = MovedPairPass(self._moving, tracer, self._still_sensors and self._only_meshes)
            radiance, radiance_previous = self.kernel(task, request)()
        dr.eval(radiance, radiance_previous)
        images = self.develop(radiance, request), self.develop(radiance_previous, request)
        return Rendering(*images, Paths(request, radiance, radiance_previous, space, previous))

    # ------------------------------------------------------------------ derivatives

    def adjoint(self, parameters: Tree, paths: Paths, weights: mi.TensorXf) -> Tree:
        """Return the gradient of the mean over groups g of sum(weights[g] * images[g]) by path replay, see `RenderSession.adjoint`."""
        if self._pair.volumetric and paths.previous is not None and paths.space == "path":
            # The collisions of a pair in a medium depend on both states, and so does its replay.
            self.set_parameters(parameters)
            self.set_parameters(paths.previous, previous=True, attach=paths.request.both_gradients)
            self.kernel(AdjointPairPass(both=False), paths.request)(paths.radiance, weights, paths.radiance_previous)
            return self._pair.loaded().take_gradients()
        self.set_parameters(parameters)
        if self._replays:
            self.kernel(AdjointPass(), paths.request)(paths.radiance, weights)
        else:
            self._pair.clear_gradients()
        return self._gradients(parameters, paths.request, weights)

    def adjoint_pair(
        self, current: Tree, previous: Tree, paths: Paths, weights: mi.TensorXf, weights_previous: mi.TensorXf
    ) -> tuple[Tree, Tree]:
        """Return the gradients of both states of a pair by path replay, see `RenderSession.adjoint_pair`. Path space takes one pass on
        shared paths. Primary space, and moving shapes, take one pass per state with the same random numbers."""
        self.set_parameters(current)
        self.set_parameters(previous, previous=True)
        request = paths.request
        if paths.space == "primary" or self._geometric:
            gradient = self.adjoint(current, Paths(request, paths.radiance), weights)
            if self._replays:
                radiance = paths.radiance_previous
                if paths.space == "path":  # the pair's paths differ from those that `prb` replays
                    radiance = self.kernel(ImagePass(previous=True), request)()
                    dr.eval(radiance)
                self.kernel(AdjointPass(previous=True), request)(radiance, weights_previous)
            else:
                self._pair.clear_gradients()
            return gradient, self._gradients(previous, request, weights_previous, previous=True)
        states = (paths.radiance, weights, paths.radiance_previous, weights_previous)
        self.kernel(AdjointPairPass(), request)(*states)
        return self._pair.loaded().take_gradients(), self._pair.loaded(previous=True).take_gradients()

    def tangent_moment(
        self, parameters: Tree, paths: Paths, tangents: Tree, combined: tuple[float, ...] | None = None
    ) -> mi.TensorXf:
        """Return the squared derivative of each path, and of moving edges, along the tangents. See `RenderSession.tangent_moment`."""
        self._check_keys(parameters)
        if not self._replays:
            raise InputError(no_tangents(parameters))
        if self._pair.volumetric and paths.previous is not None and paths.space == "path":
            # The collisions of a pair in a medium depend on both states, so trace one state with the same random numbers.
            paths = self.image(parameters, paths.request).paths
        rest = {key: value for key, value in parameters.items() if key not in self._poses}
        self._pair.loaded().set_tangents(rest, tangents, self._attached)
        self._set_poses(parameters)
        squares = self.kernel(TangentPass(combined), paths.request)(paths.radiance)
        dr.eval(squares)
        moments = self.develop(squares, paths.request)
        if self._boundary is not None:
            edges = self._boundary.tangent_moment(self._pair.loaded(), paths.request, combined)
            moments += mi.TensorXf(edges.array, moments.shape[1:])
        return moments if paths.request.groups > 1 else moments[0]

    def emitters(self) -> np.ndarray:
        own = own_probabilities(self._pair.current)
        moves = self._geometric or any((self._posed, self._camera, self._boundary))
        if len(own) > 1 and (moves or self._pair.volumetric):
            reason = "shapes or sensors move" if moves else "it has participating media"
            raise InputError(f"custom emitter sampling is not supported if {reason}; leave out emitter selection")
        return own

    def emitter_moments(
        self, parameters: Tree, paths: Paths, tangents: Tree, weights: mi.TensorXf, noise: mi.TensorXf
    ) -> EmitterMoments:
        scene = self._pair.loaded()
        self._check_keys(parameters)
        scene.set_tangents(parameters, tangents, self._attached)
        task = ConnectionsPass(max(1, self._light.max_depth - 1))
        connections = self.kernel(task, paths.request)(paths.radiance, weights, noise)
        dr.eval(connections)
        return connection_moments(scene.scene, *connections)

    def vertices(self, parameters: Tree, request: SampleRequest) -> mi.TensorXf:
        self.set_parameters(parameters)
        request = replace(request, groups=1)
        counts = self.kernel(VerticesPass(), request)()
        dr.eval(counts)
        return self.develop(counts, request)[0]

    def _gradients(self, at: Tree, request: SampleRequest, weights: mi.TensorXf, previous: bool = False) -> Tree:
        """Return the gradients of the last adjoint pass plus the boundary term of moving shapes, the derivatives by sensors and those that
        `prb` lacks: of specular lobes, masks and rotated skies, on other paths of the same groups of samples."""
        scene = self._pair.loaded(previous)
        for term in filter(None, (self._boundary, self._camera)):
            term.accumulate(scene, request, weights)
        gradients, apart = scene.take_gradients(), self._apart
        return gradients | apart.adjoint(at, apart.image(at, request).paths, weights) if apart else gradients

    # ------------------------------------------------------------------ launches

    def set_parameters(self, parameters: Tree, previous: bool = False, attach: bool = True) -> None:
        self._check_keys(parameters)
        rest = {key: value for key, value in parameters.items() if key not in self._poses}
        self._pair.loaded(previous).set_parameters(rest, self._attached if attach else frozenset())
        self._set_poses(parameters, previous)

    def _set_poses(self, parameters: Tree, previous: bool = False) -> None:
        if self._posed is None:
            return
        current = {key: parameters[key].numpy()[None] for key in self._poses if key in parameters}
        self._at[previous] = tensor(self._posed.numbers(current, 1)).array

    def _posed_scene(self, previous: bool) -> PosedScene | None:
        if self._posed is None or not previous:
            return self._posed
        if self._posed_previous is None:
            self._posed_previous = PosedScene(self._pair.previous, self._poses, self._attributed)
            share_addresses([*self._posed.scenes(), *self._posed_previous.scenes()])
        return self._posed_previous

    def _check_keys(self, parameters: Tree) -> None:
        for key in parameters:
            if key not in self._keys and key not in self._poses:
                raise InputError(f"parameter {key}: the renderer was not prepared for it")

    def count(self, request: SampleRequest) -> int:
        if request.pixels is not None:
            return dr.width(request.pixels)
        height, width = self._pair.resolutions[request.sensor]
        return height * width

    def develop(self, radiance: mi.Spectrum, request: SampleRequest) -> mi.TensorXf:
        size = self._pair.resolutions[request.sensor] if request.pixels is None else (self.count(request),)
        return self.dropped.develop(radiance, request.spp, request.groups, (*size, 3))

    def kernel(self, task: Pass, request: SampleRequest) -> Callable[..., Any]:
        """Return the kernel of a pass for a request, a function of the pass's own arrays. It is traced once and replayed later."""
        pair, count = self._pair, self.count(request)
        if not (self._geometric or self._poses):
            request = for_every_sensor(request, pair.current.sensors(), count)
        several = request.sensors is not None
        strata = request.spp // request.groups if request.stratified else 1
        size = LaunchSize(0 if several else request.sensor, request.spp, count, self._light.hide_emitters, strata)
        outside = not are_recordable(pair.current.sensors()[request.sensor], several)
        # Each resolution of a texture or grid needs its own recording, since a replay with another one would fail.
        shapes = pair.loaded().shapes()
        absent = tuple(part is None for part in (request.pixels, request.positions, request.emitters, request.seeds))
        key = (task, size, request.groups, several, outside, shapes, *absent)
        posed = None if isinstance(task, PosesPass) else self._posed_scene(task.previous)
        if key not in self._functions:
            posing = isinstance(task, PosesPass)
            kernel = self._geometry_kernel if self._geometric and not posing else self._path_kernel
            traced = task.function(kernel, self._sampler, size, posed)
            self._functions[key] = FrozenFunction(traced, self._recordable, self._attached)
        share_addresses()
        scenes, films = [loaded.scene for loaded in loaded_scenes()], pair.films(request)
        tables = task.tables(pair, self._delta_table, None if several else request.sensor) | self._rough.tables
        if request.emitters is not None and len(self.emitters()) > 1:
            tables |= pair.emitter_tables(task.previous, request.emitters)
        # A constant would record each kernel again.
        seeds = (dr.opaque(mi.UInt32, request.seed) if request.seeds is None else request.seeds), request.positions
        rays = task.camera_rays(pair, self._sampler, size, seeds, request.pixels, films) if outside else None
        prepare: Callable[[], None] = (lambda: None) if task.needs_tangents else pair.clear_gradients
        scene = task.scene(pair) if posed is None else (posed.scenes(), self._at[task.previous])
        return partial(self._functions[key], prepare, scene, scenes, tables, seeds, request.pixels, films, rays)
