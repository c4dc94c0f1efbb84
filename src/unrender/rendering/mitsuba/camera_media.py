"""Medium that surrounds each sensor of a scene, including sensors whose description does not name it.

Mitsuba assumes that a sensor without a `medium` is outside all media. A camera inside a cloud would then not see the cloud.
"""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Iterable, Sequence
from functools import partial
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from unrender.rendering.mitsuba.scene_graph import ObjectGraph, all_shapes, class_name
from unrender.rendering.mitsuba.scene_loading import media

_log = logging.getLogger("unrender")

_RAYS = 8  # number of camera rays along each axis of the film
_SURFACES = 64  # maximum number of surfaces that a ray passes before the boundary of a medium
_MARGIN = 1e-3  # distance of a ray's origin from a bounding box, relative to half of the longest side

_AT_A_POINT = ("PerspectiveCamera", "ThinLensCamera", "RadianceMeter")


def camera_media(scene: Any, quiet: bool = False) -> list[Any]:
    """Return the medium of each sensor, None for a sensor outside all media.

    A sensor's own `medium` takes precedence. Without one, its rays are traced to their first medium boundary, and the medium that most of
    them come from is the sensor's. A warning is logged for each of these, unless `quiet`.
    """
    sensors = scene.sensors()
    result = [sensor.get_medium() for sensor in sensors]
    searched = [n for n, sensor in enumerate(sensors) if result[n] is None and _may_be_inside(scene, sensor)]
    for index, medium in zip(searched, _surrounding(scene, [_rays(sensors[n]) for n in searched]), strict=True):
        if medium is not None:
            result[index] = medium
            if not quiet:
                _log.warning(
                    "sensor %s: it names no medium, but is inside one, and is rendered inside it; mi.render would render it outside, so "
                    "give the sensor this medium before you render references",
                    sensors[index].id() or index,
                )
    return result


def unbounded_notices(scene: Any) -> list[str]:
    """Return one notice if a homogeneous medium without a border meets an environment.

    No free flight ends at infinity, but a connection to an environment has a finite length (two radii of the scene), and the MIS weight of
    the other strategy is lost.
    """
    if scene.environment() is None:
        return []
    shapes = all_shapes(scene)
    inside = [medium for shape in shapes if (medium := shape.interior_medium()) is not None]
    outside = [(sensor.get_medium(), partial(_rays, sensor)) for sensor in scene.sensors()]
    outside += [(shape.exterior_medium(), partial(_outwards, shape.bbox())) for shape in shapes]
    named = [(medium, rays) for medium, rays in outside if medium is not None and medium not in inside]
    endless = [rays for medium, rays in named if class_name(medium) == "HomogeneousMedium"]
    # A scene may describe one medium several times: as that of a closed shape, and as that of the sensors and objects in it.
    if all(medium in inside for medium in _surrounding(scene, [rays() for rays in endless])):
        return []
    return [
        "a medium without a border surrounds the scene, so paths reach the environment by emitter sampling alone: its brightness depends "
        "on sample_emitters and on the phase function, as in Mitsuba; put the medium inside a closed shape with a null BSDF"
    ]


def copied_media_notices(scene: Any, graph: ObjectGraph, keys: Iterable[str]) -> list[str]:
    """Return one notice for each unknown medium around a sensor, or around a shape, whose description has a medium of its own there, such
    as a copy, and for each such copy that is unknown, if unknowns change one of the two."""
    media_of_keys = [
        (part, key)
        for key in (keys if graph.of("medium") else ())
        if key in graph.properties
        for chain in graph.chains(graph.properties[key][2])
        for part in chain
        if isinstance(part, mi.Medium)
    ]
    if not media_of_keys:
        return []
    unknown, names = dict(reversed(media_of_keys)), dict[str, list[str]]()
    places = [(f"sensor {x.id()}", x.get_medium(), partial(_rays, x)) for x in scene.sensors()]
    places += [(f"the outside of {x.id()}", x.exterior_medium(), partial(_outwards, x.bbox())) for x in scene.shapes()]
    places = [place for place in places if place[1] is not None]
    around = _surrounding(scene, [rays() for _, _, rays in places])
    for (name, own, _), other in zip(places, around, strict=True):
        if other not in (None, own) and (own in unknown) != (other in unknown):
            names.setdefault(unknown.get(own) or unknown[other], []).append(name)
    return [
        f"{key}: {found[0]}{f' and {len(found) - 1} more' if found[1:] else ''} has a second description of the medium that is there, and "
        "unknowns change only one of the two; describe the medium once, with an id, and refer to it"
        for key, found in names.items()
    ]


def _may_be_inside(scene: Any, sensor: Any) -> bool:
    """Return False only if no shape with a medium can contain the sensor. This test needs no kernel."""
    shapes = [shape for shape in all_shapes(scene) if shape.is_medium_transition()]
    if not shapes:
        return False
    if {*shapes} - {*scene.shapes()}:  # the bounding box of a shape group's child does not bound its instances
        return True
    if sensor.class_name() not in _AT_A_POINT or any(shape.exterior_medium() is not None for shape in shapes):
        return True
    origin = np.array(sensor.world_transform().translation().numpy(), float).reshape(3)
    reach = 0.0 if sensor.class_name() != "ThinLensCamera" else _aperture_radius(sensor)
    return any(
        bool((np.array(box.min) - reach <= origin).all() and (origin <= np.array(box.max) + reach).all())
        for box in (shape.bbox() for shape in shapes)
    )


def _aperture_radius(lens: Any) -> float:
    radius: Any = mi.traverse(lens)["aperture_radius"]
    return float(np.max(np.array(radius)))


def _rays(sensor: Any) -> Any:
    """Return rays of a sensor through the whole of its film."""
    x, y = (np.mgrid[:_RAYS, :_RAYS].reshape(2, -1) + 0.5) / _RAYS
    position: Any = mi.Point2f(mi.Float(x), mi.Float(y))
    aperture: Any = mi.Point2f(mi.Float(y), mi.Float(x))
    return sensor.sample_ray_differential(mi.Float(sensor.shutter_open()), 0.5, position, aperture)[0]


def _outwards(box: Any) -> Any:
    """Return rays from the middles of the faces of a bounding box, away from it."""
    axes = np.vstack([np.eye(3), -np.eye(3)])
    middle, half = np.array(box.center()).reshape(3), np.array(box.extents()).reshape(3) / 2.0
    origins: Any = (middle + axes * (half + _MARGIN * half.max())).T
    return mi.Ray3f(mi.Point3f(origins), mi.Vector3f(axes.T))


def _surrounding(scene: Any, rays: Sequence[Any]) -> list[Any]:
    """Return for each bundle of rays the medium that most of them come from at their first medium boundary, or None."""
    if not rays:
        return []
    bundle = np.repeat(np.arange(len(rays)), [dr.width(each) for each in rays])
    parts = [[np.broadcast_to(np.array(part), (3, dr.width(each))) for part in (each.o, each.d)] for each in rays]
    origins, ways = (np.concatenate(of, axis=1) for of in zip(*parts, strict=True))
    ray: Any = mi.Ray3f(mi.Point3f(origins), mi.Vector3f(ways))
    active = dr.full(mi.Bool, True, len(bundle))
    votes = [Counter[int]() for _ in rays]
    for _ in range(_SURFACES):
        si = scene.ray_intersect(ray, mi.RayFlags.All, coherent=False, active=active)
        meets = active & si.is_valid() & si.is_medium_transition()
        before = dr.reinterpret_array(mi.UInt32, si.target_medium(-ray.d))
        active &= si.is_valid() & ~meets
        ray = si.spawn_ray(ray.d)
        dr.eval(meets, before, active, ray)
        for index, number in zip(bundle[np.array(meets)], np.array(before)[np.array(meets)].tolist(), strict=True):
            votes[index][number] += 1
        if not dr.any(active):
            break
    known = {medium_id(medium): medium for medium in dict.fromkeys(media(scene))}
    return [known.get(each.most_common(1)[0][0]) if each else None for each in votes]


def medium_id(medium: Any) -> int:
    """Return the medium's registry id, 0 for None."""
    pointer: Any = mi.MediumPtr(medium)
    number: Any = dr.reinterpret_array(mi.UInt32, pointer)
    return int(number.numpy()[0])
