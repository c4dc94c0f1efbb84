"""Which textures and emitters a path looks up because they hold a parameter, and which parameters cannot be served that way.

With all else fixed, what a path carries is a sum of products of such lookups: the reflectance of a diffuse surface at each vertex, and the
radiance of an emitter at its end.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from functools import cached_property
from typing import Any

import mitsuba as mi
import numpy as np

from unrender.core.errors import InputError
from unrender.rendering.mitsuba.scene_graph import ObjectGraph, object_ids
from unrender.rendering.mitsuba.scene_pair import ScenePair

_TEXTURES = ("BitmapTextureImpl", "UniformSpectrum", "SRGBReflectanceSpectrum", "Checkerboard")
"""Beginnings of the class names of textures that read texture coordinates alone."""
_ENVIRONMENTS = ("EnvironmentMapEmitter", "ConstantBackgroundEmitter")
_TRAVERSED = ("mitsuba", "unrender")
"""Packages whose plugins show `mitsuba.traverse` all that they hold."""
_FIXED = ("sampling_weight", "to_world", "to_uv")


class Lookups:
    """The textures and emitters that depend on some parameters.

    Args:
        pair: both loads of the scene.
        keys: the parameters.
        previous: whether to look at the second load.

    Attributes:
        textures: reflectances of diffuse BSDFs.
        emitters: area lights first, then environments.
        areas: number of area lights.

    Raises `InputError` for a parameter that is not served, and why.
    """

    def __init__(self, pair: ScenePair, keys: Sequence[str], previous: bool = False):
        if pair.volumetric:
            raise InputError("paths through participating media are not kept")
        self._graph = pair.loaded(previous).graph
        self._graph.check_complete()
        _check_plugins(self._graph)
        properties = pair.loaded(previous).parameters.properties
        surfaces: dict[Any, list[Any]] = {}
        emitters: dict[Any, None] = {}
        for key in keys:
            if key not in properties:
                raise InputError(f"paths are not kept for parameter {key}: it is a pose")
            try:
                for slot, owner in _slots(self._graph, properties[key][2], key.rpartition(".")[2]):
                    if isinstance(slot, mi.Emitter):
                        emitters[slot] = None
                    else:
                        surfaces.setdefault(slot, []).append(owner)
            except ValueError as error:
                raise InputError(f"paths are not kept for parameter {key}: {error}") from error
        self.textures = list(surfaces)
        self._bsdfs = list(surfaces.values())
        ordered = sorted(emitters, key=lambda emitter: emitter.class_name() in _ENVIRONMENTS)
        self.emitters = ordered
        self.areas = sum(emitter.class_name() not in _ENVIRONMENTS for emitter in ordered)

    @cached_property
    def tables(self) -> dict[str, mi.UInt32]:
        """{"cached_bsdf" | "cached_emitter": by registry ids, the number of what is looked up, counted from 1; 0 for nothing}."""
        numbers = {bsdf: index for index, owners in enumerate(self._bsdfs, 1) for bsdf in owners}
        lights = {emitter: index for index, emitter in enumerate(self.emitters, 1)}
        return {
            "cached_bsdf": _table("bsdf", self._graph.of("bsdf"), numbers),
            "cached_emitter": _table("emitter", self._graph.of("emitter"), lights),
        }


def _slots(graph: ObjectGraph, node: Any, leaf: str) -> Iterator[tuple[Any, Any]]:
    """Yield what is looked up for a parameter's object, by each chain of its owners: (texture, outermost BSDF) or (emitter, None).

    Raises `ValueError` that tells why one of them is not served.
    """
    if leaf in _FIXED:
        raise ValueError("it decides where paths go")
    chains, checked = list(graph.chains(node)), set()
    for chain in [chain for chain in chains if len(chain) > 2] or chains:
        place = next((i for i, item in enumerate(chain) if isinstance(item, (mi.BSDF, mi.Emitter))), None)
        if place is None:
            raise ValueError("it is neither a material's nor an emitter's, so it moves paths")
        owner = chain[place]
        way = tuple(item for item in chain if not isinstance(item, (mi.Shape, mi.Scene)))
        if way in checked:  # by another shape
            continue
        checked.add(way)
        # A texture may hold others beside the parameter's.
        for texture in (*chain[:place], *_below(graph, owner if isinstance(owner, mi.Emitter) else chain[place - 1])):
            if not texture.class_name().startswith(_TEXTURES):
                raise ValueError(f"{texture.class_name()} looks up more than texture coordinates")
        _check_around(owner, way[place + 1 :])
        if isinstance(owner, mi.Emitter):
            if owner.class_name() not in ("AreaLight", *_ENVIRONMENTS):
                raise ValueError(f"the light of {owner.class_name()} is not kept")
            yield owner, None
            continue
        _check_bsdfs(graph, way[place:])
        yield chain[place - 1], way[-1]


def _below(graph: ObjectGraph, node: Any) -> Iterator[Any]:
    """Yield all that an object holds, and what that holds."""
    for other, owners in graph.owners.items():
        if node in owners:
            yield other
            yield from _below(graph, other)


def _check_around(owner: Any, around: Sequence[Any]) -> None:
    """Raise `ValueError` for an object that paths meet in the place of a light, or of a BSDF and its two sides."""
    for item in around:
        if isinstance(owner, mi.Emitter) or not isinstance(item, mi.BSDF):
            raise ValueError(f"it lies under a {item.class_name()}")


def _check_plugins(graph: ObjectGraph) -> None:
    """Raise `InputError` where a plugin in Python may hold a served texture and not show it to `mitsuba.traverse`."""
    for node in graph.nodes:
        if type(node).__module__.partition(".")[0] not in _TRAVERSED:
            raise InputError(f"paths are not kept beside {type(node).__name__}, a plugin in Python")


def _check_bsdfs(graph: ObjectGraph, bsdfs: Sequence[Any]) -> None:
    inner, *around = bsdfs
    if inner.class_name() != "SmoothDiffuse":
        raise ValueError(f"it belongs to a {inner.class_name()}, and only the reflectance of diffuse surfaces is kept")
    for bsdf in around:
        if bsdf.class_name() != "TwoSidedBRDF":
            raise ValueError(f"it lies under a {bsdf.class_name()}")
        nested = {node for node in graph.nodes if isinstance(node, mi.BSDF) and bsdf in graph.owners[node]}
        if len(nested) > 1:
            raise ValueError("its two sides have different materials")


def _table(kind: str, items: Sequence[Any], numbers: Mapping[Any, int]) -> mi.UInt32:
    ids = object_ids(kind, items)
    table = np.zeros(int(ids.max(initial=0)) + 1, np.uint32)
    for number, item in zip(ids, items, strict=True):
        table[number] = numbers.get(item, 0)
    return mi.UInt32(table)
