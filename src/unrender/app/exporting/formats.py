"""The formats of an export, by name: OBJ and PLY; glTF is in `gltf`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from unrender.app.exporting import gltf, textures
from unrender.app.exporting.asset import Asset, Part
from unrender.core.errors import InputError
from unrender.core.text import did_you_mean
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


@dataclass(frozen=True)
class Format:
    """A format: its writer, names of its files, formats that are written with it, and a check that raises `InputError` for a missing
    package."""

    write: Callable[[Asset, Path], None]
    files: tuple[str, ...]
    needs: tuple[str, ...] = ()
    check_installed: Callable[[], None] = lambda: None


def _write_glb(asset: Asset, folder: Path) -> None:
    (folder / "asset.glb").write_bytes(gltf.glb(asset))


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
    "glb": Format(_write_glb, ("asset.glb",), check_installed=gltf.check_installed),
    "obj": Format(_in_folder("obj", write_obj), ("obj",)),
    "ply": Format(_in_folder("ply", write_ply), ("ply",)),
    "environment": Format(_write_environment, ("environment.exr", "environment.hdr")),
    "blender": Format(gltf.write_blender_script, (gltf.BLENDER_SCRIPT,), ("glb", "environment"), gltf.check_installed),
}
"""{name: format}, except that of Mitsuba."""
OWN = frozenset(name for known in FORMATS.values() for name in known.files)


def check(formats: Sequence[str]) -> tuple[str, ...]:
    """Return the formats to write and those that they need, once each. Raises `InputError` for an unknown one or a missing package."""
    known = (MITSUBA, *FORMATS)
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
