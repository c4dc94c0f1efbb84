"""Images and gradients of a Mitsuba scene, for a set of parameters announced before: recorded kernels, and how they are launched."""

from __future__ import annotations

from collections.abc import Callable
from collections.abc import Set as AbstractSet
from dataclasses import replace
from functools import cached_property
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from unrender.core.errors import InputError
from unrender.core.trees import Tree
from unrender.rendering.mitsuba.boundary_term import BoundaryTerm, moved_shape
from unrender.rendering.mitsuba.camera_paths import Kernel
from unrender.rendering.mitsuba.camera_term import CameraTerm, moved_sensor, no_tangents
from unrender.rendering.mitsuba.emitter_tables import connection_moments, own_probabilities
from unrender.rendering.mitsuba.frozen import FrozenFunction, naming
from unrender.rendering.mitsuba.integrators.moved_pair import MovedPair
from unrender.rendering.mitsuba.integrators.path import PathPair
from unrender.rendering.mitsuba.integrators.prb import PrbKernel
from unrender.rendering.mitsuba.integrators.volpath import VolumePair
from unrender.rendering.mitsuba.light_paths import LightPaths
from unrender.rendering.mitsuba.loaded_scene import detach_all, loaded_scenes, share_addresses
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
from unrender.rendering.mitsuba.recordable import are_recordable
from unrender.rendering.mitsuba.rendered_paths import DroppedSamples, Paths
from unrender.rendering.mitsuba.rough_lobes import RoughLobes
from unrender.rendering.mitsuba.scene_pair import ScenePair
from unrender.rendering.mitsuba.tensors import is_broadcast, tensor
from unrender.rendering.renderer import EmitterMoments, Rendering, SampleRequest, Space

_LANES = 1 << 22
"""Paths per launch of a batch: what fits a small machine's memory."""


class MitsubaSession:
    """Kernels for one set of parameters. Equal arguments give equal results, whatever other sessions do between two calls.

    What the two scenes hold when a call begins is of no account: each call sets them to its own parameters, and all others to the
    scene's own values. Where they hold these already, nothing is done.

    Args:
        pair: both loads of the scene, which sessions share.
        keys: the parameters, among them poses that are written into the scene.
        poses: {key: what it stands for} of the poses by which rays are transformed.
        derivatives: the parameters that are leaves of the derivative graph: for all of a session or never, since recorded kernels
            would be recorded anew if that changed between the primal and the adjoint pass. The others change without a derivative.
        paths: settings of the light paths.
        sampler: is cloned.
        differential_bsdf: whether adjoints and tangents of one state sample roughness derivatives apart: see `RoughLobes`.

    Attributes:
        dropped: the samples that were not finite.

    Raises `InputError` where poses and other parameters that move geometry come together, or poses with a derivative and poses without:
    the scenes that posed shapes live in are not rebuilt; and where `differential_bsdf` serves nothing.
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
        moving = next((key for key, of in traits.items() if of.geometric and not of.light and key not in cameras), None)
        if poses and moving is not None:
            raise InputError(
                f"parameter {moving}: it moves geometry, which cannot go with the pose {next(iter(poses))}"
            )
        self._boundary, self._camera, self._geometric, self._replays = None, None, False, True
        moved = {key: moved_shape(scene, key) for key in (*keys, *poses) if key not in cameras}
        moved |= {key: "" for key in keys if key in scene.poses and key not in derivatives}
        # Of pairs: what moves, and what stands still.
        self._moving, self._still_sensors = frozenset(moved.values()) - {""}, not cameras
        self._related = not any(shape.class_name() in ("Instance", "ShapeGroup") for shape in pair.current.shapes())
        self._only_meshes = not any(key in poses or traits[key].geometric for key, shape in moved.items() if not shape)
        fixed = {key: pose for key, pose in poses.items() if key not in derivatives}
        if derivatives:
            # Path gradients move the shapes and sensors of the scene itself.
            everything = [key for key in (*keys, *poses) if key in derivatives]
            cameras = [key for key in cameras if key in derivatives]
            if fixed and (other := next((key for key in everything if key in poses or key in cameras), None)):
                raise InputError(
                    f"parameter {other}: path gradients move it in the scene itself, which cannot go with the pose "
                    f"{next(iter(fixed))} without a derivative; take perturbed renders for both"
                )
            shapes = {moved[key] for key in everything if key not in cameras} - {""}
            self._boundary = BoundaryTerm(pair, shapes, paths.max_depth) if shapes else None
            self._camera = CameraTerm(pair, cameras, paths.max_depth, not shapes) if cameras else None
            self._geometric = any(key in poses or traits[key].geometric for key in everything if key not in cameras)
            self._replays = len(cameras) < len(everything)
            keys = [*keys, *(key for key in poses if key in derivatives)]
        self._pair, self._keys, self._poses, self._attached = pair, keys, fixed, frozenset(derivatives)
        if fixed:  # path gradients of an earlier session may have left shapes where it moved them
            scene.set_parameters({})
        self._posed = PosedScene(pair.current, fixed) if fixed else None
        if self._posed is not None:
            share_addresses(self._posed.scenes())
        self._posed_previous: PosedScene | None = None
        self._at: dict[bool, mi.Float] = {}
        self._light, self._sampler = paths, sampler
        self._traits = [of for key, of in traits.items() if key in derivatives]
        # A recording would not see the numbers of a phase function, nor give their gradient when it is replayed.
        self._recordable = not any(of.phase for of in traits.values())
        self._delta_table = pair.delta_table(self._traits)
        served = [key for key in keys if key in derivatives] if differential_bsdf and derivatives else None
        self._rough = RoughLobes(pair, served, self._geometric)
        self._functions: dict[tuple[Any, ...], FrozenFunction] = {}
        self.dropped = DroppedSamples(at_once=not derivatives)

    @cached_property
    def _path_kernel(self) -> Kernel:
        """The path tracer for these parameters' derivatives."""
        delta = any(traits.changes_delta for traits in self._traits)
        if not self._pair.volumetric:
            return PathPair(
                self._light.max_depth, self._light.rr_depth, changing_delta=delta, differential=self._rough.differential
            )
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
        return PrbKernel(self._light.max_depth, self._light.rr_depth)

    @cached_property
    def _moved_kernel(self) -> MovedPair:
        return MovedPair(self._light.max_depth, self._light.rr_depth, shared=self._only_meshes)

    @cached_property
    def _unrelated_kernel(self) -> MovedPair:
        """Of equal random numbers: nothing is carried along."""
        return MovedPair(self._light.max_depth, self._light.rr_depth, share=0.0, shared=self._only_meshes)

    # ------------------------------------------------------------------ rendering

    def image(self, parameters: Tree, request: SampleRequest) -> Rendering:
        """Render. Unbiased."""
        if self._posed is not None and not self._attached and request.groups == 1 and request.pixels is None:
            stacked = {key: np.array(value.numpy())[None] for key, value in parameters.items()}
            return Rendering(self.image_batch(stacked, request), None, None)
        self.set_parameters(parameters)
        radiance = self.run(ImagePass(), request)
        dr.eval(radiance)
        return Rendering(self.develop(radiance, request), None, Paths(request, radiance))

    def image_batch(self, parameters: Tree, request: SampleRequest) -> mi.TensorXf:
        """Render many states with the same random numbers. See `RenderSession.image_batch`.

        Where states differ by poses alone: one launch for as many as fit the memory. Otherwise one replay of the recorded kernel for each.
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
        """The pixels of states that share all but their poses, one behind the other."""
        count = len(next(iter(parameters.values())))
        at = {key: tensor(values[0]) for key, values in parameters.items()}
        if self._posed is None or self._attached:
            self.set_parameters(at)
            radiance = self.run(ImagePass(), request)
        else:
            detach_all()  # where scenes have tangents now and then, Dr.Jit would record many a step anew
            self._pair.loaded().set_parameters({key: at[key] for key in self._keys if key in at})
            numbers = self._posed.numbers({k: v for k, v in parameters.items() if k in self._poses})
            radiance = self.run(PosesPass(self._posed, count), request, tensor(numbers).array)
        dr.eval(radiance)
        return self.dropped.develop(radiance, request.spp, 1, (count, self.count(request), 3)).array

    def image_pair(self, current: Tree, previous: Tree, request: SampleRequest, space: Space) -> Rendering:
        """Render two states on the same paths or, with "primary", from the same random numbers. Both unbiased."""
        self.set_parameters(current)
        # A call through a pointer reaches both scenes' objects, and its adjoint would accumulate gradients in all that are attached.
        self.set_parameters(previous, previous=True, attach=request.both_gradients)
        if space == "primary" and not (self._geometric and self._related):
            radiance = self.run(ImagePass(), request)
            radiance_previous = self.run(ImagePass(previous=True), request)
        else:
            task: Pass = ImagePairPass()
            if self._geometric:
                tracer = self._moved_kernel if space == "path" else self._unrelated_kernel
                task = MovedPairPass(self._moving, tracer, self._still_sensors and self._only_meshes)
            radiance, radiance_previous = self.run(task, request)
        dr.eval(radiance, radiance_previous)
        images = self.develop(radiance, request), self.develop(radiance_previous, request)
        return Rendering(*images, Paths(request, radiance, radiance_previous, space, previous))

    # ------------------------------------------------------------------ derivatives

    def adjoint(self, parameters: Tree, paths: Paths, weights: mi.TensorXf) -> Tree:
        """Path replay: the gradient of mean over groups g of sum(weights[g] * images[g]). See `RenderSession.adjoint`."""
        if self._pair.volumetric and paths.previous is not None and paths.space == "path":
            # Where a pair collides in a medium depends on both states: so does its replay.
            self.set_parameters(parameters)
            self.set_parameters(paths.previous, previous=True, attach=paths.request.both_gradients)
            self.run(AdjointPairPass(both=False), paths.request, paths.radiance, weights, paths.radiance_previous)
            return self._pair.loaded().take_gradients()
        self.set_parameters(parameters)
        if self._replays:
            self.run(AdjointPass(), paths.request, paths.radiance, weights)
        else:
            self._pair.clear_gradients()
        return self._gradients(paths.request, weights)

    def adjoint_pair(
        self, current: Tree, previous: Tree, paths: Paths, weights: mi.TensorXf, weights_previous: mi.TensorXf
    ) -> tuple[Tree, Tree]:
        """Path replay of both states of a pair: in path space on one set of paths, in one pass; in primary space, and where shapes move,
        each on its own, from the same random numbers. See `RenderSession.adjoint_pair`."""
        self.set_parameters(current)
        self.set_parameters(previous, previous=True)
        request = paths.request
        if paths.space == "primary" or self._geometric:
            gradient = self.adjoint(current, Paths(request, paths.radiance), weights)
            if self._replays:
                radiance = paths.radiance_previous
                if paths.space == "path":  # of other paths than `prb` would replay
                    radiance = self.run(ImagePass(previous=True), request)
                    dr.eval(radiance)
                self.run(AdjointPass(previous=True), request, radiance, weights_previous)
            else:
                self._pair.clear_gradients()
            return gradient, self._gradients(request, weights_previous, previous=True)
        states = (paths.radiance, weights, paths.radiance_previous, weights_previous)
        self.run(AdjointPairPass(), request, *states)
        self.dropped.read()
        return self._pair.loaded().take_gradients(), self._pair.loaded(previous=True).take_gradients()

    def tangent_moment(
        self, parameters: Tree, paths: Paths, tangents: Tree, combined: tuple[float, ...] | None = None
    ) -> mi.TensorXf:
        """Return the squared derivative of each path, and of moving edges, along the tangents. See `RenderSession.tangent_moment`."""
        self._check_keys(parameters)
        if not self._replays:
            raise InputError(no_tangents(parameters))
        if self._pair.volumetric and paths.previous is not None and paths.space == "path":
            # Where a pair collides in a medium depends on both states: other paths, from the same random numbers.
            paths = self.image(parameters, paths.request).paths
        rest = {key: value for key, value in parameters.items() if key not in self._poses}
        self._pair.loaded().set_tangents(rest, tangents, self._attached)
        self._set_poses(parameters)
        squares = self.run(TangentPass(combined), paths.request, paths.radiance)
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
            raise InputError(f"a scene's emitters keep the probabilities that it gives them where {reason}")
        return own

    def emitter_moments(
        self, parameters: Tree, paths: Paths, tangents: Tree, weights: mi.TensorXf, noise: mi.TensorXf
    ) -> EmitterMoments:
        scene = self._pair.loaded()
        self._check_keys(parameters)
        scene.set_tangents(parameters, tangents, self._attached)
        task = ConnectionsPass(max(1, self._light.max_depth - 1))
        found = self.run(task, paths.request, paths.radiance, weights, noise)
        dr.eval(found)
        return connection_moments(scene.scene, *found)

    def vertices(self, parameters: Tree, request: SampleRequest) -> mi.TensorXf:
        self.set_parameters(parameters)
        request = replace(request, groups=1)
        found = self.run(VerticesPass(), request)
        dr.eval(found)
        return self.develop(found, request)[0]

    def _gradients(self, request: SampleRequest, weights: mi.TensorXf, previous: bool = False) -> Tree:
        """Of the last adjoint pass, of the borders of what is visible where shapes move, and of moving sensors."""
        scene = self._pair.loaded(previous)
        for term in (self._boundary, self._camera):
            if term is not None:
                term.accumulate(scene, request, weights)
        found = scene.take_gradients()
        self.dropped.read()
        return found

    # ------------------------------------------------------------------ launches

    def set_parameters(self, parameters: Tree, previous: bool = False, attach: bool = True) -> None:
        self._check_keys(parameters)
        rest = {key: value for key, value in parameters.items() if key not in self._poses}
        self._pair.loaded(previous).set_parameters(rest, self._attached if attach else frozenset())
        self._set_poses(parameters, previous)

    def _set_poses(self, parameters: Tree, previous: bool = False) -> None:
        """Of the passes to come, in one of the two scenes."""
        if self._posed is None:
            return
        loaded = {key: pose.loaded() for key, pose in self._poses.items()}
        given = {key: parameters[key].numpy() for key in self._poses if key in parameters}
        self._at[previous] = tensor(self._posed.numbers({k: x[None] for k, x in (loaded | given).items()})).array

    def _posed_scene(self, previous: bool) -> PosedScene | None:
        """One of the two scenes with posed shapes; None where none is posed."""
        if self._posed is None or not previous:
            return self._posed
        if self._posed_previous is None:
            self._posed_previous = PosedScene(self._pair.previous, self._poses)
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

    def run(self, task: Pass, request: SampleRequest, *own: Any) -> Any:
        """Launch the kernel for requests of this form: traced once, replayed at each step."""
        pair = self._pair
        size = LaunchSize(request.sensor, request.spp, self.count(request), self._light.hide_emitters)
        several = request.sensors is not None
        outside = not are_recordable(pair.current.sensors()[request.sensor], several)
        # Of its own for each resolution of a texture or grid: a recording would be tried on the others, and fail.
        shapes = pair.loaded().shapes()
        pixels = request.pixels is None, several, request.positions is None
        key = (task, size, request.groups, pixels, outside, shapes, request.emitters is None)
        posed = None if isinstance(task, PosesPass) else self._posed_scene(task.previous)
        if key not in self._functions:
            traced = task.function(self._kernel_of(task), self._sampler, size, posed)
            self._functions[key] = FrozenFunction(traced, self._recordable)
        share_addresses()
        scenes = [loaded.scene for loaded in loaded_scenes()]
        films = pair.films(request)
        tables = task.tables(pair, self._delta_table, None if several else request.sensor) | self._rough.tables
        if request.emitters is not None and len(self.emitters()) > 1:
            tables |= pair.emitter_tables(task.previous, request.emitters)
        seeds = dr.opaque(mi.UInt32, request.seed), request.positions  # a constant would record all kernels anew
        rays = task.camera_rays(pair, self._sampler, size, seeds, request.pixels, films) if outside else None
        before: Callable[[], None] = (lambda: None) if task.needs_tangents else pair.clear_gradients
        scene = task.scene(pair) if posed is None else (posed.scenes(), self._at[task.previous])
        with naming(self._attached):
            return self._functions[key](before, scene, scenes, tables, seeds, request.pixels, films, rays, *own)

    def _kernel_of(self, task: Pass) -> Kernel:
        return self._geometry_kernel if self._geometric and not isinstance(task, PosesPass) else self._path_kernel
