# Dr.Jit's stubs know less than its functions return.
# pyright: reportArgumentType=false, reportAttributeAccessIssue=false, reportReturnType=false

"""Mitsuba's answer to the renderer port."""

from __future__ import annotations

import gc
import logging
import weakref
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from unrender.core import arrays
from unrender.core.errors import InputError
from unrender.core.suggestions import did_you_mean
from unrender.core.trees import Tree
from unrender.rendering.mitsuba import film, poses
from unrender.rendering.mitsuba.integrators.base import ReplayState
from unrender.rendering.mitsuba.integrators.path import PathPair
from unrender.rendering.mitsuba.integrators.prb import PrbKernel
from unrender.rendering.mitsuba.integrators.specular import DELTA_EQUAL
from unrender.rendering.mitsuba.integrators.volpath import VolumePair
from unrender.rendering.mitsuba.leaves import gradients, set_parameters
from unrender.rendering.mitsuba.scene_pair import (
    ParameterTraits,
    SceneDescription,
    ScenePair,
    from_tensor,
    to_tensor,
)
from unrender.rendering.renderer import ParameterInfo, Rendering, SampleRequest, Space

_log = logging.getLogger("unrender")

_LANES = 1 << 22
"""Paths per launch of a batch: what fits a small machine's memory."""


_living: weakref.WeakSet[MitsubaRenderer] = weakref.WeakSet()


@dataclass(frozen=True)
class Paths:
    """What `adjoint` needs to walk the paths of a rendering again.

    Attributes:
        shot: the samples taken.
        radiance: per lane.
        previous: likewise of the previous state; None unless a pair was rendered.
        space: where the pair shares its samples.
        other: parameters of the previous state; None unless a pair was rendered.
    """

    request: SampleRequest
    radiance: Any
    previous: Any = None
    space: Space = "path"
    other: Tree | None = None


class MitsubaRenderer:
    """A Mitsuba scene, held twice (current and previous state), with path replay gradients.

    Args:
        description: an XML file, a Mitsuba dictionary, or a function that returns one.
        max_depth: longest path in segments, >= 1.

    Parameters are `mi.TensorXf` of the shape that `parameters()` tells: a number is (), a colour (3,), a bitmap (H, W, C),
    vertex positions (3 V,). Geometry moves only through Mitsuba's `prb` kernel, whose gradient leaves out visibility. Poses of
    whole shapes and sensors, see `poses.py`, have no path gradient at all.

    Raises `InputError` where Mitsuba refuses the description.
    """

    def __init__(self, description: SceneDescription, max_depth: int = 6):
        self.max_depth = max_depth
        self.pair = ScenePair(description)
        sizes = [sensor.film().crop_size() for sensor in self.pair.current.sensors()]
        self._resolutions = [(int(size[1]), int(size[0])) for size in sizes]
        self._poses = poses.keys(self.pair.current)
        self._info: dict[str, ParameterInfo] = dict(self.pair.info())
        if self.pair.volumetric:
            self._poses = {}  # posed shapes live in scenes of their own, which media do not reach
        self._info |= {key: poses.info(pose) for key, pose in self._poses.items()}
        self._posed: poses.PosedScene | None = None
        self._attached = True
        self._keys: list[str] = []
        self._native: dict[str, Any] = {}
        self._leaves: dict[str, Any] = {}
        self._leaves_previous: dict[str, Any] = {}
        self._loaded: Tree = {}
        self._loaded_previous: Tree = {}
        self._geometric = False
        self._film_settings: film.Films | None = None
        self._recordable = True
        self._kernel = self._path_kernel([])
        self._frozen: dict[tuple, Callable[..., Any]] = {}
        self._sampler = mi.load_dict({"type": "independent"})
        _living.add(self)

    # ------------------------------------------------------------------ what there is

    def parameters(self) -> Mapping[str, ParameterInfo]:
        """Every parameter of the scene by its `mitsuba.traverse` key."""
        return self._info

    def values(self, keys: list[str]) -> Tree:
        """The scene's own values, as loaded (or as last rendered, for a key that was selected)."""
        return {
            key: self.array(self._poses[key].loaded())
            if key in self._poses
            else to_tensor(self.pair.current_parameters[key])
            for key in keys
        }

    def resolutions(self) -> list[tuple[int, int]]:
        """(height, width) of each sensor's film, after cropping."""
        return self._resolutions

    def array(self, values: np.ndarray) -> Any:
        """`mi.TensorXf` with these values, in memory of its own."""
        return mi.TensorXf(arrays.owned(values, mi.Float), np.shape(values))

    def select(self, keys: list[str], space: Space | None, derivatives: bool = True) -> None:
        """Announce the parameters to recover. See `Renderer.select`.

        Poses and other parameters that move geometry cannot be selected together: the scenes that posed shapes live in are not rebuilt.
        """
        for key in keys:
            self._check(key, space, derivatives)
        if space is not None:
            self.pair.check_separate(keys)
        if keys == self._keys and derivatives == self._attached:
            return
        own = [key for key in keys if key not in self._poses]
        all_traits = [self.pair.parameter_traits(key) for key in own]
        geometric = any(traits.geometric for traits in all_traits)
        chosen = {key: self._poses[key] for key in keys if key in self._poses}
        if chosen and geometric:
            moving = next(key for key, traits in zip(own, all_traits, strict=True) if traits.geometric)
            raise InputError(
                f"parameter {moving}: it moves geometry, which cannot go with the pose {next(iter(chosen))}"
            )
        self._posed = poses.PosedScene(self.pair.current, chosen) if chosen else None
        self._keys, self._attached = list(keys), derivatives
        self._native = {key: self.pair.current_parameters[key] for key in own}
        self._geometric = geometric and derivatives
        self._recordable = not any(traits.phase for traits in all_traits)
        changing = [traits for traits in all_traits if traits.delta != DELTA_EQUAL] if derivatives else []
        self._kernel = self._path_kernel(all_traits if derivatives else [])
        self._delta_table = self._delta_kinds(changing)
        self._leaves, self._leaves_previous, self._loaded, self._loaded_previous = {}, {}, {}, {}
        self._frozen.clear()

    def _path_kernel(self, all_traits: list[ParameterTraits]) -> Any:
        """The path tracer for these parameters' derivatives."""
        delta = any(traits.delta != DELTA_EQUAL for traits in all_traits)
        if not self.pair.volumetric:
            return PathPair(self.max_depth, changing_delta=delta)
        media = any(traits.medium for traits in all_traits)
        return VolumePair(self.max_depth, changing_delta=delta, differentiate_media=media, emission=self.pair.emissive)

    def _check(self, key: str, space: Space | None, derivatives: bool) -> None:
        if key not in self._info:
            raise InputError(f"parameter {key}: the scene has none of that name{did_you_mean(key, self._info)}")
        info = self._info[key]
        if derivatives and not info.differentiable:
            raise InputError(f"parameter {key}: it cannot be recovered by path gradients, since {info.reason}")
        if not info.perturbable:
            raise InputError(f"parameter {key}: it cannot be perturbed, since {info.reason}")
        if space == "path" and not info.shares_paths:
            raise InputError(f'parameter {key}: {info.reason}, which space="path" cannot carry; use space="primary"')

    def _delta_kinds(self, changing: list[ParameterTraits]) -> Any:
        """How perfectly specular lobes follow their parameters, by the registry ids of the current scene's BSDFs and, through
        the pointer tables, of the previous scene's."""
        kinds = {
            int(dr.reinterpret_array(mi.UInt32, mi.BSDFPtr(traits.bsdf)).numpy()[0]): traits.delta
            for traits in changing
        }
        pointers = dr.reinterpret_array(mi.UInt32, self.pair.current.shapes_dr().bsdf()).numpy()
        kinds = {number: kind for number, kind in kinds.items() if number in pointers}
        if kinds:  # only then is the second load worth its while
            previous = self.pair.tables()["bsdf"].numpy()
            kinds |= {int(previous[number]): kind for number, kind in kinds.items()}
        table = np.zeros(max(int(pointers.max(initial=0)), *kinds, 0) + 1, np.uint32)
        for number, kind in kinds.items():
            table[number] = kind
        return mi.UInt32(table)

    # ------------------------------------------------------------------ rendering

    def image(self, parameters: Tree, request: SampleRequest) -> Rendering:
        """Render. Unbiased; box filter. Posed shapes are in one group only."""
        if self._posed is not None:
            stacked = {key: np.array(value.numpy())[None] for key, value in parameters.items()}
            return Rendering(self.image_batch(stacked, request), None, None)
        self._set_current(parameters)
        radiance = self._run("image", request)
        dr.eval(radiance)
        return Rendering(self._develop(radiance, request), None, Paths(request, radiance))

    def image_batch(self, parameters: Tree, request: SampleRequest) -> Any:
        """Render many states with the same random numbers. See `Renderer.image_batch`.

        Poses alone: one launch for as many as fit the memory. Otherwise one replay of the frozen kernel for each.
        """
        count = len(next(iter(parameters.values())))
        shape = (*self.resolutions()[request.sensor], 3)
        size = max(1, _LANES // (self._count(request) * request.spp)) if not self._native else 1
        images = []
        for start in range(0, count, size):
            part = {key: value[start : start + size] for key, value in parameters.items()}
            images.append(self._launch(part, request))
        flat = images[0] if len(images) == 1 else dr.concat(images)
        return mi.TensorXf(flat, (count, *shape))

    def _launch(self, parameters: Tree, request: SampleRequest) -> Any:
        """The pixels of states that share all but their poses, one behind the other."""
        count = len(next(iter(parameters.values())))
        self._set_current({key: self.array(parameters[key][0]) for key in self._native})
        if self._posed is None:
            radiance = self._run("image", request)
        else:
            numbers = self._posed.numbers({k: v for k, v in parameters.items() if k in self._poses})
            radiance = self._run("poses", request, self.array(numbers).array, copies=count)
        dr.eval(radiance)
        return film.develop(radiance, request.spp, 1, (count, self._count(request), 3)).array

    def image_pair(self, current: Tree, previous: Tree, request: SampleRequest, space: Space) -> Rendering:
        """Render two states on the same paths or, with "primary", from the same random numbers. Both unbiased; box filter."""
        self._set_current(current)
        self._set_previous(previous)
        if space == "primary":
            radiance = self._run("image", request)
            radiance_previous = self._run("previous image", request)
        else:
            radiance, radiance_previous = self._run("pair", request, self._tables())
        dr.eval(radiance, radiance_previous)
        images = self._develop(radiance, request), self._develop(radiance_previous, request)
        return Rendering(*images, Paths(request, radiance, radiance_previous, space, previous))

    def adjoint(self, parameters: Tree, paths: Paths, weights: Any) -> Tree:
        """Path replay: the gradient of mean over groups g of sum(weights[g] * images[g]). See `Renderer.adjoint`."""
        if self.pair.volumetric and paths.other is not None and paths.space == "path":
            # Where a pair collides in a medium depends on both states: so does its replay.
            nothing = self.array(np.zeros(weights.shape))
            return self.adjoint_pair(parameters, paths.other, paths, weights, nothing)[0]
        self._set_current(parameters)
        request = paths.request
        self._run("adjoint", request, {"delta": self._delta_table}, paths.radiance, weights)
        gradient = gradients(self._leaves)
        dr.eval(gradient)
        return gradient

    def adjoint_pair(
        self, current: Tree, previous: Tree, paths: Paths, weights: Any, weights_previous: Any
    ) -> tuple[Tree, Tree]:
        """Path replay of both states of a pair: in path space on one set of paths, in one pass; in primary space each on its own.
        See `Renderer.adjoint_pair`."""
        self._set_current(current)
        self._set_previous(previous)
        request = paths.request
        if paths.space == "primary":
            tables = {"delta": self._delta_table}
            self._run("adjoint", request, tables, paths.radiance, weights)
            gradient = gradients(self._leaves)
            dr.eval(gradient)
            self._run("previous adjoint", request, tables, paths.previous, weights_previous)
        else:
            states = (paths.radiance, weights, paths.previous, weights_previous)
            self._run("adjoint pair", request, self._tables(), *states)
            gradient = gradients(self._leaves)
        gradient_previous = gradients(self._leaves_previous)
        dr.eval(gradient, gradient_previous)
        return gradient, gradient_previous

    def tangent_moment(self, parameters: Tree, paths: Paths, tangents: Tree) -> Any:
        """Path replay in forward mode: the squared derivative of each path along the tangents. See `Renderer.tangent_moment`."""
        self._loaded.clear()
        self._set_current(parameters)
        request = paths.request
        self._clear_gradients()
        for key, leaf in self._leaves.items():
            dr.set_grad(leaf, from_tensor(tangents[key], self._native[key]))
        for renderer in _living:
            renderer._derive()
        squares = self._run("tangent", request, {"delta": self._delta_table}, paths.radiance)
        dr.eval(squares)
        return self._develop(squares, request)[0]

    def _derive(self) -> None:
        """Carry tangents from the leaves to what the scenes derive from them, which cuts the ties between the two: the next rendering
        brings fresh leaves. A call through a pointer sees all objects of its kind, so all scenes of the process must be cut before one
        is differentiated forward.
        """
        for leaf in (*self._leaves.values(), *self._leaves_previous.values()):
            dr.enqueue(dr.ADMode.Forward, leaf)
        dr.traverse(dr.ADMode.Forward, dr.ADFlag.ClearEdges | dr.ADFlag.ClearInterior)
        self._loaded.clear()
        self._loaded_previous.clear()

    def _tables(self) -> dict[str, Any]:
        return dict(self.pair.tables(), delta=self._delta_table)

    def _count(self, request: SampleRequest) -> int:
        if request.pixels is not None:
            return dr.width(request.pixels)
        height, width = self.resolutions()[request.sensor]
        return height * width

    def _develop(self, radiance: Any, request: SampleRequest) -> Any:
        shape = (self._count(request), 3) if request.pixels is not None else (*self.resolutions()[request.sensor], 3)
        return film.develop(radiance, request.spp, request.groups, shape)

    def _run(self, what: str, request: SampleRequest, tables: Any = None, *more: Any, copies: int = 1) -> Any:
        """Call the frozen kernel for shots of this form: traced once, replayed at each step."""
        count = self._count(request)
        several = request.sensors is not None
        # Of its own for each resolution of a texture or grid: a recording would be tried on the others, and fail.
        sizes = tuple(tuple(value.shape) for value in self._loaded.values())
        key = (what, request.sensor, request.spp, request.groups, count, request.pixels is None, several, copies, sizes)
        trace = self._trace_poses if what == "poses" else self._trace
        if key not in self._frozen:
            traced = trace(what, request.sensor, request.spp, count, copies)
            # A recording would not see the numbers of a phase function, nor give their gradient when it is replayed.
            self._frozen[key] = _uncollected(dr.freeze(traced)) if self._recordable else traced
        scene = self.pair.previous if what.startswith("previous") else self.pair.current
        if what == "poses":
            assert self._posed is not None
            scene = self._posed.scenes()
        living = [self.pair.current, *self.pair.others()]
        chosen = (self._films(), request.sensors) if several else None
        if self.pair.volumetric:
            previous = what.startswith("previous")
            majorants = self.pair.majorants(previous, what.endswith("pair"))
            tables = {**(tables or {}), **self.pair.media(previous, request.sensor), **majorants}
        arguments = (scene, living, tables, mi.UInt32(request.seed), request.pixels, chosen, *more)

        def launch() -> Any:
            if what != "tangent":  # where they are the input
                self._clear_gradients()
            return self._frozen[key](*arguments)

        try:
            return launch()
        except RuntimeError as error:
            if "frozen function" not in str(error):
                raise
            # Mitsuba objects outside these scenes, even unused ones, can keep Dr.Jit from recording; so do the numbers of
            # phase functions, which it does not find.
            _log.warning(
                "this process holds other Mitsuba objects, which keep kernels from being frozen: steps are slower"
                if not self.pair.volumetric
                else "phase functions or other Mitsuba objects keep kernels from being frozen: steps are slower"
            )
            self._frozen[key] = trace(what, request.sensor, request.spp, count, copies)
            return launch()

    def _clear_gradients(self) -> None:
        for leaf in (*self._leaves.values(), *self._leaves_previous.values()):
            dr.clear_grad(leaf)

    def _trace_poses(self, what: str, sensor: int, spp: int, count: int, copies: int) -> Callable[..., Any]:
        del what
        posed, kernel = self._posed, self._kernel
        assert posed is not None

        def trace(scenes, living, numbers, seed, pixels, chosen):
            del living, chosen
            batch = dr.arange(mi.UInt32, copies * count * spp) // (count * spp)
            assembly = posed.at(scenes, numbers, batch)
            sampler = film.RepeatingSampler(count * spp)
            with dr.suspend_grad():
                camera = assembly.static.sensors()[sensor]
                ray, ray_weight = film.rays(camera, sampler, seed, spp, pixels, count, copies)
                if camera.id() in assembly.poses:
                    ray = assembly.poses[camera.id()].ray_outside(ray)
                L, _ = kernel.sample(dr.ADMode.Primal, assembly.static, None, sampler, ray, geometry=assembly)
                return L * ray_weight

        return trace

    def _films(self) -> film.Films:
        if self._film_settings is None:
            if len({str(sensor.get_medium()) for sensor in self.pair.current.sensors()}) > 1:
                raise InputError(
                    "pixels: the sensors stand in different media, so their pixels cannot be drawn together"
                )
            self._film_settings = film.Films.of(self.pair.current.sensors())
        return self._film_settings

    def _trace(self, what: str, sensor: int, spp: int, count: int, copies: int) -> Callable[..., Any]:
        assert copies == 1
        kernel = PrbKernel(self.max_depth) if self._geometric else self._kernel

        pair = what.endswith("pair")
        backward = "adjoint" in what

        def trace(
            scene, living, tables, seed, pixels, chosen, radiance=None, weights=None, radianceₚ=None, weightsₚ=None
        ):
            del living  # read through pointers, if at all
            # A sampler that is seeded already would die, and free memory, while the next kernel is recorded: clone one.
            sampler = self._sampler.clone()
            with dr.suspend_grad():
                if chosen is None:
                    ray, ray_weight = film.rays(scene.sensors()[sensor], sampler, seed, spp, pixels, count)
                else:
                    films, which = chosen
                    sensors = scene.sensors_dr()
                    ray, ray_weight = film.rays_of_many(sensors, films, which, sampler, seed, spp, pixels, count)
                if what == "tangent":
                    δ, _ = kernel.sample(dr.ADMode.Forward, scene, tables, sampler, ray, (ReplayState(None, radiance),))
                    return dr.square(δ * ray_weight)
                if backward:
                    states = ((weights, radiance), (weightsₚ, radianceₚ))[: 2 if pair else 1]
                    replay = tuple(ReplayState(film.film_adjoint(w, spp, count) * ray_weight, L) for w, L in states)
                    kernel.sample(dr.ADMode.Backward, scene, tables, sampler, ray, replay, pair)
                    return None
                L, Lₚ = kernel.sample(dr.ADMode.Primal, scene, tables, sampler, ray, pair=pair)
                return (L * ray_weight, Lₚ * ray_weight) if pair else L * ray_weight

        return trace

    # ------------------------------------------------------------------ the two states

    def _set_current(self, parameters: Tree) -> None:
        set_parameters(
            self.pair.current_parameters, parameters, self._native, self._loaded, self._leaves, self._attached
        )

    def _set_previous(self, parameters: Tree) -> None:
        set_parameters(
            self.pair.previous_parameters, parameters, self._native, self._loaded_previous, self._leaves_previous, True
        )


def _uncollected(frozen: Callable[..., Any]) -> Callable[..., Any]:
    """`frozen` with Python's garbage collector held off: arrays that die in the middle of a recording abort the process."""

    def call(*arguments: Any) -> Any:
        enabled = gc.isenabled()
        gc.disable()
        try:
            return frozen(*arguments)
        finally:
            if enabled:
                gc.enable()

    return call
