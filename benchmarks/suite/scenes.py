"""Inverse problems of others, at sizes for a processor: scenes under ASSETS, references rendered here."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np

import unrender as ur
from benchmarks.internals import mi
from benchmarks.real_input import run as real_input
from benchmarks.runner.records import scratch

TRAY, PAINTING = "bsdf_tray.base_color.data", "mat-painting_material.brdf_0.base_color.data"
_ALPHA = 0.1
_BASE, _CANVAS = "01_default_BaseColor.png", "Claude_Lorrain_008.jpg"


def _tray(assets: Path, folder: Path, resolution: int, texture: int) -> tuple[str, int]:
    """The lacquered tray of Gu and Moon 2025, its base colour unknown; no normal map and another environment, since theirs is not here."""
    tray = assets / "problems/tray"
    mi.Bitmap(real_input.photograph(tray / "textures" / _BASE, texture)).write(str(folder / "truth.exr"))
    text = (tray / "scene.xml").read_text()
    opening = r'<bsdf type="normalmap" id="bsdf_tray">.*?<bsdf type="principled">'
    text = re.sub(opening, '<bsdf type="principled" id="bsdf_tray">', text, flags=re.DOTALL)
    text = text.replace("</bsdf>\n</bsdf>", "</bsdf>", 1)
    text = text.replace("textures/warm_bar_2k.exr", str(assets / "problems/plates/textures/envmap.exr"))
    text = text.replace('"textures/', f'"{tray}/textures/').replace('"meshes/', f'"{tray}/meshes/')
    for side in ("resx", "resy"):
        text = text.replace(f'name="{side}" value="1024"', f'name="{side}" value="{resolution}"')
    text = text.replace("</film>", '<rfilter type="box"/></film>')
    text = text.replace(f"{tray}/textures/{_BASE}", str(folder / "truth.exr"))
    text = re.sub(r'(truth\.exr" />.*?<boolean name="raw" value=)"false"', r'\1"true"', text, count=1, flags=re.DOTALL)
    (folder / "scene.xml").write_text(text)
    return TRAY, 1


def _painting(assets: Path, folder: Path, resolution: int, texture: int) -> tuple[str, int]:
    """The painting on a wall of Weier et al. 2025 from near and far, its base colour unknown.

    Another environment, and Mitsuba's bitmaps and normal maps in place of the authors' plugins, since theirs are not here.
    """
    painting = assets / "problems/painting/mts_scene"
    mi.Bitmap(real_input.photograph(painting / "textures" / _CANVAS, texture)).write(str(folder / "truth.exr"))
    text = (painting / "painting.xml").read_text()
    nested = r'<texture type="mipmap_flat" name="(\w+)">\s*<texture type="bitmap" name="nested_bitmap">(.*?)</texture>\s*</texture>'
    text = re.sub(nested, r'<texture type="bitmap" name="\1">\2</texture>', text, flags=re.DOTALL)
    text = text.replace("normalmap_flip", "normalmap").replace('<boolean name="safe_flip" value="true"/>', "")
    text = text.replace('<string name="format" value="variant"/>', "")
    text = text.replace(f'value="textures/{_CANVAS}"/>', 'value="truth.exr"/><boolean name="raw" value="true"/>')
    text = text.replace("textures/hotel_room_2k.exr", str(assets / "textures/museum.exr"))
    text = text.replace('"textures/', f'"{painting}/textures/').replace('"meshes/', f'"{painting}/meshes/')
    text = re.sub(r'(name="res[xy]" value=)"1024"', rf'\1"{resolution}"', text)
    (folder / "scene.xml").write_text(text.replace("</film>", '<rfilter type="box"/></film>'))
    return PAINTING, 2


def _numbers(assets: Path, folder: Path, resolution: int, texture: int) -> tuple[dict[str, tuple[float, Any]], int]:
    """The tutorials' cbox.xml as it is, but for its mirror, which is rough: two walls' reflectances and the roughness unknown."""
    del texture
    rough = f'<bsdf type="roughconductor" id="mirror"><float name="alpha" value="{_ALPHA}"/></bsdf>'
    text = real_input.cornell_box(assets, resolution).replace('<bsdf type="conductor" id="mirror"/>', rough)
    (folder / "scene.xml").write_text(text)
    red, green = (
        re.search(rf'id="{name}">\s*<rgb name="reflectance" value="(.*?)"', text) for name in ("red", "green")
    )
    if red is None or green is None:
        raise ur.InputError("cbox.xml: no walls red and green")
    found = {
        f"{name}.reflectance.value": (0.5, [float(x) for x in match[1].split(",")])
        for name, match in (("red", red), ("green", green))
    }
    return {**found, "mirror.alpha.value": (0.3, [_ALPHA])}, 1


SCENES: dict[str, Any] = {**real_input.SCENES, "tray": _tray, "painting": _painting, "numbers": _numbers}
"""Each writes scene.xml, and returns the key of a texture, whose truth it wrote as truth.exr, or {key: (initial, truth)}; and the number of
views."""
LOSSES = {"L1": ur.losses.L1(), "L2": ur.losses.L2()}
DEPTH = 6


def problem(name: str, assets: Path, resolution: int, texture: int, spp: int) -> ur.Problem:
    """The problem of a name such as "cbox, L2"; references of `spp` samples per pixel are rendered by Mitsuba's `path` and kept."""
    scene, loss = name.split(", ")
    folder = scratch(f"suite/{scene}-{resolution}-{texture}")
    folder.mkdir(parents=True, exist_ok=True)
    unknown, views = SCENES[scene](assets.resolve(), folder, resolution, texture)
    kept = folder / f"references-{spp}.npz"
    if not kept.exists():
        loaded, path = mi.load_file(str(folder / "scene.xml")), mi.load_dict({"type": "path", "max_depth": DEPTH})
        parts = max(1, spp // 256)
        images = [
            np.mean(
                [
                    np.array(mi.render(loaded, sensor=view, integrator=path, spp=spp // parts, seed=n))
                    for n in range(parts)
                ],
                0,
            )
            for view in range(views)
        ]
        np.savez(kept, *images)
    with np.load(kept) as found:
        references = [found[f"arr_{view}"].astype(np.float32) for view in range(views)]
    if isinstance(unknown, str):
        unknown = {unknown: (0.5, np.array(mi.Bitmap(str(folder / "truth.exr")))[..., :3])}
    return ur.Problem(
        folder / "scene.xml",
        [ur.Parameter(key, initial=initial) for key, (initial, _) in unknown.items()],
        [ur.View(reference, sensor=view) for view, reference in enumerate(references)],
        loss=LOSSES[loss],
        max_depth=DEPTH,
        truth={key: np.array(truth, np.float32) for key, (_, truth) in unknown.items()},
        name=name,
    )
