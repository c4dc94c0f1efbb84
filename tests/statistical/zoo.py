"""Small scenes that hold one material each, and how its parameters change."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np

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


def everything() -> dict[str, Any]:
    """Glass, rough metal, textures and an environment map in one scene."""
    found = scene(MATERIALS["glass"][0]())
    found["ball_2"] = {"type": "sphere", "center": [0.9, -1.2, 0.4], "radius": 0.4, "metal": rough()}
    return found


def two_states(renderer: MitsubaRenderer, changes: dict[str, float]) -> tuple[dict[str, Any], dict[str, Any]]:
    keys = [key for end in changes for key in renderer.parameters() if key.endswith(end)]
    assert len(keys) == len(changes), f"{changes} -> {keys}"
    current = renderer.values(keys)
    return current, {key: current[key] * factor for key, factor in zip(keys, changes.values(), strict=True)}
