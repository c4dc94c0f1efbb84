"""Views of different worlds: the same scene with other values of known parameters, or another scene. A renderer that combines several."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from unrender.core import arrays, trees
from unrender.core.arrays import Array
from unrender.core.errors import InputError
from unrender.core.trees import Tree
from unrender.rendering.picture_format import PictureFormat, format_of
from unrender.rendering.renderer import (
    Derivatives,
    EmitterMoments,
    ParameterInfo,
    Renderer,
    Rendering,
    RenderSession,
    ReplacedMesh,
    SampleRequest,
    Space,
    counted_vertices,
    differentiated,
    drawing_emitters,
    with_differential_bsdf,
)
from unrender.rendering.wrapper import RendererWrapper, layers, unwrapped


@dataclass(frozen=True, eq=False)
class World:
    """The scene and the known float32 values {key: array} that one sensor of a `WorldsRenderer` renders, a sensor of that scene's
    renderer."""

    renderer: Renderer
    sensor: int
    values: Mapping[str, np.ndarray]

    def same(self, other: World) -> bool:
        """Return whether both have the same sensor, scene and known values."""
        return self.renderer is other.renderer and self.sensor == other.sensor and self.same_state(other)

    def same_state(self, other: World) -> bool:
        """Return whether both show the same scene with the same known values."""
        if self.renderer is not other.renderer or self.values.keys() != other.values.keys():
            return False
        return all(np.array_equal(value, other.values[key]) for key, value in self.values.items())


def with_worlds(renderer: Renderer, worlds: Sequence[World], bare: bool = True) -> tuple[Renderer, list[int]]:
    """Return a renderer with a sensor for each world, inside its wrappers, and their indices; itself if it has them already. `bare` is
    that of `WorldsRenderer`."""
    if isinstance(renderer, WorldsRenderer):
        if (known := renderer.sensors_of(worlds)) is not None and (renderer.bare or not bare):
            return renderer, known
        return with_worlds(renderer.inner, worlds, bare)
    if isinstance(renderer, RendererWrapper):
        inner, sensors = with_worlds(renderer.inner, worlds, bare)
        return (renderer if inner is renderer.inner else renderer.around(inner)), sensors
    if not worlds:
        return renderer, []
    distinct: list[World] = []
    for world in worlds:
        if not any(world.same(other) for other in distinct):
            distinct.append(world)
    made = WorldsRenderer(renderer, distinct, bare)
    return made, made.sensors_of(worlds) or []


def worlds_of(renderer: Renderer, sensors: Sequence[int]) -> list[World]:
    """Return the scene's renderer, its sensor and the known values for each of these sensors of a renderer with wrappers."""
    layer = next((one for one in layers(renderer) if isinstance(one, WorldsRenderer)), None)
    if layer is not None:
        return [replace(layer.state_of(sensor), sensor=int(layer._sensor[sensor])) for sensor in sensors]
    scene = unwrapped(renderer, RendererWrapper)
    return [World(scene, sensor, {}) for sensor in sensors]


class WorldsRenderer(RendererWrapper):
    """A renderer that combines the sensors of a scene with further sensors, each of which renders a world.

    Images, gradients and tangents are as unbiased as those of the inner renderers. A known parameter of a world has no gradient there.
    A parameter that is missing in the scene of a world has no effect there.

    Args:
        inner: Renders the scene that has all parameters.
        worlds: One for each further sensor.
        bare: Whether views use the sensors of `inner` too. If not, its session is prepared when it is needed: it may lack derivatives
            that the worlds have, such as those of depth beside opacity masks.
    """

    def __init__(self, inner: Renderer, worlds: Sequence[World], bare: bool = True):
        super().__init__(inner)
        self.bare = bare or any(world.renderer is inner for world in worlds)
        self.worlds = tuple(worlds)
        self.max_depth = getattr(inner, "max_depth", 6)
        self._count = len(inner.resolutions())
        states: list[World] = [World(inner, 0, {})]
        numbers = []
        for world in self.worlds:
            index = next((n for n, known in enumerate(states) if world.same_state(known)), None)
            numbers.append(len(states) if index is None else index)
            states += [world] if index is None else []
        self.states = tuple(states)
        self._state = np.array([0] * self._count + numbers)
        self._sensor = np.array([*range(self._count), *(world.sensor for world in self.worlds)])

    @property
    def renderers(self) -> list[Renderer]:
        """The renderers of all scenes, the first that of `inner`."""
        distinct: list[Renderer] = []
        for state in self.states:
            if not any(state.renderer is other for other in distinct):
                distinct.append(state.renderer)
        return distinct

    @property
    def notices(self) -> tuple[str, ...]:
        used = self.renderers[0 if self.bare else 1 :]
        return tuple(dict.fromkeys(line for one in used for line in getattr(one, "notices", ())))

    def state_of(self, sensor: int) -> World:
        """Return a world with the scene and the known values of a sensor."""
        return self.states[self._state[sensor]]

    def sensors_of(self, worlds: Sequence[World]) -> list[int] | None:
        """Return the index of each world's sensor; None where one is missing."""
        indices = [next((n for n, known in enumerate(self.worlds) if world.same(known)), None) for world in worlds]
        return None if None in indices else [self._count + n for n in indices if n is not None]

    def parameters(self) -> Mapping[str, ParameterInfo]:
        """Return the parameters of the first scene, without the capabilities that another scene lacks."""
        others = [one.parameters() for one in self.renderers[1:]]
        combined = {}
        for key, info in self.inner.parameters().items():
            for other in (known[key] for known in others if key in known):
                info = replace(
                    info,
                    differentiable=info.differentiable and other.differentiable,
                    shares_paths=info.shares_paths and other.shares_paths,
                    perturbable=info.perturbable and other.perturbable,
                    reason=info.reason or other.reason,
                )
            combined[key] = info if info.sensor is None else replace(info, sensor=self._only(key))
        return combined

    def resolutions(self) -> list[tuple[int, int]]:
        return [*self.inner.resolutions(), *(world.renderer.resolutions()[world.sensor] for world in self.worlds)]

    def formats(self) -> Sequence[PictureFormat]:
        own = [format_of(self.inner, sensor) for sensor in range(self._count)]
        return [*own, *(format_of(world.renderer, world.sensor) for world in self.worlds)]

    def prepare(self, keys: list[str], space: Space | None, derivatives: Derivatives = True) -> RenderSession:
        differentiable = differentiated(keys, derivatives)

        def prepared(renderer: Renderer) -> RenderSession:
            known = renderer.parameters()
            own = list(dict.fromkeys([*(key for key in keys if key in known), *self.known_keys(renderer)]))
            return renderer.prepare(own, space, differentiable & frozenset(own))

        session = WorldsSession(self, prepared, differentiable)
        for renderer in self.renderers[0 if self.bare else 1 :]:
            session.of(renderer)
        return session

    def known_keys(self, renderer: Renderer) -> list[str]:
        """Return the keys for which a world of this renderer has a known value."""
        held = (key for state in self.states if state.renderer is renderer for key in state.values)
        return list(dict.fromkeys(held))

    def parts(self, request: SampleRequest) -> list[tuple[int, SampleRequest, np.ndarray | None]]:
        """Return (index of the state, request for its renderer, positions in the request's pixels) for each state of the sensors of a
        request.

        Positions are None where the part contains all pixels.
        """
        if request.sensors is None:
            inner = replace(request, sensor=int(self._sensor[request.sensor]))
            return [(int(self._state[request.sensor]), inner, None)]
        sensors = arrays.numpy(request.sensors).astype(np.int64)
        numbers = self._state[sensors]
        parts = []
        for number in np.unique(numbers):
            (chosen,) = np.nonzero(numbers == number)
            part = self._part(request, sensors, chosen)
            parts.append((int(number), part, None if len(chosen) == len(sensors) else chosen))
        return parts

    def with_meshes(self, meshes: Mapping[str, ReplacedMesh], keys: Iterable[str]) -> Renderer:
        """Return the renderer with other meshes. Raises `InputError` if there are several scenes."""
        if len(self.renderers) > 1:
            raise InputError(f"{', '.join(meshes)}: triangles cannot change where views show several scenes or AOVs")
        return super().with_meshes(meshes, keys)

    def with_differential_bsdf(self) -> Renderer:
        changed = {id(one): with_differential_bsdf(one) for one in self.renderers}
        return self._changed(lambda one: changed[id(one)])

    def around(self, inner: Renderer) -> Renderer:
        return self._changed(lambda one: inner if one is self.inner else one)

    def _changed(self, change: Callable[[Renderer], Renderer]) -> WorldsRenderer:
        worlds = [replace(world, renderer=change(world.renderer)) for world in self.worlds]
        return WorldsRenderer(change(self.inner), worlds, self.bare)

    def _only(self, key: str) -> int | None:
        """Return the only sensor that depends on a sensor's parameter; None where several do.

        A sensor of another scene, or of an AOV, has the parameter too if its renderer has one of this key.
        """
        of = [state.renderer.parameters().get(key) for state in self.states]
        shown = [
            n
            for n in range(0 if self.bare else self._count, len(self._sensor))
            if (info := of[self._state[n]]) is not None and info.sensor in (None, self._sensor[n])
        ]
        return shown[0] if len(shown) == 1 else None

    def _part(self, request: SampleRequest, numbers: np.ndarray, chosen: np.ndarray) -> SampleRequest:
        pixels, positions = request.pixels, request.positions
        inner = self._sensor[numbers[chosen]]
        sensors = arrays.like_integers(inner, request.sensors) if len(set(inner)) > 1 else None
        if len(chosen) < len(numbers):
            index = arrays.like_integers(chosen, request.sensors)
            pixels = arrays.gather(pixels, index)
            positions = index if positions is None else arrays.gather(positions, index)
        return replace(request, sensor=int(inner[0]), sensors=sensors, pixels=pixels, positions=positions)


@dataclass(frozen=True, eq=False)
class _Part:
    """The paths of one state in a rendering; `chosen` are positions of its pixels among `count` in the request, None for all."""

    state: int
    chosen: np.ndarray | None
    count: int
    paths: Any


class WorldsSession:
    """Images and derivatives of views of different worlds. See `RenderSession`."""

    def __init__(
        self, renderer: WorldsRenderer, prepare: Callable[[Renderer], RenderSession], differentiable: frozenset[str]
    ):
        self._renderer, self._prepare, self._differentiable = renderer, prepare, differentiable
        self._sessions: dict[int, RenderSession] = {}
        self._known = [{key: renderer.array(x) for key, x in state.values.items()} for state in renderer.states]
        self._keys = [frozenset(state.renderer.parameters()) for state in renderer.states]
        self._own = [state.renderer.values(renderer.known_keys(state.renderer)) for state in renderer.states]

    def image(self, parameters: Tree, request: SampleRequest) -> Rendering:
        return self._rendered(request, lambda n, part: self._session(n).image(self._at(n, parameters), part))

    def image_pair(self, current: Tree, previous: Tree, request: SampleRequest, space: Space) -> Rendering:
        def pair(number: int, part: SampleRequest) -> Rendering:
            states = self._at(number, current), self._at(number, previous)
            return self._session(number).image_pair(*states, part, space)

        return self._rendered(request, pair)

    def image_batch(self, parameters: Tree, request: SampleRequest) -> Array:
        ((number, part, _),) = self._renderer.parts(request)
        count = len(next(iter(parameters.values())))
        known, scene = (
            {key: np.broadcast_to(x, (count, *x.shape)) for key, x in trees.numpy(values).items()}
            for values in (self._known[number], self._own[number])
        )
        own = {key: x for key, x in parameters.items() if key in self._keys[number]}
        return self._session(number).image_batch({**scene, **own, **known}, part)

    def adjoint(self, parameters: Tree, paths: Sequence[_Part], weights: Array) -> Tree:
        gradients = [
            self._session(part.state).adjoint(self._at(part.state, parameters), part.paths, _of_part(weights, part))
            for part in paths
        ]
        return self._sum(parameters, paths, gradients)

    def adjoint_pair(
        self, current: Tree, previous: Tree, paths: Sequence[_Part], weights: Array, weights_previous: Array
    ) -> tuple[Tree, Tree]:
        gradients = []
        for part in paths:
            states = self._at(part.state, current), self._at(part.state, previous)
            both = _of_part(weights, part), _of_part(weights_previous, part)
            gradients.append(self._session(part.state).adjoint_pair(*states, part.paths, *both))
        ones, others = ([pair[n] for pair in gradients] for n in (0, 1))
        return self._sum(current, paths, ones), self._sum(previous, paths, others)

    def tangent_moment(self, parameters: Tree, paths: Sequence[_Part], tangents: Tree) -> Array:
        moments = []
        for part in paths:
            state = self._at(part.state, parameters)
            session = self._session(part.state)
            moments.append(session.tangent_moment(state, part.paths, self._tangents(part.state, state, tangents)))
        return _joined(moments, paths)

    def vertices(self, parameters: Tree, request: SampleRequest) -> Array:
        parts = self._renderer.parts(request)
        counts = [counted_vertices(self._session(n), self._at(n, parameters), part) for n, part, _ in parts]
        count = 0 if request.pixels is None else arrays.shape(request.pixels)[0]
        return _joined(counts, [_Part(n, chosen, count, None) for n, _, chosen in parts])

    def emitters(self) -> np.ndarray:
        """Return the probabilities of the emitters. Raises `InputError` if there are several scenes, or the session supports no other
        ones."""
        if len(self._renderer.renderers) > 1:
            raise InputError("views of several scenes do not support learned emitter sampling")
        return drawing_emitters(self._session(0)).emitters()

    def emitter_moments(
        self, parameters: Tree, paths: Sequence[_Part], tangents: Tree, weights: Array, noise: Array
    ) -> EmitterMoments:
        moments = []
        for part in paths:
            state = self._at(part.state, parameters)
            own, both = self._tangents(part.state, state, tangents), (_of_part(weights, part), _of_part(noise, part))
            session = drawing_emitters(self._session(part.state))
            moments.append(session.emitter_moments(state, part.paths, own, *both))
        return sum(moments[1:], moments[0])

    def _session(self, state: int) -> RenderSession:
        return self.of(self._renderer.states[state].renderer)

    def of(self, renderer: Renderer) -> RenderSession:
        """Return the session of one of the renderers, prepared at the first call."""
        if id(renderer) not in self._sessions:
            self._sessions[id(renderer)] = self._prepare(renderer)
        return self._sessions[id(renderer)]

    def _at(self, state: int, parameters: Tree) -> Tree:
        """Return the parameters of a state's session: those that its scene has, with the known values."""
        own = {key: x for key, x in parameters.items() if key in self._keys[state]}
        return {**self._own[state], **own, **self._known[state]}

    def _tangents(self, state: int, at: Tree, tangents: Tree) -> Tree:
        known = self._known[state]
        return {
            key: tangents[key] if key in tangents and key not in known else arrays.zeros_like(x)
            for key, x in at.items()
        }

    def _rendered(self, request: SampleRequest, render: Callable[[int, SampleRequest], Rendering]) -> Rendering:
        parts = self._renderer.parts(request)
        renderings = [render(number, part) for number, part, _ in parts]
        count = 0 if request.pixels is None else arrays.shape(request.pixels)[0]
        paths = [
            _Part(number, chosen, count, one.paths) for (number, _, chosen), one in zip(parts, renderings, strict=True)
        ]
        previous = [one.previous for one in renderings]
        return Rendering(
            _joined([one.images for one in renderings], paths),
            None if any(x is None for x in previous) else _joined(previous, paths),
            paths,
        )

    def _sum(self, parameters: Tree, paths: Sequence[_Part], gradients: Sequence[Tree]) -> Tree:
        """Return the sum of the states' gradients; a value that a state knows has none there."""
        total = trees.zeros_like({key: x for key, x in parameters.items() if key in self._differentiable})
        for part, gradient in zip(paths, gradients, strict=True):
            known = self._known[part.state]
            total = {key: x + gradient[key] if key in gradient and key not in known else x for key, x in total.items()}
        return total


def _of_part(images: Array, part: _Part) -> Array:
    """Return the pixels (groups, n, 3) of a part from those of the full request (groups, N, 3)."""
    if part.chosen is None:
        return images
    groups, _, channels = arrays.shape(images)
    rows = arrays.shaped(arrays.flat(images), (groups * part.count, channels), images)
    pixels = arrays.gather_rows(rows, _rows(part, groups, arrays.flat(images)))
    return arrays.shaped(arrays.flat(pixels), (groups, len(part.chosen), channels), images)


def _joined(parts: Sequence[Any], paths: Sequence[_Part]) -> Array:
    if paths[0].chosen is None:
        return parts[0]
    if len(arrays.shape(parts[0])) < 3:  # of one group, without its axis
        return _joined([arrays.add_first_axis(x) for x in parts], paths)[0]
    total, groups, channels = None, *(arrays.shape(parts[0])[n] for n in (0, 2))
    for images, part in zip(parts, paths, strict=True):
        flat = arrays.flat(images)
        rows = arrays.shaped(flat, (groups * arrays.shape(images)[1], channels), images)
        placed = arrays.add_rows(rows, _rows(part, groups, flat), groups * part.count)
        total = placed if total is None else total + placed
    return arrays.shaped(arrays.flat(total), (groups, paths[0].count, channels), parts[0])


def _rows(part: _Part, groups: int, like: Array) -> Array:
    chosen = np.asarray(part.chosen)
    rows = (np.arange(groups)[:, None] * part.count + chosen).reshape(-1)
    return arrays.like_integers(rows, like)
