"""Radiance and gradients of cached paths at the current values of the scene's lookups."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import drjit as dr
import mitsuba as mi

from unrender.rendering.mitsuba import film
from unrender.rendering.mitsuba.camera_paths import dropped_together, is_finite
from unrender.rendering.mitsuba.gpu import lookup_mask
from unrender.rendering.mitsuba.integrators.base import total
from unrender.rendering.mitsuba.path_cache.lookups import Lookups
from unrender.rendering.mitsuba.path_cache.tracing import SOURCES

Vertices = Mapping[str, Any]
"""Result of `TracePass`."""
Objects = tuple[list[Any], list[Any]]
"""Looked-up textures and emitters of one state's scene."""


class Evaluation:
    """Evaluation of the sum of products that a cached path represents.

    Args:
        lookups: textures and emitters that depend on parameters.
        depth: maximum path length in segments.
    """

    def __init__(self, lookups: Lookups, depth: int):
        self._areas, self._depth = lookups.areas, depth

    def radiance(self, vertices: Vertices, states: Sequence[Objects]) -> tuple[mi.Spectrum, ...]:
        """Return the radiance of each path in each state. A path that is not finite in one state is not finite in all."""
        with dr.suspend_grad():
            return dropped_together(*(self._radiance(vertices, objects) for objects in states))

    def backward(
        self, vertices: Vertices, states: Sequence[Objects], replay: Sequence[tuple[Any, Any]], spp: int, pixels: int
    ) -> None:
        """Accumulate the gradients of the leaves.

        Args:
            vertices: cached paths.
            replay: for each state, the film's weights and the result of `radiance`.
            spp: samples per pixel.
        """
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
