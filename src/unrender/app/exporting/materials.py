"""Materials in the model of other programs: base colour, roughness, metallic, normal map.

Mitsuba's `principled`, glTF's metallic-roughness model and Blender's Principled BSDF share roughness (α = roughness², B. Burley,
"Physically based shading at Disney", 2012), base colour, metallic and an index of refraction. They differ in the diffuse lobe: that of
Mitsuba is Burley's, that of the others Lambert's.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import mitsuba as mi
import numpy as np

from unrender.core.errors import InputError
from unrender.io.images import luminance

MOST_TEXELS = 8192
"""Limit of the width and height of a map in graphics cards and browsers."""
_WRAPPERS = {"TwoSidedBRDF": "brdf_0.", "NormalMap": "nested_bsdf."}
_LEFT_OUT = ("anisotropic", "sheen", "clearcoat", "spec_trans", "spec_tint", "flatness")
_GREY = 0.5
_DIFFUSE, _PLASTICS = "SmoothDiffuse", ("SmoothPlastic", "RoughPlastic")
_NAMES = {
    _DIFFUSE: {"base_colour": "reflectance"},
    **{kind: {"base_colour": "diffuse_reflectance"} for kind in _PLASTICS},
}
"""{class: {attribute of `Material`: slot of the BSDF}}, other than those of `principled`."""


@dataclass(frozen=True)
class Material:
    """The exported part of a material.

    Attributes:
        base_colour: linear, (3,) or (H, W, 3).
        roughness, metallic: in [0, 1], () or (H, W).
        normal_map: (H, W, 3) in [0, 1], 0.5 + 0.5 n with n in the frame of ∂p/∂u and the shading normal; None without a normal map.
        ior: index of refraction of the dielectric part; 1 without specular reflection.
        two_sided: whether the back is visible, too.
        to_uv: (3, 3), applied to texture coordinates before a look-up; None for the identity.
    """

    base_colour: np.ndarray
    roughness: np.ndarray
    metallic: np.ndarray
    normal_map: np.ndarray | None
    ior: float
    two_sided: bool
    to_uv: np.ndarray | None = None

    @property
    def textured(self) -> bool:
        """True if the material has a map."""
        return (
            self.base_colour.ndim > 1
            or self.roughness.ndim > 0
            or self.metallic.ndim > 0
            or self.normal_map is not None
        )


def read_material(bsdf: Any) -> tuple[Material, list[str]]:
    """Return the material of a live BSDF, and a line for each property that is not exported.

    Of `plastic` and `roughplastic` the diffuse reflectance, α and the index of refraction are exported. Materials other than these,
    `principled` and `diffuse` become grey. Raises `InputError` if a map is too large, or maps have different `to_uv`.
    """
    values: Any = mi.traverse(bsdf)
    notes: list[str] = []
    kinds = {bsdf.class_name()} | {node.class_name() for node in values.hierarchy if isinstance(node, mi.BSDF)}
    prefix, maps = "", {}
    while (kind := _kind_at(values, bsdf, prefix)) in _WRAPPERS:
        if kind == "NormalMap":
            maps["normal_map"] = f"{prefix}normalmap"
        prefix += _WRAPPERS[kind]
    if any(key.startswith("brdf_1.") for key in values.keys()):  # noqa: SIM118
        notes.append("the material of its back is not carried over")
    two_sided = "TwoSidedBRDF" in kinds
    if kind not in ("Principled", _DIFFUSE, *_PLASTICS):
        notes.append(f"a {kind} is not carried over: grey in its place")
        grey = Material(np.full(3, _GREY), np.array(1.0), np.array(0.0), None, 1.0, two_sided)
        return grey, notes
    names = _NAMES.get(kind, _PRINCIPLED)
    maps |= {ours: f"{prefix}{theirs}" for ours, theirs in names.items()}
    values_by_name = {ours: _value(values, key, notes) for ours, key in maps.items()}
    to_uv = _to_uv(values, maps.values())
    if kind == "Principled":
        left_out = [name for name in _LEFT_OUT if _is_used(values, f"{prefix}{name}")]
        notes += [f"{', '.join(left_out)}: not carried over"] if left_out else []
    if kind in _PLASTICS:
        notes.append(f"a {kind} becomes a dielectric with its diffuse reflectance as base colour")
    normal = values_by_name.get("normal_map")
    if normal is not None and normal.ndim != 3:
        normal = None
    return Material(
        _colour(values_by_name["base_colour"], _GREY, notes),
        _roughness(values, prefix)
        if kind in _PLASTICS
        else _number(values_by_name.get("roughness"), 1.0 if kind == _DIFFUSE else 0.5),
        _number(values_by_name.get("metallic"), 0.0),
        None if normal is None else np.clip(normal, 0, 1),
        1.0 if kind == _DIFFUSE else _ior(values, prefix),
        two_sided,
        to_uv,
    ), notes


def _roughness(values: Any, prefix: str) -> np.ndarray:
    """Return the roughness of a plastic: √α, 0 without α."""
    key = f"{prefix}alpha"
    return np.array(math.sqrt(min(float(np.array(values[key]).ravel()[0]), 1.0)) if key in values else 0.0)


_PRINCIPLED = {"base_colour": "base_color", "roughness": "roughness", "metallic": "metallic"}


def _kind_at(values: Any, bsdf: Any, prefix: str) -> str:
    """Return the class name of the nested BSDF that owns the keys with a prefix."""
    material = bsdf
    for _ in range(prefix.count(".")):
        inner = [node for node, (parent, *_) in values.hierarchy.items() if parent is not None and parent == material]
        material = next((node for node in inner if isinstance(node, mi.BSDF)), material)
    return material.class_name()


def _value(values: Any, key: str, notes: list[str]) -> np.ndarray | None:
    """Return a parameter that is a map (H, W, C), a colour (3,) or a number (1,); None for other parameters."""
    for end in ("data", "value"):
        if f"{key}.{end}" in values:
            value = np.array(values[f"{key}.{end}"], np.float32)
            if end == "data":
                check_size(key.rpartition(".")[2], value)
                return value if value.ndim == 3 else value[..., None]
            return value.ravel()
    name = key.rpartition(".")[2]
    if name != "metallic":
        notes.append(f"{name}: neither a bitmap nor a constant, not carried over")
    return None


def _colour(value: np.ndarray | None, default: float, notes: list[str]) -> np.ndarray:
    if value is None:
        return np.full(3, default, np.float32)
    colour = value[..., :3] if value.shape[-1] >= 3 else np.repeat(value[..., :1], 3, -1)
    if (outside := int(np.sum((colour < 0) | (colour > 1)))) > 0:
        notes.append(f"base colour: {outside} values outside [0, 1] are clipped")
    return np.clip(colour, 0, 1)


def _number(value: np.ndarray | None, default: float) -> np.ndarray:
    if value is None:
        return np.array(default)
    one = (luminance(value[..., :3]) if value.shape[-1] >= 3 else value)[..., 0]
    return np.clip(one, 0, 1)


def _ior(values: Any, prefix: str) -> float:
    """Return the index of refraction of Mitsuba's `principled`: specular = ((η - 1) / (η + 1))² / 0.08; 1.5 by default."""
    if f"{prefix}eta" in values:
        return float(np.array(values[f"{prefix}eta"]).ravel()[0])
    if f"{prefix}specular" in values:
        root = math.sqrt(0.08 * float(np.array(values[f"{prefix}specular"]).ravel()[0]))
        return (1 + root) / (1 - root)
    return 1.5


def _is_used(values: Any, key: str) -> bool:
    value = next((values[f"{key}.{end}"] for end in ("data", "value") if f"{key}.{end}" in values), None)
    return value is not None and float(np.max(np.array(value))) > 0


def _to_uv(values: Any, keys: Any) -> np.ndarray | None:
    """Return the common transformation of the maps. Raises `InputError` if maps have different transformations."""
    matrices = [np.array(values[f"{key}.to_uv"].matrix, float) for key in keys if f"{key}.to_uv" in values]
    matrices = [matrix.reshape(3, 3) for matrix in matrices]
    if any(not np.allclose(matrix, matrices[0]) for matrix in matrices[1:]):
        raise InputError("asset: maps of one material have different to_uv; give them the same")
    return None if not matrices or np.allclose(matrices[0], np.eye(3)) else matrices[0]


def check_size(name: str, pixels: np.ndarray) -> None:
    """Raise `InputError` for a map of more than `MOST_TEXELS` along a side."""
    if max(pixels.shape[:2]) > MOST_TEXELS:
        height, width = pixels.shape[:2]
        raise InputError(f"asset: {name} has {width} x {height} texels, expected at most {MOST_TEXELS} along a side")
