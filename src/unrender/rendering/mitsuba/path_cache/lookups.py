"""Texture and emitter lookups of a path that depend on parameters, and reasons why a parameter is not supported.

With everything else fixed, a path's radiance is a sum of products of such lookups: the reflectance of a diffuse surface at each vertex,
and the radiance of an emitter at the end.
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
"""Prefixes of the class names of textures that only read texture coordinates."""
_ENVIRONMENTS = ("EnvironmentMapEmitter", "ConstantBackgroundEmitter")
_TRAVERSED = ("mitsuba", "unrender")
"""Packages whose plugins declare all their objects to `mitsuba.traverse`."""
_FIXED = ("sampling_weight", "to_world", "to_uv")


class Lookups:
    """Textures and emitters that depend on a set of parameters.

    Args:
        pair: both loads of the scene.
        previous: whether to use the second load.

    Attributes:
        textures: reflectances of diffuse BSDFs.
        emitters: area lights first, then environments.
        areas: number of area lights.

    Raises `InputError` with the reason for a parameter that is not supported.
    """

    def __init__(self, pair: ScenePair, keys: Sequence[str], previous: bool = False):
        if pair.volumetric:
            raise InputError("paths through participating media are not cached")
        self._graph = pair.loaded(previous).graph
        self._graph.check_complete()
        _check_plugins(self._graph)
        properties = pair.loaded(previous).parameters.properties
        surfaces: dict[Any, list[Any]] = {}
        emitters: dict[Any, None] = {}
        for key in keys:
            if key not in properties:
                raise InputError(f"paths are not cached for parameter {key}: it is a pose")
            try:
                for slot, owner in _slots(self._graph, properties[key][2], key.rpartition(".")[2]):
                    if isinstance(slot, mi.Emitter):
                        emitters[slot] = None
                    else:
                        surfaces.setdefault(slot, []).append(owner)
            except ValueError as error:
                raise InputError(f"paths are not cached for parameter {key}: {error}") from error
        self.textures = list(surfaces)
        self._bsdfs = list(surfaces.values())
        ordered = sorted(emitters, key=lambda emitter: emitter.class_name() in _ENVIRONMENTS)
        self.emitters = ordered
        self.areas = sum(emitter.class_name() not in _ENVIRONMENTS for emitter in ordered)

    @cached_property
    def tables(self) -> dict[str, mi.UInt32]:
        """Tables {"cached_bsdf" | "cached_emitter"} from registry ids to the index of the lookup, starting at 1; 0 for none."""
        numbers = {bsdf: index for index, owners in enumerate(self._bsdfs, 1) for bsdf in owners}
        lights = {emitter: index for index, emitter in enumerate(self.emitters, 1)}
        return {
            "cached_bsdf": _table("bsdf", self._graph.of("bsdf"), numbers),
            "cached_emitter": _table("emitter", self._graph.of("emitter"), lights),
        }


def _slots(graph: ObjectGraph, node: Any, leaf: str) -> Iterator[tuple[Any, Any]]:
    """Yield the lookup of a parameter's object for each chain of its owners: (texture, outermost BSDF) or (emitter, None).

    Raises `ValueError` with the reason if one of them is not supported.
    """
    if leaf in _FIXED:
        raise ValueError("the directions of paths depend on it")
    chains, checked = list(graph.chains(node)), set()
    for chain in [chain for chain in chains if len(chain) > 2] or chains:
        position = next((i for i, item in enumerate(chain) if isinstance(item, (mi.BSDF, mi.Emitter))), None)
        if position is None:
            raise ValueError("it belongs to neither a material nor an emitter, so paths depend on it")
        owner = chain[position]
        holders = tuple(item for item in chain if not isinstance(item, (mi.Shape, mi.Scene)))
        if holders in checked:  # already checked for another shape
            continue
        checked.add(holders)
        # A texture may hold others than the parameter's.
        for texture in (
            *chain[:position],
            *_below(graph, owner if isinstance(owner, mi.Emitter) else chain[position - 1]),
        ):
            if not texture.class_name().startswith(_TEXTURES):
                raise ValueError(f"{texture.class_name()} depends on more than texture coordinates")
        _check_around(owner, holders[position + 1 :])
        if isinstance(owner, mi.Emitter):
            if owner.class_name() not in ("AreaLight", *_ENVIRONMENTS):
                raise ValueError(f"the light of {owner.class_name()} is not supported")
            yield owner, None
            continue
        _check_bsdfs(graph, holders[position:])
        yield chain[position - 1], holders[-1]


def _below(graph: ObjectGraph, node: Any) -> Iterator[Any]:
    """Yield all objects that an object holds, recursively."""
    for other, owners in graph.owners.items():
        if node in owners:
            yield other
            yield from _below(graph, other)


def _check_around(owner: Any, around: Sequence[Any]) -> None:
    """Raise `ValueError` for a holder that is neither a BSDF around a BSDF nor a shape or scene."""
    for item in around:
        if isinstance(owner, mi.Emitter) or not isinstance(item, mi.BSDF):
            raise ValueError(f"it is inside a {item.class_name()}")


def _check_plugins(graph: ObjectGraph) -> None:
    """Raise `InputError` for a Python plugin, which may hold a supported texture without showing it to `mitsuba.traverse`."""
    for node in graph.nodes:
        if type(node).__module__.partition(".")[0] not in _TRAVERSED:
            raise InputError(f"paths are not cached with the Python plugin {type(node).__name__}")


def _check_bsdfs(graph: ObjectGraph, bsdfs: Sequence[Any]) -> None:
    inner, *around = bsdfs
    if inner.class_name() != "SmoothDiffuse":
        raise ValueError(
            f"it belongs to a {inner.class_name()}, and only the reflectance of diffuse surfaces is cached"
        )
    for bsdf in around:
        if bsdf.class_name() != "TwoSidedBRDF":
            raise ValueError(f"it is inside a {bsdf.class_name()}")
        nested = {node for node in graph.nodes if isinstance(node, mi.BSDF) and bsdf in graph.owners[node]}
        if len(nested) > 1:
            raise ValueError("its two sides have different materials")


def _table(kind: str, items: Sequence[Any], numbers: Mapping[Any, int]) -> mi.UInt32:
    ids = object_ids(kind, items)
    table = np.zeros(int(ids.max(initial=0)) + 1, np.uint32)
    for number, item in zip(ids, items, strict=True):
        table[number] = numbers.get(item, 0)
    return mi.UInt32(table)
