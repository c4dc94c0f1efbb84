"""Scenes with several lights, and the power of each."""

from __future__ import annotations

from typing import Any

import numpy as np

import unrender as ur
from benchmarks.internals import mi, stock_scene
from unrender.gallery import parts

GREY, WHITE, BLACK = parts.diffuse(0.5), parts.diffuse(0.7), parts.diffuse(0.0)
GALLERY = ("mirror-trio", "chalice", "glossy-room", "caustic")
"""Problems with several emitters."""


def _texture(side: int, value: np.ndarray | float) -> dict[str, Any]:
    pixels = np.broadcast_to(np.asarray(value, np.float32), (side, side, 3)).copy()
    bitmap = {"type": "bitmap", "bitmap": mi.Bitmap(pixels), "raw": True, "format": "variant", "filter_type": "nearest"}
    return {"type": "diffuse", "reflectance": bitmap}


def _picture(side: int) -> np.ndarray:
    return np.random.default_rng(3).uniform(0.1, 0.9, (side, side, 3))


def _lamp(place: Any, half: float, power: float) -> dict[str, Any]:
    """A square that faces down; `power` over its area and π is its radiance."""
    radiance = power / (np.pi * (2 * half) ** 2)
    return parts.rectangle(place, (half, 0, 0), (0, 0, half), BLACK, emitter=parts.light(*[radiance] * 3))


def cells(count: int, resolution: int) -> dict[str, Any]:
    """A row of compartments, each with a lamp of its own on its ceiling, of powers from 1 to 100; the camera sees into two of them. The
    floors of these two are the unknown."""
    random = np.random.default_rng(1)
    scene: dict[str, Any] = {
        "type": "scene",
        "camera": parts.camera((1.0, 0.6, 4.2), (1.0, 0.4, 0.0), 34.0, resolution),
    }
    for cell in range(count):
        x = float(cell)
        scene[f"wall{cell}"] = parts.rectangle((x, 0.5, 0.5), (0, 0, 1), (0, 0.6, 0), parts.twosided(WHITE))
        scene[f"lamp{cell}"] = _lamp((x + 0.5, 0.99, 0.5), 0.1, float(10 ** random.uniform(0, 2)))
    scene[f"wall{count}"] = parts.rectangle((float(count), 0.5, 0.5), (0, 0, 1), (0, 0.6, 0), parts.twosided(WHITE))
    middle = count / 2
    scene["ceiling"] = parts.rectangle((middle, 1.0, 0.5), (middle, 0, 0), (0, 0, 1), WHITE)
    scene["back"] = parts.rectangle((middle, 0.5, -0.5), (middle, 0, 0), (0, 0.5, 0), WHITE)
    scene["ground"] = parts.rectangle((middle, -0.01, 0.5), (middle, 0, 0), (0, 0, -1), GREY)
    scene["floor"] = parts.rectangle((1.0, 0.0, 0.5), (1.0, 0, 0), (0, 0, -1), _texture(32, _picture(32)))
    return scene


def desk(resolution: int) -> dict[str, Any]:
    """A strong lamp under the ceiling, three spots that a screen hides, and a weak one close to the picture that is the unknown."""
    scene: dict[str, Any] = {
        "type": "scene",
        "camera": parts.camera((0, 0.2, 2.1), (0, -0.1, -1), 50.0, resolution),
        **parts.room(WHITE, parts.diffuse(0.6, 0.2, 0.15), parts.diffuse(0.2, 0.5, 0.2)),
        "picture": parts.rectangle((-0.2, -0.4, -0.99), (0.5, 0, 0), (0, 0.4, 0), _texture(32, _picture(32))),
        "screen": parts.rectangle((0.75, -0.3, 0.2), (0, 0, 0.9), (0, 0.7, 0), parts.twosided(GREY)),
        "ceiling-lamp": _lamp((0.2, 0.98, 1.0), 0.25, 40.0),
        "desk-lamp": _lamp((-0.2, 0.15, -0.85), 0.05, 1.5),
    }
    for number, z in enumerate((-0.3, 0.2, 0.7)):
        scene[f"spot{number}"] = _lamp((0.9, 0.1, z), 0.04, 20.0)
    return scene


def window(resolution: int) -> dict[str, Any]:
    """A room with a window to the sky and four lamps: a picture beside the window is the unknown, and the lamps' radiance."""
    scene: dict[str, Any] = {
        "type": "scene",
        "camera": parts.camera((0, 0.1, 2.1), (0, -0.1, -1), 55.0, resolution),
        **parts.room(WHITE, WHITE, parts.diffuse(0.5, 0.4, 0.3)),
        "picture": parts.rectangle((0.1, 0.0, -0.99), (0.6, 0, 0), (0, 0.5, 0), _texture(32, _picture(32))),
        "sky": {"type": "envmap", "bitmap": mi.Bitmap(_sky()), "scale": 2.0},
    }
    del scene["left"]
    for name, centre, right, up in (
        ("below", (-1, -0.6, 0.6), 1.6, 0.4),
        ("above", (-1, 0.8, 0.6), 1.6, 0.2),
        ("far", (-1, 0.2, -0.6), 0.4, 0.4),
        ("near", (-1, 0.2, 1.4), 0.8, 0.4),
    ):
        scene[f"left-{name}"] = parts.rectangle(centre, (0, 0, -right), (0, up, 0), WHITE)
    for number, (x, z) in enumerate(((-0.5, 0.0), (0.5, 0.0), (-0.5, 1.2), (0.5, 1.2))):
        scene[f"lamp{number}"] = _lamp((x, 0.97, z), 0.08, (1.0, 3.0, 6.0, 12.0)[number])
    return scene


def _sky() -> np.ndarray:
    rows = np.linspace(1.0, 0.15, 16, dtype=np.float32)[:, None, None]
    return np.broadcast_to(rows * np.array([0.7, 0.85, 1.0], np.float32), (16, 32, 3)).copy()


OWN: dict[str, tuple[Any, list[str]]] = {
    "cells-8": (lambda side: cells(8, side), ["floor.bsdf.reflectance.data"]),
    "cells-40": (lambda side: cells(40, side), ["floor.bsdf.reflectance.data"]),
    "desk": (desk, ["picture.bsdf.reflectance.data"]),
    "window": (
        window,
        ["picture.bsdf.reflectance.data", *(f"lamp{n}.emitter.radiance.value" for n in range(4))],
    ),
}
"""Made here: scene by resolution, and what is unknown."""


def problem(name: str, resolution: int = 48, reference_spp: int = 2048) -> ur.Problem:
    """One of `OWN`, with the loss L2 and textures of grey at the start, or of the gallery.

    Args:
        name: of the problem.
        resolution: of those made here.
        reference_spp: of their references.
    """
    if name not in OWN:
        return ur.gallery.problem(name, resolution=64, reference_spp=min(reference_spp, 512))
    scene, keys = OWN[name]
    blank = ur.Problem(
        lambda: scene(resolution),
        [ur.Parameter(key) for key in keys],
        [ur.View(np.zeros((resolution, resolution, 3), np.float32))],
        max_depth=5,
        name=name,
    )
    truth = {key: np.array(value) for key, value in blank.initial().items()}
    reference = ur.render(blank, truth, 0, reference_spp, 0)
    starts = [
        ur.Parameter(key, np.full(truth[key].shape, 0.5) if key.endswith("data") else 0.7 * truth[key]) for key in keys
    ]
    return blank.replaced(parameters=starts, views=[ur.View(reference)], truth=truth)


def powers(problem: ur.Problem) -> np.ndarray:
    """The power of each emitter of the scene, in its order, sum 1, (E,): π A L of areas, 4 π I of points, 4 π² r² L of what surrounds a
    scene with the radius r, for means L and I over directions and colours."""
    scene, _ = stock_scene(problem)
    radius = float(np.linalg.norm(np.array(scene.bbox().max) - np.array(scene.bbox().min))) / 2
    found = []
    for emitter in scene.emitters():
        kind, given = emitter.class_name(), mi.traverse(emitter)
        if kind == "AreaLight":
            area = float(np.array(emitter.get_shape().surface_area()).ravel()[0])
            found.append(np.pi * area * _mean(given, "radiance.value"))
        elif kind == "PointLight":
            found.append(4 * np.pi * _mean(given, "intensity.value"))
        else:
            name = "radiance.value" if "radiance.value" in given else "data"
            scale = float(np.array(given["scale"]).ravel()[0]) if "scale" in given else 1.0
            found.append(4 * np.pi**2 * radius**2 * scale * _mean(given, name))
    return np.array(found) / np.sum(found)


def _mean(given: Any, name: str) -> float:
    values = np.array(given[name])
    return float(values[..., :3].mean())
