"""glTF 2.0 binary: one file with meshes, materials and maps; and a script that opens it in Blender as Mitsuba renders it.

Khronos Group, "glTF 2.0 specification". Texture coordinates and winding are Mitsuba's own, +Y is up, roughness is perceptual
(α = roughness²). Base colour is sRGB; roughness and metallic are the green and blue channels of one map.
"""

from __future__ import annotations

import importlib.util
import json
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np

from unrender.app.exporting import textures
from unrender.app.exporting.asset import Asset, Camera, Part
from unrender.core.errors import InputError
from unrender.core.geometry import MITSUBA_TO_OPENGL
from unrender.display.pictures import png

_FLOAT, _UNSIGNED = 5126, 5125
_VERTICES, _INDICES = 34962, 34963
_LINEAR, _MIPMAPS, _CLAMP, _REPEAT = 9729, 9987, 33071, 10497
_KINDS = {1: "SCALAR", 2: "VEC2", 3: "VEC3"}
_USUAL_IOR = 1.5
_ROUNDING = 1e-4


def check_installed() -> None:
    """Raise `InputError` if the package that writes glTF is missing."""
    if importlib.util.find_spec("pygltflib") is None:
        raise InputError("--format glb needs pygltflib: pip install 'unrender[capture]'")


def glb(asset: Asset) -> bytes:
    """Return the parts of an asset as a .glb file, without light and cameras. Call `check_installed` before."""
    import pygltflib

    writer = _Writer(pygltflib)
    for part in asset.parts:
        writer.add(part)
    return writer.finish()


class _Writer:
    """A writer that collects the arrays and images of the binary chunk and refers to them from the glTF document."""

    def __init__(self, kit: Any):
        self._kit = kit  # pygltflib, which may be missing
        self._gltf: Any = kit.GLTF2(asset=kit.Asset(version="2.0", generator="unrender"))
        self._blob = bytearray()

    def add(self, part: Part) -> None:
        attributes = self._kit.Attributes(POSITION=self._array(part.vertices, _FLOAT, _VERTICES, bounds=True))
        if part.normals is not None:
            attributes.NORMAL = self._array(part.normals, _FLOAT, _VERTICES)
        if part.uv is not None:
            attributes.TEXCOORD_0 = self._array(part.uv, _FLOAT, _VERTICES)
        indices = self._array(part.faces.reshape(-1, 1), _UNSIGNED, _INDICES)
        primitive = self._kit.Primitive(attributes=attributes, indices=indices, material=self._material(part))
        self._gltf.meshes.append(self._kit.Mesh(name=part.name, primitives=[primitive]))
        self._gltf.nodes.append(self._kit.Node(name=part.name, mesh=len(self._gltf.meshes) - 1))

    def finish(self) -> bytes:
        self._gltf.scenes = [self._kit.Scene(nodes=list(range(len(self._gltf.nodes))))]
        self._gltf.scene = 0
        self._gltf.buffers = [self._kit.Buffer(byteLength=len(self._blob))]
        self._gltf.set_binary_blob(bytes(self._blob))
        return b"".join(self._gltf.save_to_bytes())

    def _view(self, data: bytes, target: int | None = None) -> int:
        self._blob += b"\0" * (-len(self._blob) % 4)
        view = self._kit.BufferView(buffer=0, byteOffset=len(self._blob), byteLength=len(data), target=target)
        self._blob += data
        self._gltf.bufferViews.append(view)
        return len(self._gltf.bufferViews) - 1

    def _array(self, values: np.ndarray, component: int, target: int, bounds: bool = False) -> int:
        stored = np.ascontiguousarray(values, "<f4" if component == _FLOAT else "<u4")
        view = self._view(stored.tobytes(), target)
        kind = _KINDS[stored.shape[1]]
        accessor = self._kit.Accessor(bufferView=view, componentType=component, count=len(stored), type=kind)
        if bounds:
            accessor.min, accessor.max = stored.min(0).tolist(), stored.max(0).tolist()
        self._gltf.accessors.append(accessor)
        return len(self._gltf.accessors) - 1

    def _texture(self, pixels: np.ndarray, part: Part, name: str) -> int:
        view = self._view(png(pixels))
        self._gltf.images.append(self._kit.Image(bufferView=view, mimeType="image/png", name=f"{part.name} {name}"))
        inside = part.uv is not None and part.uv.min() >= 0 and part.uv.max() <= 1
        wrap = _CLAMP if inside else _REPEAT
        self._gltf.samplers.append(self._kit.Sampler(magFilter=_LINEAR, minFilter=_MIPMAPS, wrapS=wrap, wrapT=wrap))
        count = len(self._gltf.samplers) - 1
        self._gltf.textures.append(self._kit.Texture(sampler=count, source=len(self._gltf.images) - 1))
        return len(self._gltf.textures) - 1

    def _material(self, part: Part) -> int:
        source = part.material
        model = self._kit.PbrMetallicRoughness(baseColorFactor=[1.0] * 4, roughnessFactor=1.0, metallicFactor=1.0)
        if source.base_colour.ndim == 3:
            index = self._texture(textures.base_colour(part), part, "base colour")
            model.baseColorTexture = self._kit.TextureInfo(index=index)
        else:
            model.baseColorFactor = [*map(float, source.base_colour), 1.0]
        if source.roughness.ndim or source.metallic.ndim:
            index = self._texture(textures.metallic_roughness(part), part, "metallic roughness")
            model.metallicRoughnessTexture = self._kit.TextureInfo(index=index)
        else:
            model.roughnessFactor, model.metallicFactor = float(source.roughness), float(source.metallic)
        material = self._kit.Material(name=part.name, pbrMetallicRoughness=model, doubleSided=source.two_sided)
        material.alphaCutoff = None  # pygltflib would write it although alphaMode is OPAQUE
        if (normals := textures.normal_map(part)) is not None:
            material.normalTexture = self._kit.NormalMaterialTexture(index=self._texture(normals, part, "normal map"))
        self._extend(material, source.ior)
        self._gltf.materials.append(material)
        return len(self._gltf.materials) - 1

    def _extend(self, material: Any, ior: float) -> None:
        """Add an index of refraction other than 1.5 by Khronos's extensions; viewers without them use 1.5."""
        if abs(ior - _USUAL_IOR) < _ROUNDING:
            return
        name, value = (
            ("KHR_materials_specular", {"specularFactor": 0.0}) if ior <= 1 else ("KHR_materials_ior", {"ior": ior})
        )
        material.extensions = {name: value}
        if name not in self._gltf.extensionsUsed:
            self._gltf.extensionsUsed.append(name)


BLENDER_SCRIPT = "open_in_blender.py"
_TEMPLATE, _PLACE = "open_in_blender.py.txt", '"SETTINGS"'
# The y axis points up in glTF and Mitsuba, the z axis in Blender: its importer maps (x, y, z) to (x, -z, y).
_TO_BLENDER = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
# The map coordinate of a direction (x, y, z) is u = atan2(x, -z) / 2π in Mitsuba, and that of (x, -z, y) is u = 1/2 - atan2(-z, x) / 2π
# in Blender: a quarter more.
_QUARTER = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])


def write_blender_script(asset: Asset, folder: Path) -> None:
    """Write the script to the folder of asset.glb and environment.exr."""
    template = resources.files("unrender.app.exporting").joinpath(_TEMPLATE).read_text(encoding="utf-8")
    text = json.dumps(blender_settings(asset), indent=1, allow_nan=False)
    (folder / BLENDER_SCRIPT).write_text(template.replace(_PLACE, f"json.loads({text!r})"), encoding="utf-8")


def blender_settings(asset: Asset) -> dict[str, Any]:
    """Return the settings of the script: cameras, with the matrices of Blender and lens shifts in units of the sensor width, and the
    rotation of directions before the look-up in the environment map."""
    to_light = _QUARTER @ _TO_BLENDER @ np.linalg.inv(asset.environment_to_world) @ _TO_BLENDER.T
    return {
        "environment": None if asset.environment is None else "environment.exr",
        "environment_rotation": to_light.tolist(),
        "cameras": [_blender_camera(camera) for camera in asset.cameras],
    }


def _blender_camera(camera: Camera) -> dict[str, Any]:
    turned = np.eye(4)
    turned[:3, :3] = _TO_BLENDER
    width, height = camera.size
    return {
        "name": camera.name,
        "matrix": (turned @ camera.to_world @ MITSUBA_TO_OPENGL).tolist(),
        "angle_x": float(np.radians(camera.x_fov)),
        "shift": [camera.offset[0], -camera.offset[1] * height / width],
        "size": [width, height],
        "clip": list(camera.clip),
    }
