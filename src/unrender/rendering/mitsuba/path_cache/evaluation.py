"""Radiance and gradients of paths in memory, at the values that the scene's lookups hold."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import drjit as dr
import mitsuba as mi

from unrender.rendering.mitsuba import film
from unrender.rendering.mitsuba.camera_paths import dropped_together, is_finite
from unrender.rendering.mitsuba.integrators.base import total
from unrender.rendering.mitsuba.path_cache.lookups import Lookups
from unrender.rendering.mitsuba.path_cache.tracing import SOURCES

Vertices = Mapping[str, Any]
"""What `TracePass` returns."""
Objects = tuple[list[Any], list[Any]]
"""Textures and emitters that are looked up, of one state's scene."""


class Evaluation:
    """The sum of products that kept paths carry.

    Args:
        lookups: what depends on parameters.
        depth: longest path in segments.
    """

    def __init__(self, lookups: Lookups, depth: int):
        self._areas, self._depth = lookups.areas, depth

    def radiance(self, vertices: Vertices, states: Sequence[Objects]) -> tuple[mi.Spectrum, ...]:
        """The radiance of each path in each state; not finite in all states where it is not in one."""
        with dr.suspend_grad():
            return dropped_together(*(self._radiance(vertices, objects) for objects in states))

    def backward(
        self, vertices: Vertices, states: Sequence[Objects], replay: Sequence[tuple[Any, Any]], spp: int, pixels: int
    ) -> None:
        """Accumulate the gradients of the leaves.

        Args:
            vertices: the paths.
            states: the objects of each state.
            replay: of each state, the film's weights and the radiance that `radiance` returned.
            spp: samples per pixel.
            pixels: how many pixels.
        """
        finite = is_finite(*(radiance for _, radiance in replay))
        parts = [
            film.film_adjoint(weights, spp, pixels) * self._radiance(vertices, objects, finite)
            for (weights, _), objects in zip(replay, states, strict=True)
        ]
        # Paths of one segment meet no surface that is looked up.
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
        """e_r l_r of one of the sources."""
        number, place = (_read(vertices[f"{source}_{name}"], row) for name in ("emitter", "place"))
        found = mi.Color3f(1)
        for index, emitter in enumerate(emitters, 1):
            on = number == index
            si: Any = dr.zeros(mi.SurfaceInteraction3f)
            si.uv = mi.Point2f(place.x, place.y)
            si.wi = mi.Vector3f(0, 0, 1) if index <= self._areas else -mi.Vector3f(place)
            found = dr.select(on, mi.Color3f(emitter.eval(si, on)), found)
        return _read(vertices[source], row) * found


def _reflectance(vertices: Vertices, row: mi.UInt32, textures: Sequence[Any]) -> mi.Color3f:
    """t of a vertex."""
    si: Any = dr.zeros(mi.SurfaceInteraction3f)
    si.uv, number = _read(vertices["uv"], row), _read(vertices["surface"], row)
    found = mi.Color3f(1)
    for index, texture in enumerate(textures, 1):
        on = number == index
        found = dr.select(on, mi.Color3f(texture.eval(si, on)), found)
    return found


def _read(values: Any, row: mi.UInt32) -> Any:
    return dr.gather(type(values), values, row)
