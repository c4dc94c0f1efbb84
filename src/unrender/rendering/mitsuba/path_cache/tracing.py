"""Tracing of cached paths: the lookups that depend on parameters, and the contribution of each vertex without them.

With the lookup t_j at vertex j (1 if it depends on no parameter), the lookup l_r at the emitter and fixed factors e_r, a path has the
radiance

    L = Σ_r e_r l_r Π_{j < r} t_j.

Row r contains the emission that segment r hits and the emitter-sampling connection at vertex r - 1. Row 0 is directly visible emission.
The lookups are the reflectances of diffuse surfaces and the radiance of emitters; parameters of others are not supported, with a reason.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from unrender.core.errors import InputError
from unrender.rendering.mitsuba.camera_paths import CameraPaths
from unrender.rendering.mitsuba.integrators import emitters
from unrender.rendering.mitsuba.integrators.base import (
    Bool,
    Float,
    PathContext,
    ScatteringVertex,
    Spectrum,
    UInt32,
    carries_light,
    registry_id,
    while_loop,
)
from unrender.rendering.mitsuba.integrators.path import ROULETTE_FLOOR
from unrender.rendering.mitsuba.integrators.specular import on_its_side, sampling_weights
from unrender.rendering.mitsuba.passes import LaunchSize, Pass
from unrender.rendering.mitsuba.scene_graph import ObjectGraph, object_ids
from unrender.rendering.mitsuba.scene_pair import ScenePair

_TEXTURES = ("BitmapTextureImpl", "UniformSpectrum", "SRGBReflectanceSpectrum", "Checkerboard")
"""Prefixes of the class names of textures that only read texture coordinates."""
_ENVIRONMENTS = ("EnvironmentMapEmitter", "ConstantBackgroundEmitter")
_TRAVERSED = ("mitsuba", "unrender")  # packages whose plugins declare all their objects to `mitsuba.traverse`
_FIXED = ("sampling_weight", "to_world", "to_uv")


class Lookups:
    """Textures (reflectances of diffuse BSDFs) and emitters (`areas` area lights, then environments) that depend on parameters, in one load
    of the scene. Raises `InputError` with the reason for a parameter that is not supported."""

    def __init__(self, pair: ScenePair, keys: Sequence[str], previous: bool = False):
        if pair.volumetric:
            raise InputError("paths through participating media are not cached")
        self._graph = pair.loaded(previous).graph
        self._graph.check_complete()
        for node in self._graph.nodes:  # one in Python may hold a texture without showing it to `mitsuba.traverse`
            if type(node).__module__.partition(".")[0] not in _TRAVERSED:
                raise InputError(f"paths are not cached with the Python plugin {type(node).__name__}")
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
    """Yield each lookup of a parameter: (texture, outermost BSDF) or (emitter, None). Raises `ValueError` with the reason for others."""
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
    for other, owners in graph.owners.items():
        if node in owners:
            yield other
            yield from _below(graph, other)


def _check_around(owner: Any, around: Sequence[Any]) -> None:
    for item in around:
        if isinstance(owner, mi.Emitter) or not isinstance(item, mi.BSDF):
            raise ValueError(f"it is inside a {item.class_name()}")


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


SOURCES = ("met", "connected")
"""Kinds of emission in a row, stored separately if emitters are looked up."""

_LIGHT, _LOOKED_UP, _SURFACE = 12, 12 + 4 + 12, 4 + 8
"""Bytes per row of fixed emission, of emission with an emitter lookup, and of a surface lookup."""


@dataclass
class _State:
    """Loop state of a path, see `PathState`. β includes the lookups at tracing and controls Russian roulette; W omits them."""

    ray: mi.Ray3f
    depth: UInt32
    β: Spectrum
    W: Spectrum
    η: Float
    last: ScatteringVertex
    active: Bool


class _Record:
    """Output arrays of vertices. This is not a dataclass, since Dr.Jit would treat a dataclass as loop state."""

    def __init__(self, arrays: dict[str, Any], lanes: int, weight: Any):
        self.arrays, self.lanes, self.weight = arrays, lanes, weight


class TracePass(Pass):
    """Tracing of paths to cache: {name: flat array of `depth` concatenated rows}.

    "surface" and "uv" are the index of the texture lookup at vertex r, from 1, 0 for none, and its texture coordinates. "light" is e_r if
    no parameter changes an emitter. Otherwise e_r is stored for both `SOURCES`, "met" and "connected", each with the index of the emitter
    lookup, and with its texture coordinates or the direction to it.
    """

    def __init__(self, lookups: Lookups, depth: int, rr_depth: int):
        # This is not a dataclass, since Dr.Jit would treat a dataclass as state of the loop below.
        self.lookups, self.depth, self.rr_depth = lookups, depth, rr_depth

    @property
    def bytes_per_row(self) -> int:
        """Memory of one row of a path in bytes."""
        of_lights = len(SOURCES) * _LOOKED_UP if self.lookups.emitters else _LIGHT
        return of_lights + (_SURFACE if self.lookups.textures else 0)

    def _surface_tables(self, pair: ScenePair, delta: mi.UInt32) -> dict[str, Any]:
        return self.lookups.tables

    def call(self, paths: CameraPaths, size: LaunchSize, *own: Any) -> Callable[[], Any]:
        context = paths.context()
        lanes = paths.sampler.wavefront_size()  # a sensor's rays may all be equal, of width 1
        record = _Record(self._empty(lanes), lanes, mi.Color3f(paths.response.weight))
        return functools.partial(self._trace, context, record, paths.ray, paths.sampler)

    def result(self, paths: CameraPaths, output: Any) -> Any:
        return output

    def _trace(self, context: PathContext, record: _Record, ray: Any, sampler: Any) -> dict[str, Any]:
        state = _State(
            ray=mi.Ray3f(dr.detach(ray)),
            depth=mi.UInt32(0),
            β=mi.Spectrum(1),
            W=mi.Spectrum(1),
            η=mi.Float(1),
            last=ScatteringVertex(dr.zeros(mi.SurfaceInteraction3f), mi.Float(1), mi.Bool(True)),
            active=mi.Bool(True),
        )
        while_loop(
            (state, sampler),
            lambda state, sampler: state.active,
            functools.partial(self._bounce, context, record),
            max_iterations=self.depth,
            label="cached paths",
        )
        return record.arrays

    def _empty(self, lanes: int) -> dict[str, Any]:
        size, record = lanes * self.depth, {}
        if self.lookups.textures:
            record = {"surface": dr.zeros(mi.UInt32, size), "uv": dr.zeros(mi.Point2f, size)}
        if not self.lookups.emitters:
            record["light"] = dr.zeros(mi.Color3f, size)
        else:
            for source in SOURCES:
                record[source] = dr.zeros(mi.Color3f, size)
                record[f"{source}_emitter"] = dr.zeros(mi.UInt32, size)
                record[f"{source}_place"] = dr.zeros(mi.Point3f, size)
        dr.make_opaque(record)
        return record

    def _bounce(self, context: PathContext, record: _Record, path: _State, sampler: Any) -> tuple[_State, Any]:
        """Trace one segment and the vertex at its end. It draws the random numbers of `PathPair`, so equal seeds give equal paths."""
        scene, tables, ctx = context.scene, context.tables, context.bsdf_ctx
        si = scene.ray_intersect(path.ray, ray_flags=mi.RayFlags.All, coherent=path.depth == 0, active=path.active)
        bsdf: Any = si.bsdf(path.ray)  # pyright: ignore[reportArgumentType]
        row = path.depth * record.lanes + dr.arange(mi.UInt32, record.lanes)

        # ---------------------- Direct emission ----------------------
        emitter, mis = emitters.met_emitter(context, path.last, si, path.active)
        number = self._number(tables, "cached_emitter", emitter, path.active)
        front = (number > self.lookups.areas) | (mi.Frame3f.cos_theta(si.wi) > 0)
        known = emitter.eval(si, path.active & (number == 0))
        light = path.W * mis * dr.select(number == 0, known, dr.select(front, 1, 0))
        place = dr.select(number > self.lookups.areas, -si.wi, mi.Vector3f(si.uv.x, si.uv.y, 0))
        self._write(record, "met", row, light, number, place, path.active)

        # ---------------------- Emitter sampling ----------------------
        active_next = path.active & (path.depth + 1 < self.depth) & si.is_valid()
        surface = self._number(tables, "cached_bsdf", bsdf, active_next) if self.lookups.textures else mi.UInt32(0)
        self._connect(context, record, path, si, bsdf, surface, row + record.lanes, sampler, active_next)

        # ----------------------- BSDF sampling -----------------------
        bs, weight = bsdf.sample(ctx, si, sampler.next_1d(), sampler.next_2d(), active_next)
        delta = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
        smooth = active_next & ~delta & on_its_side(si, bs)
        f, pdf = bsdf.eval_pdf(ctx, si, bs.wo, smooth)
        (weight,) = sampling_weights([f], pdf, weight, smooth, delta, bs.pdf)
        fixed = dr.select(surface == 0, weight, dr.select(pdf > 0, 1, 0))
        if self.lookups.textures:
            dr.scatter(record.arrays["surface"], surface, row, active_next)
            dr.scatter(record.arrays["uv"], si.uv, row, active_next & (surface != 0))

        # ---- Update loop variables based on current interaction -----
        path.ray = si.spawn_ray(si.to_world(bs.wo))
        path.η *= bs.eta
        path.β *= weight
        path.W *= fixed
        path.last = ScatteringVertex(si, dr.select(delta, 1, pdf), delta)

        # -------------------- Stopping criterion ---------------------
        active_next &= carries_light([path.W])
        q = dr.clip(dr.max(path.β) * dr.square(path.η), ROULETTE_FLOOR, 0.95)
        roulette = path.depth >= self.rr_depth
        rr_weight = dr.select(roulette, dr.rcp(q), 1)
        path.β *= rr_weight
        path.W *= rr_weight
        active_next &= ~roulette | (sampler.next_1d() < q)
        path.depth[si.is_valid()] += 1
        path.active = active_next
        return path, sampler

    def _connect(
        self,
        context: PathContext,
        record: _Record,
        path: _State,
        si: mi.SurfaceInteraction3f,
        bsdf: Any,
        surface: UInt32,
        row: UInt32,
        sampler: Any,
        active: Bool,
    ) -> None:
        """Write the emitter-sampling connection of a vertex."""
        active_em = active & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
        connection = emitters.EmitterConnection(context, si, sampler.next_2d(), active_em)
        ds = connection.ds
        connection.active &= ~context.scene.ray_test(si.spawn_ray_to(ds.p), connection.active)
        f, pdf = bsdf.eval_pdf(context.bsdf_ctx, si, si.to_local(ds.d), connection.active)
        number = self._number(context.tables, "cached_emitter", ds.emitter, connection.active)
        front = (number > self.lookups.areas) | (dr.dot(ds.d, ds.n) < 0)
        known = connection.radiance(ds.emitter, connection.active & (number == 0))
        # The BSDF value of a diffuse surface is t · pdf, with the reflectance t.
        light = path.W * connection.weight(pdf) * dr.select(surface == 0, f, pdf)
        light *= dr.select(number == 0, known, dr.select(front, 1, 0))
        place = dr.select(number > self.lookups.areas, ds.d, mi.Vector3f(ds.uv.x, ds.uv.y, 0))
        self._write(record, "connected", row, light, number, place, connection.active)

    def _number(self, tables: Mapping[str, Any], table: str, pointer: Any, active: Bool) -> UInt32:
        if table == "cached_emitter" and not self.lookups.emitters:
            return mi.UInt32(0)
        return dr.gather(mi.UInt32, tables[table], registry_id(pointer), active & (registry_id(pointer) != 0))

    def _write(
        self, record: _Record, source: str, row: UInt32, light: Spectrum, number: UInt32, place: Any, active: Bool
    ) -> None:
        # The weight is negative in some lobes of a film's filter, so it does not terminate paths.
        weighted = mi.Color3f(light) * record.weight
        if not self.lookups.emitters:
            dr.scatter_add(record.arrays["light"], weighted, row, active)
            return
        dr.scatter(record.arrays[source], weighted, row, active)
        dr.scatter(record.arrays[f"{source}_emitter"], number, row, active)
        dr.scatter(record.arrays[f"{source}_place"], mi.Point3f(place), row, active & (number != 0))
