"""Materials, each in a small scene of its own and all of them in one, and how their parameters change."""

from __future__ import annotations

from collections.abc import Iterator
from fnmatch import fnmatch
from typing import Any

import mitsuba as mi
import numpy as np

from tiers import quick
from unrender.rendering.mitsuba.renderer import MitsubaRenderer

SIZE = 24
DEPTH = 5


def texture(seed: int, channels: int = 3, low: float = 0.2, high: float = 0.9) -> dict[str, Any]:
    values = np.random.default_rng(seed).uniform(low, high, (8, 8, channels)).astype(np.float32)
    return {"type": "bitmap", "bitmap": mi.Bitmap(values), "raw": True, "filter_type": "bilinear"}


def scene(bsdf: dict[str, Any], environment: bool = True) -> dict[str, Any]:
    """A sphere of the material on a textured floor, an area light, and an environment map."""
    to = mi.ScalarTransform4f
    sky = np.random.default_rng(5).uniform(0.1, 1.5, (8, 16, 3)).astype(np.float32)
    found: dict[str, Any] = {
        "type": "scene",
        "sensor": {
            "type": "perspective",
            "fov": 35,
            "to_world": to().look_at([0, -4, 2.2], [0, 0, 0.55], [0, 0, 1]),
            "film": {"type": "hdrfilm", "width": SIZE, "height": SIZE, "rfilter": {"type": "box"}},
        },
        "floor": {
            "type": "rectangle",
            "to_world": to().scale(3),
            "bsdf": {"type": "diffuse", "reflectance": texture(1)},
        },
        "ball": {"type": "sphere", "center": [0, 0, 0.8], "radius": 0.8, "thing": bsdf},
        "lamp": {
            "type": "rectangle",
            "to_world": to().look_at([1.5, -1, 3], [0, 0, 0], [0, 1, 0]) @ to().scale(0.6),
            "emitter": {"type": "area", "radiance": {"type": "rgb", "value": [9.0, 8.0, 6.0]}},
        },
    }
    if environment:
        found["sky"] = {"type": "envmap", "bitmap": mi.Bitmap(sky)}
    return found


def bumps() -> dict[str, Any]:
    return {
        "type": "bitmap",
        "bitmap": mi.Bitmap(np.random.default_rng(3).random((8, 8, 1)).astype(np.float32)),
        "raw": True,
    }


def normals() -> dict[str, Any]:
    values = np.random.default_rng(4).uniform(0.4, 0.6, (8, 8, 3)).astype(np.float32)
    values[..., 2] = 1
    return {"type": "bitmap", "bitmap": mi.Bitmap(values), "raw": True}


def rough(alpha: float = 0.3) -> dict[str, Any]:
    return {
        "type": "roughconductor",
        "alpha": {"type": "bitmap", **{k: v for k, v in texture(7, 1, 0.1, 0.5).items() if k != "type"}},
    }


# name -> (material, {ending of a key: factor of its change})
MATERIALS: dict[str, tuple[Any, dict[str, float]]] = {
    "diffuse": (lambda: {"type": "diffuse", "reflectance": texture(2)}, {"ball.bsdf.reflectance.data": 0.9}),
    "twosided plastic": (
        lambda: {"type": "twosided", "b": {"type": "plastic", "diffuse_reflectance": texture(2)}},
        {"diffuse_reflectance.data": 0.9},
    ),
    "rough plastic": (
        lambda: {"type": "roughplastic", "diffuse_reflectance": texture(2), "alpha": 0.2},
        {"diffuse_reflectance.data": 0.9},
    ),
    "rough conductor": (rough, {"alpha.data": 1.2}),
    "conductor": (
        lambda: {"type": "conductor", "specular_reflectance": texture(2)},
        {"specular_reflectance.data": 0.9},
    ),
    "glass": (
        lambda: {"type": "dielectric", "specular_transmittance": {"type": "rgb", "value": [0.9, 0.8, 0.7]}},
        {"specular_transmittance.value": 0.9},
    ),
    "thin glass": (
        lambda: {"type": "thindielectric", "specular_transmittance": {"type": "rgb", "value": [0.9, 0.8, 0.7]}},
        {"specular_transmittance.value": 0.9},
    ),
    "rough glass": (
        lambda: {"type": "roughdielectric", "alpha": 0.3, "specular_transmittance": texture(2)},
        {"specular_transmittance.data": 0.9},
    ),
    "principled": (
        lambda: {
            "type": "principled",
            "base_color": texture(2),
            "roughness": texture(6, 1, 0.3, 0.8),
            "metallic": texture(8, 1, 0.1, 0.9),
            "spec_trans": 0.3,
            "clearcoat": 0.4,
            "clearcoat_gloss": 0.4,
        },
        {"base_color.data": 0.9, "roughness.data": 1.1, "metallic.data": 0.9, "spec_trans.value": 1.1},
    ),
    "bumpy": (
        lambda: {"type": "bumpmap", "t": bumps(), "scale": 0.05, "b": rough()},
        {"alpha.data": 1.2},
    ),
    "normal map": (
        lambda: {"type": "normalmap", "normalmap": normals(), "b": {"type": "diffuse", "reflectance": texture(2)}},
        {"nested_bsdf.reflectance.data": 0.9},
    ),
    "mask": (
        lambda: {
            "type": "mask",
            "opacity": texture(9, 1, 0.3, 0.8),
            "b": {"type": "twosided", "b": {"type": "diffuse", "reflectance": texture(2)}},
        },
        {"opacity.data": 0.9, "nested_bsdf.brdf_0.reflectance.data": 0.9},
    ),
    "blend": (
        lambda: {
            "type": "blendbsdf",
            "weight": texture(9, 1),
            "a": {"type": "diffuse", "reflectance": texture(2)},
            "b": rough(),
        },
        {"weight.data": 0.9, "alpha.data": 1.2},
    ),
    "blend with a mirror, unchanged": (
        lambda: {"type": "blendbsdf", "weight": 0.5, "a": {"type": "conductor"}, "b": {"type": "diffuse"}},
        {"floor.bsdf.reflectance.data": 0.9},
    ),
}
LIGHTS = {"lamp.emitter.radiance.value": 0.9, "sky.data": 1.1}


ALL = "all materials"
ROW = 4
"""Balls in a row of the scene that holds all materials."""

# What a test over materials is run for. In the quick tier, one with textures and a rough part; in the long one either the scene of all
# materials, whose kernels take half a minute to compile, where what is compared is compared for each of them (by its tile of the image,
# or by its parameters), or each material alone.
TOGETHER = quick([ALL, "blend"], "blend")
EACH = quick(MATERIALS, "blend")


def subject(name: str) -> tuple[dict[str, Any], dict[str, float]]:
    """The scene of the material `name`, or of all of them, and {pattern of a key: factor of its change}, lights included."""
    if name != ALL:
        material, changes = MATERIALS[name]
        return scene(material()), {**changes, **LIGHTS}
    changes = {}
    for number, (_, each) in enumerate(MATERIALS.values()):
        for end, factor in each.items():
            own = not end.startswith("floor.")
            changes[f"ball_{number}.*{end.removeprefix('ball.')}" if own else end] = factor
    return all_materials(), {**changes, **LIGHTS}


def all_materials() -> dict[str, Any]:
    """A ball of each material, in rows: each in the middle of its tile of SIZE x SIZE pixels."""
    to = mi.ScalarTransform4f
    found = scene({"type": "diffuse"})
    del found["ball"]
    spacing, slope = 2.2, np.sqrt(0.5)  # seen from above, by 45 degrees: rows look nearer to each other than they are
    for number, (material, _) in enumerate(MATERIALS.values()):
        row, column = divmod(number, ROW)
        x, y = spacing * (column - (ROW - 1) / 2), spacing / slope * ((ROW - 1) / 2 - row)
        found[f"ball_{number}"] = {"type": "sphere", "center": [x, y, 0.8], "radius": 0.8, "thing": material()}
    found["floor"]["to_world"] = to().scale(12)
    found["lamp"]["to_world"] = to().look_at([9, -6, 9], [0, 0, 0], [0, 1, 0]) @ to().scale(2.4)
    view = to().look_at([0, -20, 20.8], [0, 0, 0.8], [0, 0, 1]) @ to().scale([spacing * ROW / 2, spacing * ROW / 2, 1])
    film = {**found["sensor"]["film"], "width": ROW * SIZE, "height": ROW * SIZE}
    found["sensor"] = {"type": "orthographic", "to_world": view, "film": film}
    return found


def size(name: str) -> int:
    """Width and height of a subject's image."""
    return ROW * SIZE if name == ALL else SIZE


def spp(name: str) -> int:
    """Samples per pixel of a comparison without noise."""
    return 16 if name == ALL else 64


def tiles(image: np.ndarray) -> Iterator[np.ndarray]:
    """The parts of a subject's image (..., H, W, 3) that show one material each, (..., SIZE, SIZE, 3)."""
    height, width = image.shape[-3:-1]
    for y in range(0, height, SIZE):
        for x in range(0, width, SIZE):
            yield image[..., y : y + SIZE, x : x + SIZE, :]


def everything() -> dict[str, Any]:
    """Glass, rough metal, textures and an environment map in one scene."""
    found = scene(MATERIALS["glass"][0]())
    found["ball_2"] = {"type": "sphere", "center": [0.9, -1.2, 0.4], "radius": 0.4, "metal": rough()}
    return found


def two_states(renderer: MitsubaRenderer, changes: dict[str, float]) -> tuple[dict[str, Any], dict[str, Any]]:
    keys = [key for end in changes for key in renderer.parameters() if fnmatch(key, f"*{end}")]
    assert len(keys) == len(changes), f"{changes} -> {keys}"
    current = renderer.values(keys)
    return current, {key: current[key] * factor for key, factor in zip(keys, changes.values(), strict=True)}
