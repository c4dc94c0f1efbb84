"""Exports read by other libraries than those that wrote them, as a scene of Mitsuba's plugins.

A .glb file is read by trimesh, an OBJ file's mesh by Mitsuba and its materials here, from the text. What
they say is taken by their formats' own rules: base colours are sRGB, other maps linear; texture coordinates grow downwards in glTF and
upwards in the others; of a normal map, green goes up the picture.
"""

from __future__ import annotations

import importlib
import importlib.util
import io
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
from PIL import Image

__all__ = ["READERS", "Look", "described", "read_glb", "read_obj"]

_DEFAULT_IOR = 1.5


@dataclass(frozen=True)
class Look:
    """A mesh and its material, as a file has them.

    Attributes:
        vertices, normals: (V, 3); `normals` None where faces are flat.
        faces: (F, 3).
        uv: (V, 2), v downwards, (0, 0) the upper left corner; None where there are none.
        base_colour: linear, (H, W, 3) or (3,).
        roughness, metallic: (H, W) or ().
        normal_map: (H, W, 3) in [0, 1], green up the picture; None where there is none.
        ior: index of refraction.
        two_sided: whether it is seen from behind, too.
    """

    vertices: np.ndarray
    faces: np.ndarray
    normals: np.ndarray | None
    uv: np.ndarray | None
    base_colour: np.ndarray
    roughness: np.ndarray
    metallic: np.ndarray
    normal_map: np.ndarray | None
    ior: float
    two_sided: bool


def linear(srgb: np.ndarray) -> np.ndarray:
    """IEC 61966-2-1."""
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)


def _unit(picture: Any, channels: int | None = None) -> np.ndarray:
    pixels = np.asarray(picture, float) / 255
    return pixels if channels is None else pixels[..., :channels]


def read_glb(folder: Path) -> list[Look]:
    """asset.glb."""
    trimesh: Any = importlib.import_module("trimesh")
    content = (folder / "asset.glb").read_bytes()
    scene = trimesh.load(io.BytesIO(content), file_type="glb", process=False)
    found = []
    for mesh in scene.geometry.values():
        look = mesh.visual.material
        factor = np.ones(4) if look.baseColorFactor is None else np.asarray(look.baseColorFactor, float)
        factor = factor / 255 if factor.max() > 1 else factor
        base = factor[:3]
        if look.baseColorTexture is not None:
            base = linear(_unit(look.baseColorTexture, 3)) * base
        roughness, metallic = (np.array(1.0 if x is None else x) for x in (look.roughnessFactor, look.metallicFactor))
        if look.metallicRoughnessTexture is not None:
            packed = _unit(look.metallicRoughnessTexture, 3)
            roughness, metallic = packed[..., 1] * roughness, packed[..., 2] * metallic
        normal = None if look.normalTexture is None else _unit(look.normalTexture, 3)
        uv = None if mesh.visual.uv is None else np.asarray(mesh.visual.uv) * [1, -1] + [0, 1]
        normals = np.asarray(mesh.vertex_normals) if "vertex_normals" in mesh._cache else None
        ior = 1.0 if b"KHR_materials_specular" in content else _DEFAULT_IOR
        found.append(
            Look(
                np.asarray(mesh.vertices),
                np.asarray(mesh.faces),
                normals,
                uv,
                base,
                roughness,
                metallic,
                normal,
                ior,
                bool(look.doubleSided),
            )
        )
    return found


def read_obj(folder: Path) -> list[Look]:
    """obj/asset.obj of one material, with obj/asset.mtl."""
    place = folder / "obj"
    mesh: Any = mi.load_dict({"type": "obj", "filename": str(place / "asset.obj")})
    values: Any = mi.traverse(mesh)
    words = dict(
        line.split(maxsplit=1) for line in (place / "asset.mtl").read_text().splitlines() if " " in line.strip()
    )

    def picture(name: str) -> np.ndarray | None:
        return _unit(Image.open(place / words[name])) if name in words else None

    def number(name: str, key: str, default: float) -> np.ndarray:
        found = picture(name)
        return np.array(float(words.get(key, default))) if found is None else found

    base = picture("map_Kd")
    colour = np.array([float(x) for x in words["Kd"].split()])
    uv = np.array(values["vertex_texcoords"]).reshape(-1, 2) if mesh.has_vertex_texcoords() else None
    return [
        Look(
            np.array(values["vertex_positions"]).reshape(-1, 3),
            np.array(values["faces"]).reshape(-1, 3),
            np.array(values["vertex_normals"]).reshape(-1, 3) if mesh.has_vertex_normals() else None,
            uv,  # Mitsuba turns them downwards as it reads
            colour if base is None else linear(base) * colour,
            number("map_Pr", "Pr", 0.5),
            number("map_Pm", "Pm", 0.0),
            picture("norm"),
            float(words.get("Ni", 1.0)),
            False,
        )
    ]


READERS: dict[str, Callable[[Path], list[Look]]] = {"glb": read_glb, "obj": read_obj}


def described(looks: list[Look], environment: Path, to_world: np.ndarray) -> dict[str, Any]:
    """A scene of what was read, under a picture of light.

    Args:
        looks: its meshes.
        environment: an .exr or .hdr file.
        to_world: (3, 3), from the light's axes to the world's.
    """
    turned = np.eye(4)
    turned[:3, :3] = to_world
    light = {"type": "envmap", "filename": str(environment), "to_world": mi.ScalarTransform4f(turned.tolist())}
    found: dict[str, Any] = {"type": "scene", "light": light}
    for index, look in enumerate(looks):
        for name, chosen in _kinds(look).items():
            if chosen.any():
                found[f"part-{index}-{name}"] = _mesh(look, look.faces[chosen], _bsdf(look, name == "mirrored"))
    return found


def _kinds(look: Look) -> dict[str, np.ndarray]:
    """Faces that lie in the picture as they are seen, and mirrored, where a normal map makes that matter."""
    if look.uv is None or look.normal_map is None:
        return {"plain": np.ones(len(look.faces), bool)}
    corners = look.uv[look.faces]
    one, two = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    mirrored = one[:, 0] * two[:, 1] - one[:, 1] * two[:, 0] > 0
    return {"plain": ~mirrored, "mirrored": mirrored}


def _mesh(look: Look, faces: np.ndarray, bsdf: dict[str, Any]) -> Any:
    props = mi.Properties()
    props["bsdf"] = mi.load_dict(bsdf)
    props["face_normals"] = look.normals is None
    found: Any = mi.Mesh("part", len(look.vertices), len(faces), props, look.normals is not None, look.uv is not None)
    values: Any = mi.traverse(found)
    for key, given in (("positions", look.vertices), ("normals", look.normals), ("texcoords", look.uv)):
        if given is not None:
            values[f"vertex_{key}"] = mi.Float(np.ascontiguousarray(given, np.float32).ravel())
    values["faces"] = mi.UInt32(np.ascontiguousarray(faces, np.uint32).ravel())
    values.update()
    return found


def _bsdf(look: Look, mirrored: bool) -> dict[str, Any]:
    """Mitsuba's second tangent is n × ∂p/∂u, the formats' goes up the picture: opposite where a face lies mirrored in it."""

    def bitmap(pixels: np.ndarray) -> Any:
        if pixels.ndim < 2:
            return float(pixels) if pixels.ndim == 0 else {"type": "rgb", "value": pixels.tolist()}
        pixels = pixels if pixels.ndim == 3 else pixels[..., None]
        data = mi.TensorXf(np.ascontiguousarray(pixels, np.float32))
        return {"type": "bitmap", "data": data, "raw": True, "wrap_mode": "clamp"}

    found: dict[str, Any] = {
        "type": "principled",
        "base_color": bitmap(look.base_colour),
        "roughness": bitmap(look.roughness),
        "metallic": bitmap(look.metallic),
    }
    if abs(look.ior - _DEFAULT_IOR) > 1e-4:
        found["eta"] = max(look.ior, 1.0001)
    if look.normal_map is not None:
        normal = look.normal_map * ([1, -1, 1] if mirrored else 1) + ([0, 1, 0] if mirrored else 0)
        found = {"type": "normalmap", "normalmap": bitmap(normal), "bsdf": found}
    return {"type": "twosided", "bsdf": found} if look.two_sided else found
