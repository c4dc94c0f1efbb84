"""Small scenes with a few unknown numbers: lamps, lenses, indices of refraction, roughness, fog, skies, poses."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import mitsuba as mi
import numpy as np

import unrender as ur
from unrender.gallery import parts

Scene = dict[str, Any]
Case = tuple[Scene, dict[str, Any], dict[str, Any], float]
"""Scene, truth and start of the unknowns by key, and largest error."""
SIZE = 32
LAMPS = {"lamp0": [-1.0, 1.5, 1.0], "lamp1": [0.2, 1.2, 1.2], "lamp2": [1.1, 1.6, 0.8]}


def camera(kind: str, origin: list[float], **options: Any) -> Scene:
    film = {"type": "hdrfilm", "width": SIZE, "height": SIZE, "rfilter": {"type": "box"}}
    to_world = mi.ScalarTransform4f().look_at(origin, [0, 0, 0], [0, 1, 0])
    return {"type": kind, "fov": 40, "to_world": to_world, "film": film, **options}


def rgb(*values: float) -> Scene:
    return {"type": "rgb", "value": list(values) if len(values) > 1 else float(*values)}


def checkers(scale: float) -> Scene:
    to_uv = mi.ScalarTransform4f().scale([scale, scale, 1])
    return {"type": "diffuse", "reflectance": {"type": "checkerboard", "to_uv": to_uv}}


def floor(bsdf: Scene, height: float, size: float) -> Scene:
    place = mi.ScalarTransform4f().translate([0, height, 0]).rotate([1, 0, 0], -90).scale(size)
    return {"type": "rectangle", "to_world": place, "bsdf": bsdf}


def lamps() -> Case:
    made: Scene = {"type": "scene", "cam": camera("perspective", [0, 3, 5])}
    made["floor"] = floor({"type": "diffuse", "reflectance": rgb(0.6)}, 0.0, 3)
    made["box"] = {"type": "cube", "to_world": mi.ScalarTransform4f().translate([0, 0.3, 0]).scale(0.3)}
    for index, (name, place) in enumerate(LAMPS.items()):
        colour = [4.0 if channel == index else 1.0 for channel in range(3)]
        made[name] = {"type": "point", "position": place, "intensity": rgb(*colour)}
    truth = {f"{name}.position": place for name, place in LAMPS.items()}
    start = {"lamp0.position": [-0.7, 1.2, 1.4], "lamp1.position": [0.0, 1.6, 0.7], "lamp2.position": [0.8, 1.3, 1.2]}
    return made, truth, start, 0.05


def lens() -> Case:
    ball = {"type": "sphere", "radius": 0.5, "bsdf": {"type": "diffuse", "reflectance": rgb(0.5, 0.1, 0.1)}}
    made = {
        "type": "scene",
        "cam": camera("thinlens", [0, 1, 5], aperture_radius=0.3, focus_distance=5.0),
        "floor": floor(checkers(12), -0.6, 5),
        "ball": ball,
        "sky": {"type": "constant"},
    }
    return (
        made,
        {"cam.focus_distance": 5.0, "cam.aperture_radius": 0.3},
        {"cam.focus_distance": 3.5, "cam.aperture_radius": 0.15},
        0.1,
    )


def view() -> Case:
    made = {
        "type": "scene",
        "cam": camera("perspective", [0, 1, 5], principal_point_offset_x=0.05),
        "floor": floor(checkers(12), -0.6, 5),
        "ball": {"type": "sphere", "radius": 0.5, "bsdf": {"type": "diffuse", "reflectance": rgb(0.5, 0.1, 0.1)}},
        "sky": {"type": "constant"},
    }
    truth = {"cam.x_fov": 40.0, "cam.principal_point_offset_x": 0.05}
    return made, truth, {"cam.x_fov": 37.0, "cam.principal_point_offset_x": 0.0}, 0.02


def glass() -> Case:
    back = mi.ScalarTransform4f().translate([0, 0, -2]).scale(3)
    made = {
        "type": "scene",
        "cam": camera("perspective", [0, 0.5, 4]),
        "glass": {"type": "sphere", "bsdf": {"type": "roughdielectric", "alpha": 0.15, "int_ior": 1.6}},
        "back": {"type": "rectangle", "to_world": back, "bsdf": checkers(6)},
        "sky": {"type": "constant"},
    }
    return made, {"glass.bsdf.eta": 1.6}, {"glass.bsdf.eta": 1.3}, 0.02


def polished(bsdf: Scene) -> Scene:
    """Return a ball on a checkered floor, between a lamp and the sky."""
    place = mi.ScalarTransform4f().look_at([-1.5, 3, 1.5], [0, 0, 0], [0, 1, 0]).scale(0.6)
    lamp = {"type": "rectangle", "to_world": place, "emitter": {"type": "area", "radiance": rgb(8.0)}}
    view = camera("perspective", [0, 1.5, 4])
    made = {
        "type": "scene",
        "cam": view,
        "floor": floor(checkers(8), -0.7, 3),
        "lamp": lamp,
        "sky": {"type": "constant"},
    }
    return made | {"ball": {"type": "sphere", "radius": 0.7, "bsdf": bsdf}}


def plastic() -> Case:
    """A roughness and an index of refraction without path gradients, and a colour below."""
    paint = {"type": "roughplastic", "diffuse_reflectance": rgb(0.3, 0.1, 0.1), "alpha": 0.15, "int_ior": 1.7}
    made = polished(paint | {"ext_ior": 1.0})
    alpha, eta, colour = (f"ball.bsdf.{name}" for name in ("alpha", "eta", "diffuse_reflectance.value"))
    return made, {alpha: 0.15, eta: 1.7, colour: [0.3, 0.1, 0.1]}, {alpha: 0.4, eta: 1.3, colour: 0.5}, 0.02


def metal() -> Case:
    """A roughness and a colour with path gradients."""
    made = polished({"type": "roughconductor", "specular_reflectance": rgb(0.9, 0.6, 0.3), "alpha": 0.2})
    truth = {"ball.bsdf.alpha.value": 0.2, "ball.bsdf.specular_reflectance.value": [0.9, 0.6, 0.3]}
    return made, truth, {"ball.bsdf.alpha.value": 0.5, "ball.bsdf.specular_reflectance.value": 0.5}, 0.01


def cut_out() -> Case:
    """A roughness and a colour below an opacity. By path gradients the roughness ran to 0.02, where the picture hardly depends on it."""
    made = polished({"type": "roughconductor", "specular_reflectance": rgb(0.9, 0.6, 0.3), "alpha": 0.25})
    made["ball"]["bsdf"] = {"type": "mask", "opacity": 0.8, "nested": made["ball"]["bsdf"]}
    colour, alpha = (f"ball.bsdf.nested_bsdf.{name}.value" for name in ("specular_reflectance", "alpha"))
    truth = {"ball.bsdf.opacity.value": 0.8, alpha: 0.25, colour: [0.9, 0.6, 0.3]}
    return made, truth, {"ball.bsdf.opacity.value": 0.5, alpha: 0.5, colour: 0.5}, 0.02


def fog() -> Case:
    """An anisotropy, an extinction and an albedo, all with path gradients."""
    made = polished({"type": "null"})
    phase = {"type": "hg", "g": 0.5}
    made["ball"] |= {"interior": {"type": "homogeneous", "sigma_t": 3.0, "albedo": 0.8, "phase": phase}}
    names = ("phase_function.g", "sigma_t.value.value", "albedo.value.value")
    truth, start = (
        {f"ball.interior_medium.{name}": x for name, x in zip(names, values, strict=True)}
        for values in ((0.5, 3.0, 0.8), (0.0, 1.5, 0.5))
    )
    return made, truth, start, 0.5


def sky() -> Case:
    view = camera("perspective", [0, 1, 5])
    view["to_world"] = mi.ScalarTransform4f().look_at([0, -3, 1.5], [0, 0, 0.3], [0, 0, 1])  # the zenith is z
    paint = {"type": "diffuse", "reflectance": rgb(0.6, 0.5, 0.4)}
    made = {
        "type": "scene",
        "cam": view,
        "floor": {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale(3), "bsdf": paint},
        "ball": {"type": "sphere", "center": [0, 0, 0.5], "radius": 0.5},
        "sky": {"type": "sunsky", "turbidity": 3.0, "sun_direction": [0.3, 0.4, 0.86]},
    }
    return made, {"sky.turbidity": 3.0}, {"sky.turbidity": 6.0}, 0.7  # the reference has noise


def sunlight() -> Case:
    """A sun whose start is behind the scene."""
    made, _, _, _ = sky()
    made["floor"]["bsdf"] = checkers(3)
    return made, {"sky.sun_direction": [0.3, 0.4, 0.86]}, {"sky.sun_direction": [-0.8, -0.3, 0.4]}, 3.0  # degrees


def pose() -> Case:
    place = mi.ScalarTransform4f().translate([0.3, 0.35, 0.2]).rotate([0, 1, 0], 25).scale([0.3, 0.35, 0.2])
    walls = {"type": "diffuse", "reflectance": rgb(0.6, 0.5, 0.4)}
    made = {
        "type": "scene",
        "cam": camera("perspective", [0, 2, 4]),
        "floor": floor(walls, 0.0, 2.5),
        "block": {"type": "cube", "to_world": place, "bsdf": {"type": "diffuse", "reflectance": rgb(0.7, 0.3, 0.15)}},
        "sky": {"type": "constant"},
    }
    truth = {"block.translation": [0.0, 0.0, 0.0], "block.rotation.y": 0.0}
    return made, truth, {"block.translation": [0.25, 0.0, -0.2], "block.rotation.y": 0.5}, 0.05


def cone() -> Case:
    """The angles of a spotlight."""
    at = mi.ScalarTransform4f().look_at([0.3, 3.0, 1.0], [0, 0, 0], [1, 0, 0])
    lamp = {"type": "spot", "to_world": at, "intensity": rgb(12.0), "cutoff_angle": 25.0, "beam_width": 15.0}
    box = {"type": "cube", "to_world": mi.ScalarTransform4f().translate([-0.3, 0.35, 0]).scale(0.35)}
    paint = {"type": "diffuse", "reflectance": rgb(0.6)}
    made = {"type": "scene", "cam": camera("perspective", [0, 2.5, 4]), "floor": floor(paint, 0.0, 2), "box": box}
    truth = {"lamp.cutoff_angle": 25.0, "lamp.beam_width": 15.0}
    return made | {"lamp": lamp}, truth, {"lamp.cutoff_angle": 20.0, "lamp.beam_width": 10.0}, 0.1


def principled() -> Case:
    """Nine numbers, of which a picture shows some only weakly."""
    values: dict[str, Any] = {"roughness": 0.3, "metallic": 0.4, "anisotropic": 0.3, "sheen": 0.4, "clearcoat": 0.6}
    made = polished({"type": "principled", "base_color": rgb(0.7, 0.3, 0.1), "specular": 0.6, **values})
    truth = {f"ball.bsdf.{name}.value": x for name, x in {"base_color": [0.7, 0.3, 0.1], **values}.items()}
    return made, truth | {"ball.bsdf.specular": 0.6}, dict.fromkeys(truth, 0.5) | {"ball.bsdf.specular": 0.4}, 0.2


def two_lamps() -> Case:
    """A white and a blue lamp, and the colour of a wall."""
    made = polished({"type": "diffuse", "reflectance": rgb(0.5)})
    side = mi.ScalarTransform4f().look_at([2, 1.5, 1], [0, 0, 0], [0, 1, 0]).scale(0.4)
    blue = {"type": "area", "radiance": rgb(3.0, 5.0, 9.0)}
    back = mi.ScalarTransform4f().translate([0, 0.8, -1.2]).scale(2)
    wall = {"type": "diffuse", "reflectance": rgb(0.7, 0.4, 0.2)}
    made |= {
        "blue": {"type": "rectangle", "to_world": side, "emitter": blue},
        "wall": {"type": "rectangle", "to_world": back, "bsdf": wall},
    }
    lamp, other, colour = "lamp.emitter.radiance.value", "blue.emitter.radiance.value", "wall.bsdf.reflectance.value"
    return made, {lamp: 8.0, other: [3.0, 5.0, 9.0], colour: [0.7, 0.4, 0.2]}, {lamp: 4.0, other: 4.0, colour: 0.5}, 0.3


CASES: dict[str, Callable[[], Case]] = {
    "lamps": lamps,
    "lens": lens,
    "view": view,
    "glass": glass,
    "plastic": plastic,
    "metal": metal,
    "cut-out": cut_out,
    "fog": fog,
    "sky": sky,
    "sunlight": sunlight,
    "pose": pose,
    "cone": cone,
    "principled": principled,
    "two lamps": two_lamps,
}


def _plain_floor() -> dict[str, Any]:
    return parts.rectangle([0, 0, 0], [2, 0, 0], [0, 0, -2], parts.diffuse(0.6, 0.5, 0.4))


def one_lamp() -> tuple[dict[str, Any], dict[str, tuple[Any, Any]]]:
    """Return a point lamp of unknown position between a floor, a wall and a ball."""
    scene = {
        "floor": _plain_floor(),
        "wall": parts.rectangle([0, 1, -1.5], [2, 0, 0], [0, 1, 0], parts.diffuse(0.5)),
        "ball": {"type": "sphere", "center": [0.4, 0.4, 0], "radius": 0.4, "bsdf": parts.diffuse(0.3, 0.5, 0.6)},
        "lamp": {"type": "point", "position": [-0.6, 1.3, 0.5], "intensity": parts.colour(3.0)},
    }
    return scene, {"lamp.position": ([-0.2, 1.6, 0.2], [-0.6, 1.3, 0.5])}


def glass_ball() -> tuple[dict[str, Any], dict[str, tuple[Any, Any]]]:
    """Return a ball of rough glass of unknown index of refraction and roughness between a floor and a sky."""
    bsdf = {"type": "roughdielectric", "alpha": 0.2, "int_ior": 1.5, "ext_ior": 1.0}
    scene = {
        "floor": _plain_floor(),
        "ball": {"type": "sphere", "center": [0, 0.7, 0], "radius": 0.7, "bsdf": bsdf},
        "lamp": parts.rectangle(
            [-1, 2.4, 1.4], [0.5, 0, 0], [0, -0.3, -0.3], parts.diffuse(0.0), emitter=parts.light(6.0, 6.0, 6.0)
        ),
        "sky": {"type": "constant", "radiance": parts.colour(0.4)},
    }
    return scene, {"ball.bsdf.eta": (1.3, 1.5), "ball.bsdf.alpha.value": (0.35, 0.2)}


def sun() -> tuple[dict[str, Any], dict[str, tuple[Any, Any]]]:
    """Return a sun of unknown direction, by two angles, over a ball, a floor and a wall under a sky."""
    sun = {"type": "directional", "direction": [0.5, -1.0, -0.4], "irradiance": parts.colour(2.0)}
    scene = {
        "floor": _plain_floor(),
        "wall": parts.rectangle([0, 1, -1.5], [2, 0, 0], [0, 1, 0], parts.diffuse(0.5)),
        "ball": {"type": "sphere", "center": [-0.2, 0.5, 0], "radius": 0.5, "bsdf": parts.diffuse(0.3, 0.5, 0.6)},
        "sun": sun,
        "sky": {"type": "constant", "radiance": parts.colour(0.4)},
    }
    return scene, {"sun.rotation.x": (0.15, 0.0), "sun.rotation.z": (-0.15, 0.0)}


SMALL = {"lamp": one_lamp, "glass": glass_ball, "sun": sun}
"""Scenes without a sensor, with {key: (start, truth)}, for pictures of few pixels."""


def problem(name: str, spp: int = 2048) -> ur.Problem:
    """Return the problem of a name, with a reference of some samples per pixel."""
    scene, truth, start, _ = CASES[name]()
    path = mi.load_dict({"type": "volpath" if name == "fog" else "path", "max_depth": 6})
    reference = np.array(mi.render(mi.load_dict(scene), integrator=path, spp=spp))
    unknown = [ur.Parameter(key, initial=value) for key, value in start.items()]
    return ur.Problem(lambda: CASES[name]()[0], unknown, [ur.View(reference)], max_depth=6, truth=truth, name=name)
