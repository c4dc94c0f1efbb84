"""Both images of the pair against separate renders, and our kernel against Mitsuba's `path`, for BSDFs of every kind."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np
import pytest
from zscores import agree

from unrender.rendering.mitsuba_renderer import MitsubaRenderer
from unrender.rendering.port import Shot

SIZE, RUNS, SPP = 24, 32, 16
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
        "floor": {"type": "rectangle", "to_world": to().scale(3), "bsdf": {"type": "diffuse", "reflectance": texture(1)}},
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
    return {"type": "bitmap", "bitmap": mi.Bitmap(np.random.default_rng(3).random((8, 8, 1)).astype(np.float32)), "raw": True}


def normals() -> dict[str, Any]:
    values = np.random.default_rng(4).uniform(0.4, 0.6, (8, 8, 3)).astype(np.float32)
    values[..., 2] = 1
    return {"type": "bitmap", "bitmap": mi.Bitmap(values), "raw": True}


def rough(alpha: float = 0.3) -> dict[str, Any]:
    return {"type": "roughconductor", "alpha": {"type": "bitmap", **{k: v for k, v in texture(7, 1, 0.1, 0.5).items() if k != "type"}}}


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
    "conductor": (lambda: {"type": "conductor", "specular_reflectance": texture(2)}, {"specular_reflectance.data": 0.9}),
    "glass": (
        lambda: {"type": "dielectric", "specular_transmittance": {"type": "rgb", "value": [0.9, 0.8, 0.7]}},
        {"specular_transmittance.value": 0.9},
    ),
    "thin glass": (
        lambda: {"type": "thindielectric", "specular_transmittance": {"type": "rgb", "value": [0.9, 0.8, 0.7]}},
        {"specular_transmittance.value": 0.9},
    ),
    "rough glass": (lambda: {"type": "roughdielectric", "alpha": 0.3, "specular_transmittance": texture(2)}, {"specular_transmittance.data": 0.9}),
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
        lambda: {"type": "mask", "opacity": texture(9, 1, 0.3, 0.8), "b": {"type": "twosided", "b": {"type": "diffuse", "reflectance": texture(2)}}},
        {"opacity.data": 0.9, "nested_bsdf.brdf_0.reflectance.data": 0.9},
    ),
    "blend": (
        lambda: {"type": "blendbsdf", "weight": texture(9, 1), "a": {"type": "diffuse", "reflectance": texture(2)}, "b": rough()},
        {"weight.data": 0.9, "alpha.data": 1.2},
    ),
    "blend with a mirror, unchanged": (
        lambda: {"type": "blendbsdf", "weight": 0.5, "a": {"type": "conductor"}, "b": {"type": "diffuse"}},
        {"floor.bsdf.reflectance.data": 0.9},
    ),
}  # fmt: skip
LIGHTS = {"lamp.emitter.radiance.value": 0.9, "sky.data": 1.1}


def two_states(renderer: MitsubaRenderer, changes: dict[str, float]) -> tuple[dict[str, Any], dict[str, Any]]:
    keys = [key for end in changes for key in renderer.parameters() if key.endswith(end)]
    assert len(keys) == len(changes), f"{changes} -> {keys}"
    current = renderer.values(keys)
    return current, {key: current[key] * factor for key, factor in zip(keys, changes.values())}


def runs(images: tuple[Any, ...]) -> np.ndarray:
    return np.stack([np.array(image) for image in images]).astype(np.float64)


@pytest.mark.parametrize("name", MATERIALS)
def test_both_images_of_the_pair_agree_with_separate_renders(name: str) -> None:
    material, changes = MATERIALS[name]
    renderer = MitsubaRenderer(scene(material()), DEPTH)
    current, previous = two_states(renderer, {**changes, **LIGHTS})
    renderer.select(list(current), "path")
    pair = renderer.image_pair(current, previous, Shot(0, RUNS * SPP, 1, RUNS), "path")
    assert pair.previous is not None
    for state, images, seed in ((current, pair.images, 2), (previous, pair.previous, 3)):
        alone = renderer.image(state, Shot(0, RUNS * SPP, seed, RUNS))
        verdict, figures = agree(runs(images), runs(alone.images))
        assert verdict, figures


@pytest.mark.parametrize("name", MATERIALS)
def test_the_kernel_agrees_with_mitsuba_path(name: str) -> None:
    renderer = MitsubaRenderer(scene(MATERIALS[name][0]()), DEPTH)
    renderer.select(["floor.bsdf.reflectance.data"], None)
    ours = renderer.image(renderer.values(["floor.bsdf.reflectance.data"]), Shot(0, RUNS * SPP, 1, RUNS))
    path = mi.load_dict({"type": "path", "max_depth": DEPTH})
    theirs = [np.array(mi.render(renderer.pair.current, integrator=path, spp=SPP, seed=100 + run)) for run in range(RUNS)]
    verdict, figures = agree(runs(ours.images), np.stack(theirs).astype(np.float64))
    assert verdict, figures


def everything() -> dict[str, Any]:
    """Glass, rough metal, textures and an environment map in one scene."""
    found = scene(MATERIALS["glass"][0]())
    found["ball_2"] = {"type": "sphere", "center": [0.9, -1.2, 0.4], "radius": 0.4, "metal": rough()}
    return found


def test_a_planted_bias_of_one_percent_is_seen() -> None:
    renderer = MitsubaRenderer(everything(), DEPTH)
    changes = {"specular_transmittance.value": 0.9, "alpha.data": 1.2, "floor.bsdf.reflectance.data": 0.9, **LIGHTS}
    current, previous = two_states(renderer, changes)
    renderer.select(list(current), "path")
    count, spp = 64, 64
    pair = renderer.image_pair(current, previous, Shot(0, count * spp, 1, count), "path")
    assert pair.previous is not None
    for state, images, seed in ((current, pair.images, 2), (previous, pair.previous, 3)):
        alone = runs(renderer.image(state, Shot(0, count * spp, seed, count)).images)
        verdict, figures = agree(runs(images), alone)
        assert verdict, figures
        verdict, figures = agree(runs(images) * 1.01, alone)
        assert not verdict, f"a bias of 1 % went unseen: {figures}"


def test_light_that_is_black_now_but_was_not_before_is_not_lost() -> None:
    """Termination and visibility must look at both states."""
    renderer = MitsubaRenderer(scene({"type": "diffuse", "reflectance": texture(2)}, environment=False), DEPTH)
    keys = ["lamp.emitter.radiance.value", "floor.bsdf.reflectance.data"]
    renderer.select(keys, "path")
    previous = renderer.values(keys)
    current = {key: value * 0.0 for key, value in previous.items()}
    pair = renderer.image_pair(current, previous, Shot(0, RUNS * SPP, 1, RUNS), "path")
    assert pair.previous is not None
    assert all(float(np.abs(image).max()) == 0 for image in runs(pair.images))
    alone = renderer.image(previous, Shot(0, RUNS * SPP, 3, RUNS))
    verdict, figures = agree(runs(pair.previous), runs(alone.images))
    assert verdict, figures
