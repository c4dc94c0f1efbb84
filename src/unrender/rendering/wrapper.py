"""Base classes of renderers and sessions that wrap another and forward everything that they do not override."""

from __future__ import annotations

import copy
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from unrender.core.arrays import Array
from unrender.core.errors import InputError
from unrender.core.trees import Tree
from unrender.rendering.picture_format import PictureFormat, format_of
from unrender.rendering.renderer import (
    Camera,
    Derivatives,
    EmitterMoments,
    ParameterInfo,
    Remeshable,
    Renderer,
    Rendering,
    RenderSession,
    ReplacedMesh,
    SampleRequest,
    Space,
    WithCameras,
    counted_vertices,
    differentiated,
    drawing_emitters,
    with_differential_bsdf,
)


class RendererWrapper:
    """A renderer that forwards every call to its inner renderer. Subclasses override what they change."""

    inner: Renderer

    def __init__(self, inner: Renderer):
        self.inner = inner

    @property
    def notices(self) -> tuple[str, ...]:
        """Deviations of the inner renderer from what its scene asks for, one line each."""
        return tuple(getattr(self.inner, "notices", ()))

    def parameters(self) -> Mapping[str, ParameterInfo]:
        return self.inner.parameters()

    def values(self, keys: list[str]) -> Tree:
        return self.inner.values(keys)

    def resolutions(self) -> list[tuple[int, int]]:
        return self.inner.resolutions()

    def array(self, values: np.ndarray) -> Array:
        return self.inner.array(values)

    def prepare(self, keys: list[str], space: Space | None, derivatives: Derivatives = True) -> RenderSession:
        return self.inner.prepare(keys, space, derivatives)

    def formats(self) -> Sequence[PictureFormat]:
        """Return the format of each sensor's film; `format_of`'s default if the inner renderer has no films."""
        return [format_of(self.inner, sensor) for sensor in range(len(self.resolutions()))]

    def cameras(self) -> Mapping[int, Camera]:
        """Return {sensor: camera} of the cameras that can be moved; empty if the inner renderer has none."""
        return self.inner.cameras() if isinstance(self.inner, WithCameras) else {}

    def with_differential_bsdf(self) -> Renderer:
        """Return this wrapper around the inner renderer's `with_differential_bsdf()`. Raises `InputError` if that is not supported."""
        return self.around(with_differential_bsdf(self.inner))

    def with_meshes(self, meshes: Mapping[str, ReplacedMesh], keys: Iterable[str]) -> Renderer:
        """Return this wrapper around the inner renderer's `with_meshes()`. Raises `InputError` if that is not supported."""
        if not isinstance(self.inner, Remeshable):
            raise InputError(f"{', '.join(meshes)}: this renderer cannot replace meshes; keep their triangles fixed")
        known = self.inner.parameters()
        return self.around(self.inner.with_meshes(meshes, [key for key in keys if key in known]))

    def around(self, inner: Renderer) -> Renderer:
        """Return the same wrapper around another renderer."""
        copied = copy.copy(self)
        copied.inner = inner
        return copied


class SessionWrapper:
    """A session that maps parameters, images and gradients to and from an inner session.

    Subclasses override the maps `_state`, `_tangents`, `_gradient`, `_shown`, `_paths` and `_weights`, or public methods.
    """

    def __init__(self, inner: RenderSession):
        self._inner = inner

    def _state(self, parameters: Tree) -> Tree:
        """Return the inner session's parameters for outer ones."""
        return parameters

    def _tangents(self, parameters: Tree, tangents: Tree) -> Tree:
        """Return the inner session's tangents for outer ones."""
        return self._state(tangents)

    def _gradient(self, parameters: Tree, inner_gradient: Tree, paths: Any) -> Tree:
        """Return the gradient by the outer parameters for that by the inner ones."""
        return inner_gradient

    def _shown(self, rendering: Rendering, request: SampleRequest) -> Rendering:
        """Return the outer rendering for an inner one."""
        return rendering

    def _paths(self, paths: Any) -> Any:
        """Return the inner session's paths for those of an outer rendering."""
        return paths

    def _weights(self, weights: Array) -> Array:
        """Return the derivatives by the inner session's images for those by the outer ones."""
        return weights

    def image(self, parameters: Tree, request: SampleRequest) -> Rendering:
        return self._shown(self._inner.image(self._state(parameters), request), request)

    def image_batch(self, parameters: Tree, request: SampleRequest) -> Array:
        return self._inner.image_batch(self._state(parameters), request)

    def image_pair(self, current: Tree, previous: Tree, request: SampleRequest, space: Space) -> Rendering:
        rendering = self._inner.image_pair(self._state(current), self._state(previous), request, space)
        return self._shown(rendering, request)

    def adjoint(self, parameters: Tree, paths: Any, weights: Array) -> Tree:
        gradient = self._inner.adjoint(self._state(parameters), self._paths(paths), self._weights(weights))
        return self._gradient(parameters, gradient, paths)

    def adjoint_pair(
        self, current: Tree, previous: Tree, paths: Any, weights: Array, weights_previous: Array
    ) -> tuple[Tree, Tree]:
        states, both = (self._state(current), self._state(previous)), map(self._weights, (weights, weights_previous))
        gradients = self._inner.adjoint_pair(*states, self._paths(paths), *both)
        return self._gradient(current, gradients[0], paths), self._gradient(previous, gradients[1], paths)

    def tangent_moment(self, parameters: Tree, paths: Any, tangents: Tree) -> Array:
        inner_tangents = self._tangents(parameters, tangents)
        return self._inner.tangent_moment(self._state(parameters), self._paths(paths), inner_tangents)

    def vertices(self, parameters: Tree, request: SampleRequest) -> Array:
        """Return the inner session's `CountingSession.vertices`, or ones if it does not count."""
        return counted_vertices(self._inner, self._state(parameters), request)

    def emitters(self) -> np.ndarray:
        """Return the inner session's `EmitterSession.emitters`. Raise `InputError` if it does not support this."""
        return drawing_emitters(self._inner).emitters()

    def emitter_moments(
        self, parameters: Tree, paths: Any, tangents: Tree, weights: Array, noise: Array
    ) -> EmitterMoments:
        """Return the inner session's `EmitterSession.emitter_moments`. `noise` refers to the inner session's channels."""
        state, inner_tangents = self._state(parameters), self._tangents(parameters, tangents)
        inner = drawing_emitters(self._inner)
        return inner.emitter_moments(state, self._paths(paths), inner_tangents, self._weights(weights), noise)


class DerivedRenderer(RendererWrapper):
    """A renderer with unknowns that set parameters of the inner renderer in their place.

    Args:
        members: {unknown: keys of the inner renderer's parameters that it sets}.
        infos: {unknown: its description}.
    """

    def __init__(self, inner: Renderer, members: Mapping[str, Collection[str]], infos: Mapping[str, ParameterInfo]):
        super().__init__(inner)
        self.max_depth, self.members = getattr(inner, "max_depth", 6), members
        hidden = {member for keys in members.values() for member in keys}
        self._info = {**{key: info for key, info in inner.parameters().items() if key not in hidden}, **infos}

    def parameters(self) -> Mapping[str, ParameterInfo]:
        """Return the unknowns, and the inner renderer's parameters that no unknown sets."""
        return self._info

    def prepare(self, keys: list[str], space: Space | None, derivatives: Derivatives = True) -> RenderSession:
        differentiable = differentiated(keys, derivatives)
        inner = self.inner.prepare(self.expanded(keys), space, frozenset(self.expanded(differentiable)))
        return self.session(inner, differentiable)

    def session(self, inner: RenderSession, differentiable: frozenset[str]) -> RenderSession:
        """Return the session around one of the inner renderer's, with derivatives by the keys `differentiable`."""
        raise NotImplementedError

    def expanded(self, keys: Iterable[str]) -> list[str]:
        """Return the keys of the inner renderer's parameters that these keys set."""
        return list(dict.fromkeys(member for key in keys for member in self.members.get(key, [key])))


class DerivedSession(SessionWrapper):
    """A session whose parameters `own` set parameters of the inner session, see `_inside`."""

    def __init__(self, inner: RenderSession, own: Collection[str]):
        super().__init__(inner)
        self._own, self._known = frozenset(own), list[tuple[Tree, Tree]]()

    def _inside(self, own: Tree) -> Tree:
        """Return the parameters of the inner session that these values set."""
        raise NotImplementedError

    def _split(self, tree: Tree) -> tuple[Tree, Tree]:
        return {k: x for k, x in tree.items() if k in self._own}, {k: x for k, x in tree.items() if k not in self._own}

    def _state(self, parameters: Tree) -> Tree:
        """Return the inner session's parameters: the same arrays for the same values, so the scene need not set them again."""
        own, rest = self._split(parameters)
        known = next(
            (tree for of, tree in self._known if of.keys() == own.keys() and all(of[k] is own[k] for k in of)), None
        )
        if known is None:
            known = self._inside(own)
            self._known = [*self._known[-1:], (own, known)]
        return {**rest, **known}


def combined(infos: Sequence[ParameterInfo]) -> dict[str, Any]:
    """Return the fields of a parameter that sets several others: the capabilities that all of them have, the effects that any has."""
    sensors = {info.sensor for info in infos}
    fields: dict[str, Any] = {
        name: all(getattr(info, name) for info in infos) for name in ("differentiable", "shares_paths", "perturbable")
    }
    fields |= {name: any(getattr(info, name) for info in infos) for name in ("rigid", "viewpoint", "nonlinear")}
    texts = {name: [getattr(info, name) for info in infos] for name in ("reason", "scattering")}
    fields |= {name: next(filter(None, of_each), "") for name, of_each in texts.items()}
    return fields | {"sensor": sensors.pop() if len(sensors) == 1 else None}


def layers(renderer: Any) -> Iterator[RendererWrapper]:
    """Yield the nested wrappers of a renderer, the outermost first."""
    while isinstance(renderer, RendererWrapper):
        yield renderer
        renderer = renderer.inner


def unwrapped(renderer: Any, kinds: type | tuple[type, ...]) -> Any:
    """Return the renderer without the outermost wrappers of these classes."""
    while isinstance(renderer, kinds):
        renderer = renderer.inner
    return renderer
