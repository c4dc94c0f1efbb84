"""Inverse problems of others, at sizes for a processor: scenes under ASSETS, references rendered here."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
from skimage.transform import resize

import unrender as ur
from benchmarks.internals import mi
from benchmarks.runner.records import scratch

TRAY, PAINTING = "bsdf_tray.base_color.data", "mat-painting_material.brdf_0.base_color.data"
_ALPHA = 0.1
TEXTURE = 128
_BASE, _CANVAS = "01_default_BaseColor.png", "Claude_Lorrain_008.jpg"


def photograph(path: Path, size: int = TEXTURE) -> np.ndarray:
    """A photograph as linear float32 (size, size, 3)."""
    bitmap = mi.Bitmap(str(path)).convert(mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.Float32, srgb_gamma=False)
    small: Any = resize(np.array(bitmap), (size, size, 3), anti_aliasing=True)
    return np.clip(small, 0.02, 0.95).astype(np.float32)


def scene_text(file: Path) -> str:
    """Return the text of a scene file, its names of textures and meshes absolute."""
    text = file.read_text()
    for kind in ("textures", "meshes"):
        text = text.replace(f'"{kind}/', f'"{file.parent / kind}/')
    return text


def cornell_box(assets: Path, resolution: int) -> str:
    """The tutorials' cbox.xml, with pixels whose samples are their own."""
    text = scene_text(assets / "tutorials/cbox.xml")
    text = text.replace('name="res" value="256"', f'name="res" value="{resolution}"')
    return text.replace('<rfilter type="tent"/>', '<rfilter type="box"/>')


def cbox(assets: Path, folder: Path, resolution: int, texture: int = TEXTURE) -> tuple[str, int]:
    """The Cornell box, its back wall with texture coordinates and a photograph."""
    mi.Bitmap(photograph(assets / "tutorials/textures/flower_photo.jpeg", texture)).write(str(folder / "truth.exr"))
    wall = (assets / "tutorials/meshes/cbox_back.obj").read_text()
    wall = wall.replace("f 1 2 3 4", "vt 1 0\nvt 1 1\nvt 0 1\nvt 0 0\nf 1/1 2/2 3/3 4/4")
    (folder / "back.obj").write_text(wall)
    paper = (
        '<bsdf type="diffuse"><texture type="bitmap" name="reflectance"><string name="filename" value="truth.exr"/>'
        '<boolean name="raw" value="true"/></texture></bsdf>'
    )
    back = f'<shape type="obj" id="back"><string name="filename" value="back.obj"/>{paper}</shape>'
    box = cornell_box(assets, resolution)
    (folder / "scene.xml").write_text(re.sub(r'<shape type="obj" id="back">.*?</shape>', back, box, flags=re.DOTALL))
    return "back.bsdf.reflectance.data", 1


def sensors(places: Any, target: tuple[float, ...], fov: float, resolution: int) -> str:
    """Cameras at places (N, 3) that look at a target, with pixels whose samples are their own."""
    at = ", ".join(map(str, target))
    return "".join(
        f'<sensor type="perspective" id="camera_{n}"><float name="fov" value="{fov}"/><transform name="to_world">'
        f'<lookat origin="{", ".join(f"{x:.5f}" for x in place)}" target="{at}" up="0, 1, 0"/></transform>'
        f'<film type="hdrfilm"><integer name="width" value="{resolution}"/><integer name="height" value="{resolution}"/>'
        '<string name="pixel_format" value="rgb"/><rfilter type="box"/></film></sensor>'
        for n, place in enumerate(places)
    )


def spot(assets: Path, folder: Path, resolution: int, texture: int = TEXTURE) -> tuple[str, int]:
    """Spot under an environment map, four cameras around it."""
    mi.Bitmap(photograph(assets / "spot/spot_texture.png", texture)).write(str(folder / "truth.exr"))
    angles = np.radians([30, 120, 210, 300])
    places = np.stack([3 * np.sin(angles), np.full(4, 0.7), 3 * np.cos(angles)], -1)
    cameras = sensors(places, (0, 0.1, 0), 40, resolution)
    (folder / "scene.xml").write_text(
        f'<scene version="3.0.0">{cameras}<emitter type="envmap"><string name="filename" '
        f'value="{assets / "textures/museum.exr"}"/></emitter><shape type="obj" id="spot"><string name="filename" '
        f'value="{assets / "spot/spot.obj"}"/><bsdf type="diffuse"><texture type="bitmap" name="reflectance">'
        f'<string name="filename" value="truth.exr"/><boolean name="raw" value="true"/></texture></bsdf></shape></scene>'
    )
    return "spot.bsdf.reflectance.data", 4


def _tray(assets: Path, folder: Path, resolution: int, texture: int) -> tuple[str, int]:
    """The lacquered tray of Gu and Moon 2025, its base colour unknown; no normal map and another environment, since theirs is not here."""
    tray = assets / "problems/tray"
    mi.Bitmap(photograph(tray / "textures" / _BASE, texture)).write(str(folder / "truth.exr"))
    text = scene_text(tray / "scene.xml")
    opening = r'<bsdf type="normalmap" id="bsdf_tray">.*?<bsdf type="principled">'
    text = re.sub(opening, '<bsdf type="principled" id="bsdf_tray">', text, flags=re.DOTALL)
    text = text.replace("</bsdf>\n</bsdf>", "</bsdf>", 1)
    text = text.replace(f"{tray}/textures/warm_bar_2k.exr", str(assets / "problems/plates/textures/envmap.exr"))
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
    mi.Bitmap(photograph(painting / "textures" / _CANVAS, texture)).write(str(folder / "truth.exr"))
    text = scene_text(painting / "painting.xml")
    nested = r'<texture type="mipmap_flat" name="(\w+)">\s*<texture type="bitmap" name="nested_bitmap">(.*?)</texture>\s*</texture>'
    text = re.sub(nested, r'<texture type="bitmap" name="\1">\2</texture>', text, flags=re.DOTALL)
    text = text.replace("normalmap_flip", "normalmap").replace('<boolean name="safe_flip" value="true"/>', "")
    text = text.replace('<string name="format" value="variant"/>', "")
    textures = painting / "textures"
    text = text.replace(f'value="{textures / _CANVAS}"/>', 'value="truth.exr"/><boolean name="raw" value="true"/>')
    text = text.replace(str(textures / "hotel_room_2k.exr"), str(assets / "textures/museum.exr"))
    text = re.sub(r'(name="res[xy]" value=)"1024"', rf'\1"{resolution}"', text)
    (folder / "scene.xml").write_text(text.replace("</film>", '<rfilter type="box"/></film>'))
    return PAINTING, 2


def _numbers(assets: Path, folder: Path, resolution: int, texture: int) -> tuple[dict[str, tuple[float, Any]], int]:
    """The tutorials' cbox.xml as it is, but for its mirror, which is rough: two walls' reflectances and the roughness unknown."""
    del texture
    rough = f'<bsdf type="roughconductor" id="mirror"><float name="alpha" value="{_ALPHA}"/></bsdf>'
    text = cornell_box(assets, resolution).replace('<bsdf type="conductor" id="mirror"/>', rough)
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


def _maps(assets: Path, folder: Path, resolution: int, texture: int) -> tuple[dict[str, tuple[float, Any]], int]:
    """The tray of Gu and Moon 2025 with all that is unknown there: base colour, roughness, metallic."""
    key, views = _tray(assets, folder, resolution, texture)
    found = {key: (0.5, np.array(mi.Bitmap(str(folder / "truth.exr")))[..., :3])}
    text = (folder / "scene.xml").read_text()
    for name, file in (("roughness", "roughness.png"), ("metallic", "01_default_Metallic.png")):
        path = f"{assets}/problems/tray/textures/{file}"
        truth = photograph(Path(path), texture).mean(axis=-1, keepdims=True)
        mi.Bitmap(truth).write(str(folder / f"{name}.exr"))
        opening = rf'({re.escape(path)}" ?/>.*?<boolean name="raw" value=)"false"'
        text = re.sub(opening, r'\1"true"', text, count=1, flags=re.DOTALL).replace(path, str(folder / f"{name}.exr"))
        found[f"bsdf_tray.{name}.data"] = (0.5, truth)
    (folder / "scene.xml").write_text(text)
    return found, views


def _plates(assets: Path, folder: Path, resolution: int, texture: int) -> tuple[dict[str, tuple[float, Any]], int]:
    """The golden plane of Chang et al. 2024, its roughness unknown."""
    plates = assets / "problems/plates"
    truth = photograph(plates / "textures/textured_roughness.jpg", texture).mean(axis=-1, keepdims=True)
    mi.Bitmap(truth).write(str(folder / "truth.exr"))
    text = scene_text(plates / "scene.xml").replace(f"{plates}/textures/textured_roughness.jpg", "truth.exr")
    text = text.replace('name="res" value="1536"', f'name="res" value="{resolution}"')
    (folder / "scene.xml").write_text(text.replace('<rfilter type="gaussian"/>', '<rfilter type="box"/>'))
    return {"plane.bsdf.alpha.data": (0.3, truth)}, 1


def _light(assets: Path, folder: Path, resolution: int, texture: int) -> tuple[dict[str, tuple[float, Any]], int]:
    """Spot, of plastic, under an environment map that is unknown."""
    _, views = spot(assets, folder, resolution, texture)
    text = (folder / "scene.xml").read_text()
    image = np.array(mi.Bitmap(str(assets / "textures/museum.exr")))[..., :3].astype(np.float32)
    truth = np.asarray(resize(image, (texture // 2, texture, 3), anti_aliasing=True), np.float32)
    mi.Bitmap(truth).write(str(folder / "light.exr"))
    text = text.replace(str(assets / "textures/museum.exr"), str(folder / "light.exr"))
    text = text.replace('<emitter type="envmap">', '<emitter type="envmap" id="sky">')
    text = text.replace(
        '<bsdf type="diffuse"><texture', '<bsdf type="roughplastic"><float name="alpha" value="0.1"/><texture'
    )
    text = text.replace('name="reflectance"', 'name="diffuse_reflectance"')
    (folder / "scene.xml").write_text(text)
    key = "sky.data"
    known = np.array(mi.traverse(mi.load_file(str(folder / "scene.xml")))[key])
    return {key: (float(truth.mean()), known)}, views


def _lamps(assets: Path, folder: Path, resolution: int, texture: int) -> tuple[dict[str, tuple[float, Any]], int]:
    """The tutorials' simple.xml, but that its teapot is not black in blue: the intensities of the two lamps above it unknown."""
    del texture
    text = scene_text(assets / "tutorials/simple.xml").replace('value="0.9 0.9 0.0"', 'value="0.9 0.9 0.3"')
    (folder / "scene.xml").write_text(text.replace('name="res" value="256"', f'name="res" value="{resolution}"'))
    return {f"light{n}.intensity.value": (20.0, [100.0, 100.0, 100.0]) for n in (1, 2)}, 1


def _cloud(assets: Path, folder: Path, resolution: int, texture: int) -> tuple[dict[str, tuple[float, Any]], int]:
    """The tutorials' volume.vol under museum.exr, from four sides: its extinction unknown."""
    del texture
    spot(assets, folder, resolution, 8)
    text = (folder / "scene.xml").read_text()
    grid = np.array(mi.VolumeGrid(str(assets / "tutorials/volume.vol")), np.float32)
    grid = grid.reshape(*grid.shape[:3], -1)[..., :1]
    sides = [min(side, 16) for side in grid.shape[:3]]
    truth = np.asarray(resize(grid, (*sides, 1), anti_aliasing=True), np.float32)
    truth *= 4.0 / truth.max()
    mi.VolumeGrid(truth).write(str(folder / "truth.vol"))
    medium = (
        '<medium type="heterogeneous" name="interior"><volume type="gridvolume" name="sigma_t">'
        f'<string name="filename" value="{folder / "truth.vol"}"/><transform name="to_world"><translate x="-0.5" y="-0.5" z="-0.5"/>'
        '<scale value="2"/></transform></volume><float name="albedo" value="0.8"/></medium>'
    )
    cube = f'<shape type="cube" id="box"><bsdf type="null"/>{medium}</shape>'
    text = re.sub(r'<shape type="obj" id="spot">.*?</shape>', cube, text, flags=re.DOTALL)
    (folder / "scene.xml").write_text(text.replace('<float name="fov" value="40"/>', '<float name="fov" value="60"/>'))
    return {"box.interior_medium.sigma_t.data": (0.5, truth)}, 4


SCENES: dict[str, Any] = {
    "cbox": cbox, "spot": spot, "tray": _tray, "maps": _maps, "painting": _painting, "plates": _plates,
    "light": _light, "lamps": _lamps, "cloud": _cloud, "numbers": _numbers,
}  # fmt: skip
"""Each writes scene.xml, and returns the key of a texture, whose truth it wrote as truth.exr, or {key: (initial, truth)}; and the number of
views."""
LOSSES = {"L1": ur.losses.L1(), "L2": ur.losses.L2()}
DEPTH = 6


def references(file: Path, kept: Path, spp: int, depth: int) -> list[np.ndarray]:
    """Pictures of every sensor of a scene, rendered by Mitsuba in parts of at most 256 samples per pixel, and kept in a file."""
    if not kept.exists():
        integrator = "volpath" if "<medium" in file.read_text() else "path"
        scene, path = mi.load_file(str(file)), mi.load_dict({"type": integrator, "max_depth": depth})
        parts = max(1, spp // 256)

        def picture(sensor: int, part: int) -> np.ndarray:
            return np.array(mi.render(scene, sensor=sensor, integrator=path, spp=spp // parts, seed=part))

        sensors = range(len(scene.sensors()))
        np.savez(kept, *(np.mean([picture(sensor, part) for part in range(parts)], 0) for sensor in sensors))
    with np.load(kept) as found:
        return [found[f"arr_{sensor}"].astype(np.float32) for sensor in range(len(found.files))]


def problem(
    name: str, assets: Path | None, resolution: int = 64, texture: int = 64, spp: int = 4096, /, **options: Any
) -> ur.Problem:
    """Return the problem of a name of the gallery, made with `options`, or of another's such as "cbox, L2".

    References of the latter, of `spp` samples per pixel, are rendered by Mitsuba and kept. Raises `InputError` for one without `assets`.
    """
    scene, _, loss = name.partition(", ")
    if loss not in LOSSES:
        return ur.gallery.problem(name, **options)
    if assets is None:
        raise ur.InputError(f"{name}: give --assets, the folder of the scenes of others")
    folder = scratch(f"suite/{scene}-{resolution}-{texture}")
    folder.mkdir(parents=True, exist_ok=True)
    unknown, views = SCENES[scene](assets.resolve(), folder, resolution, texture)
    pictures = references(folder / "scene.xml", folder / f"references-{spp}.npz", spp, DEPTH)
    if isinstance(unknown, str):
        unknown = {unknown: (0.5, np.array(mi.Bitmap(str(folder / "truth.exr")))[..., :3])}
    return ur.Problem(
        folder / "scene.xml",
        [ur.Parameter(key, initial=initial) for key, (initial, _) in unknown.items()],
        [ur.View(reference, sensor=view) for view, reference in enumerate(pictures[:views])],
        loss=LOSSES[loss],
        max_depth=DEPTH,
        truth={key: np.array(truth, np.float32) for key, (_, truth) in unknown.items()},
        name=name,
    )
