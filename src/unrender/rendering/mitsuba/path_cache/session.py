"""A session that traces paths once, and evaluates images of a pair and all adjoints on its paths from memory."""

from __future__ import annotations

import weakref
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import drjit as dr
import mitsuba as mi

from unrender.backend.variant import lookup_mask
from unrender.core.errors import InputError
from unrender.core.trees import Tree
from unrender.rendering.mitsuba import film
from unrender.rendering.mitsuba.camera_paths import DroppedSamples, Paths, dropped_together, is_finite
from unrender.rendering.mitsuba.frozen import FrozenFunction
from unrender.rendering.mitsuba.integrators.base import total
from unrender.rendering.mitsuba.light_paths import LightPaths
from unrender.rendering.mitsuba.path_cache.tracing import SOURCES, Lookups, TracePass
from unrender.rendering.mitsuba.scene_pair import ScenePair
from unrender.rendering.mitsuba.session import MitsubaSession
from unrender.rendering.renderer import Rendering, SampleRequest, Space
from unrender.rendering.wrapper import SessionWrapper

Vertices = Mapping[str, Any]
"""Result of `TracePass`."""
Objects = tuple[list[Any], list[Any]]
"""Looked-up textures and emitters of one state's scene."""


class Evaluation:
    """Evaluation of the sum of products that a cached path of at most `depth` segments represents."""

    def __init__(self, lookups: Lookups, depth: int):
        self._areas, self._depth = lookups.areas, depth

    def radiance(self, vertices: Vertices, states: Sequence[Objects]) -> tuple[mi.Spectrum, ...]:
        """Return the radiance of each path in each state. A path that is not finite in one state is not finite in all."""
        with dr.suspend_grad():
            return dropped_together(*(self._radiance(vertices, objects) for objects in states))

    def backward(
        self, vertices: Vertices, states: Sequence[Objects], replay: Sequence[tuple[Any, Any]], spp: int, pixels: int
    ) -> None:
        """Accumulate the gradients of the leaves; `replay` has the film's weights and the result of `radiance` for each state."""
        finite = is_finite(*(radiance for _, radiance in replay))
        parts = [
            film.film_adjoint(weights, spp, pixels) * self._radiance(vertices, objects, finite)
            for (weights, _), objects in zip(replay, states, strict=True)
        ]
        # Paths of one segment have no lookup, and therefore no gradient.
        dr.backward_from(total(parts), flags=dr.ADFlag.Default | dr.ADFlag.AllowNoGrad)

    def _radiance(self, vertices: Vertices, objects: Objects, finite: Any = True) -> mi.Spectrum:
        textures, emitters = objects
        lanes = dr.width(next(iter(vertices.values()))) // self._depth
        L, product = mi.Color3f(0), mi.Color3f(1)
        for number in range(self._depth):
            row = dr.arange(mi.UInt32, lanes) + number * lanes
            if number > 0 and textures:
                product = product * _reflectance(vertices, row - lanes, textures)
            if not emitters:
                light = _read(vertices["light"], row)
            else:
                light = total([self._emission(vertices, source, row, emitters) for source in SOURCES])
            L += dr.select(finite, product * light, 0)
        return mi.Spectrum(L)

    def _emission(self, vertices: Vertices, source: str, row: mi.UInt32, emitters: Sequence[Any]) -> mi.Color3f:
        """Return e_r l_r of one of the sources."""
        number, place = (_read(vertices[f"{source}_{name}"], row) for name in ("emitter", "place"))
        light = mi.Color3f(1)
        for index, emitter in enumerate(emitters, 1):
            on = number == index
            si: Any = dr.zeros(mi.SurfaceInteraction3f)
            si.uv = mi.Point2f(place.x, place.y)
            si.wi = mi.Vector3f(0, 0, 1) if index <= self._areas else -mi.Vector3f(place)
            light = dr.select(on, mi.Color3f(emitter.eval(si, lookup_mask(on))), light)
        return _read(vertices[source], row) * light


def _reflectance(vertices: Vertices, row: mi.UInt32, textures: Sequence[Any]) -> mi.Color3f:
    """Return the reflectance t of a vertex."""
    si: Any = dr.zeros(mi.SurfaceInteraction3f)
    si.uv, number = _read(vertices["uv"], row), _read(vertices["surface"], row)
    value = mi.Color3f(1)
    for index, texture in enumerate(textures, 1):
        on = number == index
        value = dr.select(on, mi.Color3f(texture.eval(si, lookup_mask(on))), value)
    return value


def _read(values: Any, row: mi.UInt32) -> Any:
    return dr.gather(type(values), values, row)


_DEEPEST = 16  # maximum path length of cached paths in segments, since kernels have a stage for each
_MOST_BYTES = 1 << 26  # Maximum memory of one rendering's paths in bytes. Larger renderings trace their adjoints.
_MOST_ALIVE = 1 << 29
"""Maximum memory of all paths of a session that are in use, such as when a loop renders all views before their adjoints."""


class CachingSession(SessionWrapper):
    """A `MitsubaSession` whose paths are traced once and cached for their adjoints.

    Neither rays nor densities depend on the parameters of `Lookups`. A pair's previous image, and each adjoint, therefore cost a tenth
    of a traced one. Samples and results equal the inner session's up to rounding. Only gradients by reflectances of exactly 0 differ:
    they include indirect light, which path replay omits.

    The inner session renders pairs that only share random numbers, and renderings whose paths need too much memory: more than 64 MB, or
    more than 512 MB together with all renderings in use.

    Args:
        pair: both loads of the scene.
        inner: session that traces the paths, and handles everything that is not cached.
        derivatives: parameters that have gradients.
        paths: settings of the light paths.

    Raises `InputError` for parameters that are not supported (`Lookups`), and for paths of more than 16 segments.
    """

    _inner: MitsubaSession

    def __init__(
        self, pair: ScenePair, inner: MitsubaSession, keys: Sequence[str], derivatives: Sequence[str], paths: LightPaths
    ):
        if not derivatives or pair.single or paths.max_depth > _DEEPEST:
            raise InputError("paths are not cached: no derivatives, one state, or too many segments")
        self._keys = tuple(sorted(keys))  # sorted, so that the numbers of lookups do not depend on the order
        lookups = Lookups(pair, self._keys)
        super().__init__(inner)
        self._pair, self._depth = pair, paths.max_depth
        self._objects = {False: (lookups.textures, lookups.emitters)}
        self._task = TracePass(lookups, paths.max_depth, paths.rr_depth)
        self._evaluation = Evaluation(lookups, paths.max_depth)
        self._functions: dict[tuple[Any, ...], FrozenFunction] = {}
        self._alive: list[weakref.ref[Paths]] = []

    @property
    def dropped(self) -> DroppedSamples:
        """Samples that were not finite."""
        return self._inner.dropped

    def path_bytes(self, request: SampleRequest) -> int:
        """Return the memory of a rendering's paths in bytes."""
        return self._task.bytes_per_row * self._depth * self._inner.count(request) * request.spp

    def _fits(self, request: SampleRequest) -> bool:
        alive = [paths for reference in self._alive if (paths := reference()) is not None]
        self._alive = [weakref.ref(paths) for paths in alive]
        size = self.path_bytes(request)
        return size <= _MOST_BYTES and size + sum(self.path_bytes(paths.request) for paths in alive) <= _MOST_ALIVE

    def _registered(self, paths: Paths) -> Paths:
        """Register paths, whose memory counts as long as they are in use."""
        self._alive.append(weakref.ref(paths))
        return paths

    # ------------------------------------------------------------------ rendering

    def image(self, parameters: Tree, request: SampleRequest) -> Rendering:
        if not self._fits(request):
            return self._inner.image(parameters, request)
        self._inner.set_parameters(parameters)
        vertices = self._inner.kernel(self._task, request)()
        (radiance,) = self._radiance(vertices, (False,), request)
        paths = Paths(request, radiance, vertices=vertices, keys=self._keys)
        return Rendering(self._inner.develop(radiance, request), None, self._registered(paths))

    def image_pair(self, current: Tree, previous: Tree, request: SampleRequest, space: Space) -> Rendering:
        if not self._fits(request):
            return self._inner.image_pair(current, previous, request, space)
        if space != "path":
            # The current image must equal, to the bit, the image that is rendered alone.
            rendering = self._inner.image_pair(current, previous, request, space)
            return replace(rendering, images=self.image(current, request).images)
        self._inner.set_parameters(current)
        self._inner.set_parameters(previous, previous=True, attach=request.both_gradients)
        vertices = self._inner.kernel(self._task, request)()
        radiances = self._radiance(vertices, (False, True), request)
        images, before = (self._inner.develop(radiance, request) for radiance in radiances)
        paths = Paths(request, radiances[0], radiances[1], space, previous, vertices, self._keys)
        return Rendering(images, before, self._registered(paths))

    # ------------------------------------------------------------------ derivatives

    def adjoint(self, parameters: Tree, paths: Paths, weights: mi.TensorXf) -> Tree:
        if not self._has_vertices(paths):
            return self._inner.adjoint(parameters, paths, weights)
        self._inner.set_parameters(parameters)
        self._backward(paths, {False: (weights, paths.radiance)})
        return self._pair.loaded().take_gradients()

    def adjoint_pair(
        self, current: Tree, previous: Tree, paths: Paths, weights: mi.TensorXf, weights_previous: mi.TensorXf
    ) -> tuple[Tree, Tree]:
        if not self._has_vertices(paths):
            return self._inner.adjoint_pair(current, previous, paths, weights, weights_previous)
        self._inner.set_parameters(current)
        self._inner.set_parameters(previous, previous=True)
        replay = {False: (weights, paths.radiance), True: (weights_previous, paths.radiance_previous)}
        self._backward(paths, replay)
        return self._pair.loaded().take_gradients(), self._pair.loaded(previous=True).take_gradients()

    def tangent_moment(
        self, parameters: Tree, paths: Paths, tangents: Tree, combined: tuple[float, ...] | None = None
    ) -> mi.TensorXf:
        return self._inner.tangent_moment(parameters, paths, tangents, combined)

    # ------------------------------------------------------------------ launches

    def _has_vertices(self, paths: Paths) -> bool:
        """Return whether the vertices of the paths are in memory and refer to this session's lookups."""
        return paths.vertices is not None and paths.keys == self._keys

    def _radiance(
        self, vertices: dict[str, Any], states: tuple[bool, ...], request: SampleRequest
    ) -> tuple[mi.Spectrum, ...]:
        lanes = self._inner.count(request) * request.spp
        function = self._function(("radiance", states, lanes), self._evaluation.radiance)
        radiances = function(self._pair.clear_gradients, vertices, [self._objects_of(state) for state in states])
        dr.eval(radiances)
        return radiances

    def _backward(self, paths: Paths, replay: dict[bool, tuple[Any, Any]]) -> None:
        request = paths.request
        spp, pixels = request.spp, self._inner.count(request)

        evaluation = self._evaluation  # a reference to the session would keep its scenes alive

        def backward(vertices: Any, states: Any, replayed: Any) -> None:
            evaluation.backward(vertices, states, replayed, spp, pixels)

        function = self._function(("backward", tuple(replay), spp, pixels, request.groups), backward)
        states = [self._objects_of(state) for state in replay]
        function(self._pair.clear_gradients, paths.vertices, states, list(replay.values()))

    def _function(self, kind: tuple[Any, ...], traced: Any) -> FrozenFunction:
        # Each resolution of a texture needs its own recording, as in `MitsubaSession.run`.
        key = *kind, self._pair.loaded().shapes()
        if key not in self._functions:
            self._functions[key] = FrozenFunction(traced)
        return self._functions[key]

    def _objects_of(self, previous: bool) -> tuple[list[Any], list[Any]]:
        if previous not in self._objects:
            lookups = Lookups(self._pair, self._keys, previous)
            self._objects[previous] = lookups.textures, lookups.emitters
        return self._objects[previous]
