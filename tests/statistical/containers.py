"""Small scenes with every container that Mitsuba nests objects in, and how their parameters change."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import mitsuba as mi
import numpy as np

SIZE = 16
DEPTH = 4


def to() -> Any:
    return mi.ScalarTransform4f()


def rgb(*value: float) -> dict[str, Any]:
    return {"type": "rgb", "value": list(value)}


def diffuse(*value: float) -> dict[str, Any]:
    return {"type": "diffuse", "reflectance": rgb(*(value or (0.7, 0.2, 0.1)))}


def scene(**objects: Any) -> dict[str, Any]:
    """Objects around the origin, a floor, a lamp that is a mesh, and a uniform sky."""
    film = {"type": "hdrfilm", "width": SIZE, "height": SIZE, "rfilter": {"type": "box"}}
    view = to().look_at([0, -4.5, 1.6], [0, 0, 0.3], [0, 0, 1])
    return {
        "type": "scene",
        "sensor": {"type": "perspective", "fov": 40, "to_world": view, "film": film},
        "floor": {
            "type": "rectangle",
            "to_world": to().translate([0, 0, -0.5]).scale(3),
            "bsdf": diffuse(0.4, 0.5, 0.6),
        },
        "lamp": {
            "type": "cube",
            "to_world": to().translate([1, -1, 2.5]).scale(0.3),
            "emitter": {"type": "area", "radiance": rgb(5, 4, 3)},
        },
        "sky": {"type": "constant", "radiance": rgb(0.5, 0.6, 0.7)},
        **objects,
    }


def ball(x: float = 0.0, **more: Any) -> dict[str, Any]:
    return {"type": "sphere", "center": [x, 0, 0], "radius": 0.5, **more}


def instances(*children: dict[str, Any]) -> dict[str, Any]:
    """Two instances of a group with these shapes."""
    group: dict[str, Any] = {"type": "shapegroup", **{f"part_{k}": child for k, child in enumerate(children)}}
    of = {"type": "ref", "id": "group"}
    return {
        "group": group,
        "one": {"type": "instance", "of": of, "to_world": to().translate([-0.9, 0, 0])},
        "two": {"type": "instance", "of": of, "to_world": to().translate([0.9, 0, 0]).rotate([0, 0, 1], 40)},
    }


def nested() -> dict[str, Any]:
    """BSDFs in BSDFs in BSDFs."""
    bumps = {
        "type": "bitmap",
        "raw": True,
        "bitmap": mi.Bitmap(np.random.default_rng(3).random((8, 8, 1)).astype(np.float32)),
    }
    values = np.random.default_rng(4).uniform(0.4, 0.6, (8, 8, 3)).astype(np.float32)
    values[..., 2] = 1
    normals = {"type": "bitmap", "raw": True, "bitmap": mi.Bitmap(values)}
    inner = {
        "type": "bumpmap",
        "t": bumps,
        "scale": 0.05,
        "b": {"type": "roughconductor", "alpha": 0.3, "specular_reflectance": rgb(0.9, 0.6, 0.3)},
    }
    bent = {"type": "normalmap", "normalmap": normals, "b": diffuse(0.2, 0.6, 0.3)}
    blend = {"type": "blendbsdf", "weight": 0.4, "a": inner, "b": bent}
    return {"type": "mask", "opacity": 0.7, "b": {"type": "twosided", "b": blend}}


def cloud(*albedo: float) -> dict[str, Any]:
    return {"type": "homogeneous", "albedo": rgb(*(albedo or (0.8, 0.5, 0.3))), "sigma_t": 2.0}


def boundary(x: float, medium: dict[str, Any]) -> dict[str, Any]:
    return ball(x, bsdf={"type": "null"}, interior=medium)


def grid() -> dict[str, Any]:
    values = np.random.default_rng(3).uniform(0.5, 3, (4, 4, 4, 1)).astype(np.float32)
    place = to().translate([-2, -1, -1]).scale([4, 2, 2])
    return {
        "type": "heterogeneous",
        "sigma_t": {"type": "gridvolume", "grid": mi.VolumeGrid(values), "raw": True, "to_world": place},
        "albedo": {"type": "constvolume", "value": rgb(0.8, 0.5, 0.3)},
    }


def merged() -> dict[str, Any]:
    cubes = {
        f"part_{k}": {
            "type": "cube",
            "to_world": to().translate([k - 0.5, 0, 0]).scale(0.3),
            "bsdf": {"type": "ref", "id": "paint"},
        }
        for k in (0, 1)
    }
    return {"paint": {"id": "paint", **diffuse()}, "both": {"type": "merge", **cubes}}


# name -> (objects of the scene, {a part of a key: factor of its change})
CONTAINERS: dict[str, tuple[Callable[[], dict[str, Any]], dict[str, float]]] = {
    "child of a shape group": (lambda: instances(ball(bsdf=diffuse())), {"group.": 0.6, "lamp.": 0.8, "sky.": 1.2}),
    "several children": (
        lambda: instances(
            ball(bsdf=diffuse()),
            {"type": "cube", "to_world": to().translate([0, 0, 0.7]).scale(0.2), "bsdf": diffuse(0.1, 0.8, 0.2)},
        ),
        {"group.part_0": 0.6, "group.part_1": 0.5},
    ),
    "nested BSDFs": (
        lambda: {"ball": ball(bsdf=nested())},
        {"opacity": 0.9, "specular_reflectance": 0.7, "weight": 1.3, "reflectance": 0.6},
    ),
    "nested BSDFs in a group": (
        lambda: instances(ball(bsdf=nested())),
        {"opacity": 0.9, "specular_reflectance": 0.7, "weight": 1.3, "reflectance": 0.6},
    ),
    "mirror in a group": (
        lambda: instances(ball(bsdf={"type": "conductor", "specular_reflectance": rgb(0.9, 0.6, 0.3)})),
        {"specular_reflectance": 0.6},
    ),
    "one BSDF under two shapes": (
        lambda: {
            "paint": {"id": "paint", **diffuse()},
            **{f"ball_{k}": ball(k - 0.5, bsdf={"type": "ref", "id": "paint"}) for k in (0, 1)},
        },
        {"paint.": 0.6},
    ),
    "one BSDF in a group and outside": (
        lambda: {
            "paint": {"id": "paint", **diffuse()},
            **instances(ball(bsdf={"type": "ref", "id": "paint"})),
            "ball": ball(bsdf={"type": "ref", "id": "paint"}),
        },
        {"paint.": 0.6},
    ),
    "one texture under two BSDFs": (
        lambda: {
            "paint": {
                "type": "bitmap",
                "id": "paint",
                "raw": True,
                "bitmap": mi.Bitmap(np.random.default_rng(2).uniform(0.2, 0.9, (4, 4, 3)).astype(np.float32)),
            },
            "matt": ball(-0.6, bsdf={"type": "diffuse", "reflectance": {"type": "ref", "id": "paint"}}),
            "metal": ball(0.6, bsdf={"type": "conductor", "specular_reflectance": {"type": "ref", "id": "paint"}}),
        },
        {"reflectance.data": 0.6},
    ),
    "merged shapes": (merged, {"reflectance": 0.6}),
    "medium in a group": (lambda: instances(boundary(0, cloud())), {"albedo": 0.7, "sigma_t": 0.8}),
    "grid medium in a group": (lambda: instances(boundary(0, grid())), {"albedo": 0.7, "sigma_t": 0.8}),
    "one medium in two shapes": (
        lambda: {
            "fog": {"id": "fog", **cloud()},
            **{f"ball_{k}": boundary(k - 0.5, {"type": "ref", "id": "fog"}) for k in (0, 1)},
        },
        {"albedo": 0.7, "sigma_t": 0.8},
    ),
    "one phase function in two media": (
        lambda: {
            "lobe": {"type": "hg", "id": "lobe", "g": 0.5},
            "ball_0": boundary(-0.6, {**cloud(), "phase": {"type": "ref", "id": "lobe"}}),
            "ball_1": boundary(0.6, {**cloud(0.2, 0.5, 0.9), "phase": {"type": "ref", "id": "lobe"}}),
        },
        {"ball_0.interior_medium.albedo": 0.7, "ball_1.interior_medium.albedo": 0.8},
    ),
}

SHARED = (
    "one BSDF under two shapes",
    "one BSDF in a group and outside",
    "one texture under two BSDFs",
    "merged shapes",
)
"""Those in which one object has several owners, with one parameter that changes."""
