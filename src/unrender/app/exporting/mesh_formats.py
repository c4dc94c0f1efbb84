"""OBJ with its materials, and PLY: v grows upwards in both, as programs that read them take it."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from unrender.app.exporting import textures
from unrender.app.exporting.asset import Asset, Part
from unrender.io import mesh_writing

__all__ = ["write_obj", "write_ply"]


def write_obj(asset: Asset, folder: Path) -> None:
    """asset.obj, asset.mtl and their maps.

    MTL has `map_Kd` (base colour, sRGB), `map_Pr` and `map_Pm` (roughness and metallic, linear) and `norm` of the format's extension for
    physically based rendering; constants as `Kd`, `Pr`, `Pm`, `Ni`.
    """
    lines, materials = ["# written by unrender", "mtllib asset.mtl"], ["# written by unrender"]
    first = np.zeros(3, int)
    for part in asset.parts:
        counts = [len(part.vertices), 0 if part.uv is None else len(part.uv)]
        counts.append(0 if part.normals is None else len(part.normals))
        lines += [f"o {part.name}", *mesh_writing.rows("v", part.vertices)]
        if part.uv is not None:
            lines += mesh_writing.rows("vt", mesh_writing.upwards(part.uv))
        if part.normals is not None:
            lines += mesh_writing.rows("vn", part.normals)
        lines += [f"usemtl {part.name}", *_faces(part, first)]
        first += counts
        materials += _material(part, folder)
    (folder / "asset.obj").write_text("\n".join(lines) + "\n", encoding="utf-8")
    (folder / "asset.mtl").write_text("\n".join(materials) + "\n", encoding="utf-8")


def write_ply(asset: Asset, folder: Path) -> None:
    """NAME.ply for each part, binary, with normals and s, t where it has them, and its maps as PNG files."""
    for part in asset.parts:
        content = mesh_writing.ply(part.vertices, part.faces, part.normals, part.uv)
        (folder / f"{part.name}.ply").write_bytes(content)
        _maps(part, folder)


def _faces(part: Part, first: np.ndarray) -> list[str]:
    """Faces that name vertex, texture coordinate and normal, of which `first` are written already."""
    place = [0, None if part.uv is None else 1, None if part.normals is None else 2]
    start = [None if i is None else int(first[i]) + 1 for i in place]

    def corner(index: int) -> str:
        return "/".join("" if s is None else str(index + s) for s in start).rstrip("/")

    return ["f " + " ".join(corner(index) for index in face) for face in part.faces.tolist()]


def _maps(part: Part, folder: Path) -> dict[str, str]:
    """Write the maps of a part, those that are no constants: {what: file name}."""
    given = part.material
    pixels = {
        "base-colour": textures.base_colour(part) if given.base_colour.ndim == 3 else None,
        "roughness": textures.grey(given.roughness) if given.roughness.ndim else None,
        "metallic": textures.grey(given.metallic) if given.metallic.ndim else None,
        "normal": textures.normal_map(part),
    }
    found = {what: f"{part.name}-{what}.png" for what, picture in pixels.items() if picture is not None}
    for what, name in found.items():
        picture = pixels[what]
        if picture is not None:
            (folder / name).write_bytes(textures.png(picture))
    return found


def _material(part: Part, folder: Path) -> list[str]:
    given, maps = part.material, _maps(part, folder)
    colour = [1.0] * 3 if "base-colour" in maps else given.base_colour.tolist()
    lines = [f"newmtl {part.name}", "Kd " + " ".join(f"{x:.6g}" for x in colour)]
    lines += [f"Pr {float(given.roughness):.6g}"] if not given.roughness.ndim else []
    lines += [f"Pm {float(given.metallic):.6g}"] if not given.metallic.ndim else []
    lines += [f"Ni {given.ior:.6g}", "illum 2"] if given.ior > 1 else ["Ks 0 0 0", "illum 1"]
    names = {"base-colour": "map_Kd", "roughness": "map_Pr", "metallic": "map_Pm", "normal": "norm"}
    return lines + [f"{names[what]} {name}" for what, name in maps.items()]
