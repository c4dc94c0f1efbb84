"""The formats of an export, by name: OBJ, PLY and glTF with a script for Blender."""

from __future__ import annotations

import importlib.util
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np

from unrender.app.exporting import textures
from unrender.app.exporting.asset import Asset, Camera, Part
from unrender.core.errors import InputError
from unrender.core.geometry import MITSUBA_TO_OPENGL
from unrender.core.text import did_you_mean, in_words
from unrender.display.pictures import png
from unrender.io import images, mesh_files


def write_obj(asset: Asset, folder: Path) -> None:
    """Write asset.obj, asset.mtl and their maps.

    MTL contains `map_Kd` (base colour, sRGB), `map_Pr` and `map_Pm` (roughness and metallic, linear) and `norm`, from the extension of
    the format for physically based rendering; constants are `Kd`, `Pr`, `Pm` and `Ni`.
    """
    lines, materials = ["# written by unrender", "mtllib asset.mtl"], ["# written by unrender"]
    first = np.zeros(3, int)
    for part in asset.parts:
        counts = [len(part.vertices), 0 if part.uv is None else len(part.uv)]
        counts.append(0 if part.normals is None else len(part.normals))
        lines += [f"o {part.name}", *mesh_files.rows("v", part.vertices)]
        if part.uv is not None:
            lines += mesh_files.rows("vt", mesh_files.upwards(part.uv))
        if part.normals is not None:
            lines += mesh_files.rows("vn", part.normals)
        lines += [f"usemtl {part.name}", *_faces(part, first)]
        first += counts
        materials += _material(part, folder)
    (folder / "asset.obj").write_text("\n".join(lines) + "\n", encoding="utf-8")
    (folder / "asset.mtl").write_text("\n".join(materials) + "\n", encoding="utf-8")


def write_ply(asset: Asset, folder: Path) -> None:
    """Write a binary NAME.ply for each part, with its normals and s, t, and its maps as PNG files."""
    for part in asset.parts:
        content = mesh_files.ply(part.vertices, part.faces, part.normals, part.uv)
        (folder / f"{part.name}.ply").write_bytes(content)
        _maps(part, folder)


def _faces(part: Part, first: np.ndarray) -> list[str]:
    """Return the lines of faces, with indices of vertices, texture coordinates and normals; `first` are the counts that precede this
    part."""
    place = [0, None if part.uv is None else 1, None if part.normals is None else 2]
    start = [None if i is None else int(first[i]) + 1 for i in place]

    def corner(index: int) -> str:
        return "/".join("" if s is None else str(index + s) for s in start).rstrip("/")

    return ["f " + " ".join(corner(index) for index in face) for face in part.faces.tolist()]


def _maps(part: Part, folder: Path) -> dict[str, str]:
    """Write the maps of a part that are not constant; return {map: file name}."""
    material = part.material
    pixels = {
        "base-colour": textures.base_colour(part) if material.base_colour.ndim == 3 else None,
        "roughness": textures.grey(material.roughness) if material.roughness.ndim else None,
        "metallic": textures.grey(material.metallic) if material.metallic.ndim else None,
        "normal": textures.normal_map(part),
    }
    names = {what: f"{part.name}-{what}.png" for what, picture in pixels.items() if picture is not None}
    for what, name in names.items():
        picture = pixels[what]
        if picture is not None:
            (folder / name).write_bytes(png(picture))
    return names


def _material(part: Part, folder: Path) -> list[str]:
    material, maps = part.material, _maps(part, folder)
    colour = [1.0] * 3 if "base-colour" in maps else material.base_colour.tolist()
    lines = [f"newmtl {part.name}", "Kd " + " ".join(f"{x:.6g}" for x in colour)]
    lines += [f"Pr {float(material.roughness):.6g}"] if not material.roughness.ndim else []
    lines += [f"Pm {float(material.metallic):.6g}"] if not material.metallic.ndim else []
    lines += [f"Ni {material.ior:.6g}", "illum 2"] if material.ior > 1 else ["Ks 0 0 0", "illum 1"]
    names = {"base-colour": "map_Kd", "roughness": "map_Pr", "metallic": "map_Pm", "normal": "norm"}
    return lines + [f"{names[what]} {name}" for what, name in maps.items()]


MITSUBA = "mitsuba"


_FLOAT, _UNSIGNED = 5126, 5125
_VERTICES, _INDICES = 34962, 34963
_LINEAR, _MIPMAPS, _CLAMP, _REPEAT = 9729, 9987, 33071, 10497
_KINDS = {1: "SCALAR", 2: "VEC2", 3: "VEC3"}
_USUAL_IOR = 1.5
_ROUNDING = 1e-4


def _check_gltf_installed() -> None:
    if importlib.util.find_spec("pygltflib") is None:
        raise InputError("--format glb needs pygltflib: pip install 'unrender[capture]'")


def glb(asset: Asset) -> bytes:
    """Return the parts of an asset as a .glb file, without light and cameras. Call `Format.check_installed` before."""
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


@dataclass(frozen=True)
class Format:
    """A format: its writer, names of its files, formats that are written with it, and a check that raises `InputError` for a missing
    package."""

    write: Callable[[Asset, Path], None]
    files: tuple[str, ...]
    needs: tuple[str, ...] = ()
    check_installed: Callable[[], None] = lambda: None


def _write_glb(asset: Asset, folder: Path) -> None:
    (folder / "asset.glb").write_bytes(glb(asset))


def _write_environment(asset: Asset, folder: Path) -> None:
    if asset.environment is None:
        return
    for ending in (".exr", ".hdr"):
        images.write(asset.environment, folder / f"environment{ending}")


def _in_folder(name: str, write: Callable[[Asset, Path], None]) -> Callable[[Asset, Path], None]:
    def inside(asset: Asset, folder: Path) -> None:
        (folder / name).mkdir()
        write(asset, folder / name)

    return inside


FORMATS = {
    "glb": Format(_write_glb, ("asset.glb",), check_installed=_check_gltf_installed),
    "obj": Format(_in_folder("obj", write_obj), ("obj",)),
    "ply": Format(_in_folder("ply", write_ply), ("ply",)),
    "environment": Format(_write_environment, ("environment.exr", "environment.hdr")),
    "blender": Format(write_blender_script, (BLENDER_SCRIPT,), ("glb", "environment"), _check_gltf_installed),
}
"""{name: format}, except that of Mitsuba."""
OWN = frozenset(name for known in FORMATS.values() for name in known.files)


def check(formats: Sequence[str]) -> tuple[str, ...]:
    """Return the formats to write and those that they need, once each. Raises `InputError` for an unknown one or a missing package."""
    known = (MITSUBA, *FORMATS)
    if isinstance(formats, str) or not isinstance(formats, Sequence):
        raise InputError(f"--format: expected a list of {', '.join(known)}, got {in_words(formats)}")
    for name in formats:
        if name not in known:
            raise InputError(f"--format {name}: expected {', '.join(known)}{did_you_mean(name, known)}")
    if not formats:
        raise InputError(f"--format: expected one or more of {', '.join(known)}")
    selected = dict.fromkeys(
        each for name in formats for each in (*(FORMATS[name].needs if name in FORMATS else ()), name)
    )
    for name in selected:
        if name in FORMATS:
            FORMATS[name].check_installed()
    return tuple(selected)


def write(asset: Asset, folder: Path, formats: Sequence[str]) -> list[str]:
    """Write the asset in these formats, except that of Mitsuba; return a line for each part that is not exported."""
    notices = list(asset.notices)
    for name in formats:
        if name in FORMATS:
            FORMATS[name].write(asset, folder)
    if asset.environment is None and "environment" in formats:
        notices.append("no environment.exr: no light comes from all around")
    elif "environment" in formats and not np.allclose(asset.environment_to_world, np.eye(3), atol=1e-5):
        notices.append("environment.exr is as the scene's file has it; the scene, and open_in_blender.py, turn it")
    return notices
