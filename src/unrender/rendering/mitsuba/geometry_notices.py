"""Notices about moving meshes whose path gradients omit something, from the scene as loaded."""

from __future__ import annotations

from collections.abc import Collection
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from unrender.core.text import listed
from unrender.rendering.mitsuba import mesh_layout
from unrender.rendering.mitsuba.edges import edges_of, unit
from unrender.rendering.mitsuba.film_response import is_spectral
from unrender.rendering.mitsuba.integrators.base import registry_id
from unrender.rendering.mitsuba.parameters import is_mirror_or_glass
from unrender.rendering.mitsuba.scene_graph import ObjectGraph, attribute, has_instances, scene_of

_NEAR = 1e-3  # distance from another shape that counts as contact, relative to the diagonal of the mesh's bounding box


def contact_notices(scene: Any, keys: Collection[str]) -> list[str]:
    """Return a notice about each mesh with unknown vertices that touches or crosses other shapes, as loaded, in a scene without instances.

    The middle of an edge touches a shape on a normal of the edge's faces. Ends of edges do not count: they may meet a shape at one point.
    """
    lines = []
    for mesh in _unknown_meshes(scene, keys) if not has_instances(scene) else []:
        points = np.array(mesh_layout.positions(mesh), float).reshape(-1, 3)
        near = _NEAR * float(np.linalg.norm(np.ptp(points, axis=0))) if len(points) else 0.0
        low, high = (points.min(axis=0) - near, points.max(axis=0) + near) if len(points) else (np.inf, -np.inf)
        rest = [
            shape
            for shape in scene.shapes()
            if shape is not mesh
            and not (_is_null(shape) and shape.interior_medium() is None)
            and _meets(shape.bbox(), low, high).all()
        ]
        if not rest:
            continue
        edges = edges_of(mesh, None)
        ends = points[edges.ends]
        low, high = ends.min(axis=1) - near, ends.max(axis=1) + near
        used = np.logical_or.reduce([_meets(shape.bbox(), low, high) for shape in rest])
        if not used.any():
            continue
        start, along = ends[used, 0], ends[used, 1] - ends[used, 0]
        normals = [near * unit(np.cross(along, points[third] - start)) for third in edges.thirds[used].T]
        rays = [(start + 0.05 * along, 0.9 * along), *((start + 0.5 * along + n, -2.0 * n) for n in normals)]
        origin, way = (np.concatenate(of) for of in zip(*rays, strict=True))
        ray = mi.Ray3f(mi.Point3f(origin.T), mi.Vector3f(way.T))
        ray.maxt = 1.0  # pyright: ignore[reportAttributeAccessIssue]
        hits: Any = scene_of(rest).ray_intersect_preliminary(ray, coherent=False)
        numbers = set(np.unique(np.array(registry_id(hits.shape))[np.array(hits.is_valid())]).tolist())
        met = [shape.id() for shape in rest if int(registry_id(mi.ShapePtr(shape))[0]) in numbers]
        if met:
            lines.append(
                f"{mesh.id()} touches or crosses {listed(met)}, where path gradients of its vertices are noisy and may be biased: leave "
                "a gap between them"
            )
    return lines


def _meets(box: Any, low: Any, high: Any) -> np.ndarray:
    return ((np.array(box.min) <= high) & (low <= np.array(box.max))).all(axis=-1)


_SIDE, _HITS, _SHARE = 64, 6, 0.05
"""Rays along each side of a view, longest specular path in hits, and smallest share of a mesh's picture that is told."""


def specular_notices(scene: Any, keys: Collection[str]) -> list[str]:
    """Return a notice about each mesh with unknown vertices that views show in perfect mirrors or through smooth glass, as loaded."""
    meshes = _unknown_meshes(scene, keys)
    if not meshes or not any(is_mirror_or_glass(shape.bsdf()) for shape in scene.shapes()):
        return []
    counts = np.sum([_seen(sensor, scene, meshes) for sensor in scene.sensors()], axis=0)
    shares = counts[:, 1] / np.maximum(counts.sum(axis=1), 1.0)
    return [
        f"views show {share:.0%} of {mesh.id()} in mirrors or through smooth glass, where path gradients omit its edges: its shape may end "
        "wrong there; add views without them"
        for mesh, share in zip(meshes, shares, strict=True)
        if share >= _SHARE
    ]


def _seen(sensor: Any, scene: Any, meshes: list[Any]) -> np.ndarray:
    """Return the number of rays of a sensor that hit each mesh directly, and after specular scattering, (M, 2)."""
    sampler: Any = mi.load_dict({"type": "independent"})
    sampler.seed(0, _SIDE**2)
    number = dr.arange(mi.UInt32, _SIDE**2)
    position = (mi.Point2f(number % _SIDE, number // _SIDE) + 0.5) / _SIDE
    # An irradiancemeter has no `sample_ray`.
    ray, _ = sensor.sample_ray_differential(sensor.shutter_open(), 0.5, position, mi.Point2f(0.5))
    ray, active, specular, counts = mi.Ray3f(ray), mi.Bool(True), mi.Bool(False), np.zeros((len(meshes), 2))
    for _ in range(_HITS):
        si = scene.ray_intersect(ray, active)
        active &= si.is_valid()
        for index, mesh in enumerate(meshes):
            on = active & (si.shape == mi.ShapePtr(mesh))
            counts[index] += [np.count_nonzero(np.array(each)) for each in (on & ~specular, on & specular)]
            active &= ~on
        bs, _ = si.bsdf().sample(mi.BSDFContext(), si, sampler.next_1d(), sampler.next_2d(), active)
        active &= mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)  # which contains Null
        specular |= active & ~mi.has_flag(bs.sampled_type, mi.BSDFFlags.Null)
        ray = mi.Ray3f(si.spawn_ray(si.to_world(bs.wo)))
        dr.eval(ray, active, specular)
    return counts


def _is_null(shape: Any) -> bool:
    """Return whether rays pass through a shape as if it were not there, but for its medium."""
    flags, kinds = shape.bsdf().flags() if shape.bsdf() else mi.BSDFFlags.Null, mi.BSDFFlags
    return not any(
        mi.has_flag(flags, kind)
        for kind in (kinds.Smooth, kinds.Delta1D, kinds.DeltaReflection, kinds.DeltaTransmission)
    )


_POINTS, _SHADED = 4096, 0.01
"""Number of points of a mesh at which shadows are looked for, and smallest share of them in shadow that is told."""


def shadow_notices(scene: Any, keys: Collection[str]) -> list[str]:
    """Return a notice about each shape that is not a mesh and casts a shadow on a mesh with unknown vertices, as loaded."""
    others = [shape for shape in scene.shapes() if not (shape.is_mesh() or shape.is_emitter() or shape.is_sensor())]
    round_ones, lines = [shape for shape in others if not _is_null(shape)], []
    known = bool(round_ones and scene.emitters()) and not has_instances(scene)
    for mesh in _unknown_meshes(scene, keys) if known else []:
        if not mesh.face_count():
            continue
        samples = np.random.default_rng(0).uniform(0.0, 1.0, (2, 2, _POINTS)).astype(np.float32)
        at = mesh.sample_position(0.0, mi.Point2f(samples[0]))
        si = dr.zeros(mi.SurfaceInteraction3f, _POINTS)
        si.p, si.n = at.p, at.n
        ds, light = scene.sample_emitter_direction(si, mi.Point2f(samples[1]), False)
        lit = dr.any(light != 0) & (ds.pdf > 0)
        ray = si.spawn_ray(ds.d)
        ray.maxt = 0.999 * ds.dist
        for shape in round_ones:
            if np.mean(np.array(scene_of([shape]).ray_test(ray, active=lit))) >= _SHADED:
                lines.append(
                    f"{shape.id()}: path gradients omit the motion of its shadow on {mesh.id()}, because it is not a mesh: load it "
                    "as a mesh"
                )
    return lines


_PAIRS, _APART, _HALVINGS, _JUMP = 4096, 0.02, 16, 0.5
"""Pairs of texture coordinates, their first distance, number of times that the half with the larger difference is taken, and the share of
the first difference that remains where a texture jumps."""
_FLAT = 1e-4  # first difference, relative to the largest value, up to which a texture is constant but for rounding


def jump_notices(scene: Any, graph: ObjectGraph, keys: Collection[str]) -> list[str]:
    """Return a notice about each mesh with unknown vertices whose material has a texture with jumps."""
    if is_spectral():
        return []
    lines = []
    for mesh in _unknown_meshes(scene, keys):
        textures = [node for node in graph.nodes if isinstance(node, mi.Texture)]
        own = [node for node in textures if any(mesh in chain for chain in graph.chains(node))]
        if any(attribute(node)[0].startswith("face_") or _jumps(node) for node in own):
            lines.append(
                f"{mesh.id()}: a texture of its material has jumps, whose motion path gradients of its vertices omit: use bilinear "
                "bitmaps or attributes of vertices in place of checkerboards, filter_type nearest and attributes of faces"
            )
    return lines


def _jumps(texture: Any) -> bool:
    """Return whether a checkerboard or bitmap differs as much over a tiny distance as over a short one."""
    if not texture.class_name().startswith(("Checkerboard", "BitmapTexture")):
        return False
    si, generator = dr.zeros(mi.SurfaceInteraction3f, _PAIRS), np.random.default_rng(0)

    def values(uv: np.ndarray) -> np.ndarray:
        si.uv = mi.Point2f(uv.T.astype(np.float32))
        return np.array(texture.eval(si)).reshape(-1, _PAIRS)

    start, turn = generator.uniform(0.0, 1.0, (_PAIRS, 2)), generator.uniform(0.0, 2.0 * np.pi, _PAIRS)
    end = start + _APART * np.stack([np.cos(turn), np.sin(turn)], axis=-1)
    one, other = values(start), values(end)
    first, size = float(np.abs(other - one).max()), float(np.abs(one).max())
    for _ in range(_HALVINGS):
        middle = (start + end) / 2.0
        between = values(middle)
        near = np.abs(between - one).max(axis=0) >= np.abs(other - between).max(axis=0)
        start, end = np.where(near[:, None], start, middle), np.where(near[:, None], middle, end)
        one, other = np.where(near, one, between), np.where(near, between, other)
    return first > _FLAT * size and float(np.abs(other - one).max()) > _JUMP * first


def _unknown_meshes(scene: Any, keys: Collection[str]) -> list[Any]:
    return [shape for shape in scene.shapes() if f"{shape.id()}.{mesh_layout.POSITIONS}" in keys]
