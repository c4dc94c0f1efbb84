"""Scenes that all sides can express: textures of a principled material, under a known environment map, from several views."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

import unrender as ur
from benchmarks.internals import mi
from benchmarks.suite.scenes import photograph, references, sensors

DEPTH = 5
MATERIAL = "mat-object"
_CHANNELS = {"base_color": "0.5", "roughness": "0.5", "metallic": "0"}
_FOV = 45


@dataclass(frozen=True)
class Cameras:
    """Where pictures are taken from.

    Attributes:
        places: (N, 3).
        target: all look there.
    """

    places: np.ndarray
    target: tuple[float, float, float]

    def xml(self, resolution: int) -> str:
        """The sensors."""
        return sensors(self.places, self.target, _FOV, resolution)


@dataclass(frozen=True)
class Case:
    """A problem as files, for all sides.

    Attributes:
        problem: ours.
        folder: with scene.xml; mipmaps.xml, the same in the form of Weier et al.; references.npz; others.xml and others.npz, of cameras
            that nobody was given. The scenes' textures are the true ones.
        keys: of the unknown textures.
    """

    problem: ur.Problem
    folder: Path
    keys: tuple[str, ...]


def _around(count: int, radius: float, height: float, first: float) -> np.ndarray:
    angle = np.radians(first + 360 * np.arange(count) / count)
    return np.stack([radius * np.sin(angle), np.full(count, height), radius * np.cos(angle)], -1)


def _above(count: int, radius: float, first: float) -> np.ndarray:
    """A spiral over the upper half of a sphere, no lower than 15 degrees above the horizon."""
    height = np.sin(np.radians(15)) + (0.98 - np.sin(np.radians(15))) * (np.arange(count) + 0.5) / count
    angle = np.radians(first) + np.pi * (3 - np.sqrt(5)) * np.arange(count)
    flat = np.sqrt(1 - height**2)
    return radius * np.stack([flat * np.sin(angle), height, flat * np.cos(angle)], -1)


def _spot(assets: Path | None, svbrdf: Path | None, folder: Path, texture: int) -> tuple[str, str, Cameras, Cameras]:
    """Spot, its base colour unknown; four views, and four held out."""
    del svbrdf
    if assets is None:
        raise ur.InputError("spot: give the folder with spot/ and textures/museum.exr by --assets")
    mi.Bitmap(photograph(assets / "spot/spot_texture.png", texture)).write(str(folder / "base_color.exr"))
    views = _around(4, 3.0, 0.8, 30), _around(4, 2.8, 0.3, 10)
    target = (0.0, 0.1, 0.0)
    files = str((assets / "spot/spot.obj").resolve()), str((assets / "textures/museum.exr").resolve())
    return *files, Cameras(views[0], target), Cameras(views[1], target)


def _plane(assets: Path | None, svbrdf: Path | None, folder: Path, texture: int) -> tuple[str, str, Cameras, Cameras]:
    """The toy example of svbrdf_uncertainty, whose files are read from its checkout: base colour, roughness and metallic unknown."""
    del assets
    if svbrdf is None:
        raise ur.InputError("plane: give a checkout of svbrdf_uncertainty by --svbrdf, whose example it is")
    scenes = svbrdf / "experiments/scenes"
    for name in _CHANNELS:
        image = mi.Bitmap(str(scenes / f"plane/textures/{name}.exr"))
        array = np.array(image.convert(component_format=mi.Struct.Type.Float32))
        if array.shape[:2] != (texture, texture):
            raise ur.InputError(f"plane: its textures are {array.shape[0]}²; leave out --texture, or give that")
        image.write(str(folder / f"{name}.exr"))
    views = _above(6, 3.5, 0), _above(4, 3.5, 77)
    target = (0.0, 0.0, 0.0)
    files = str((scenes / "plane/plane.obj").resolve()), str((scenes / "envmaps/matpreview_envmap.exr").resolve())
    return *files, Cameras(views[0], target), Cameras(views[1], target)


SCENES: dict[str, Callable[..., tuple[str, str, Cameras, Cameras]]] = {"spot": _spot, "plane": _plane}
UNKNOWN = {"spot": ("base_color",), "plane": ("base_color", "roughness", "metallic")}


def _material(folder: Path, unknown: tuple[str, ...], mipmaps: bool) -> str:
    def channel(name: str, constant: str) -> str:
        if name not in unknown:
            return f'<float name="{name}" value="{constant}"/>'
        inside = f'<string name="filename" value="{folder / f"{name}.exr"}"/><boolean name="raw" value="true"/>'
        if not mipmaps:
            return f'<texture type="bitmap" name="{name}">{inside}</texture>'
        inside += '<string name="format" value="variant"/>'
        nested = f'<texture type="bitmap" name="nested_bitmap">{inside}</texture>'
        return f'<texture type="mipmap_flat" name="{name}">{nested}</texture>'

    return "".join(channel(name, constant) for name, constant in _CHANNELS.items())


def case(
    name: str, folder: Path, assets: Path | None, svbrdf: Path | None, resolution: int, texture: int, spp: int
) -> Case:
    """Write a problem's files, and open it."""
    folder.mkdir(parents=True, exist_ok=True)
    shape, environment, views, others = SCENES[name](assets, svbrdf, folder, texture)
    for file, cameras, mipmaps in (("scene", views, False), ("mipmaps", views, True), ("others", others, False)):
        (folder / f"{file}.xml").write_text(
            f'<scene version="3.0.0"><bsdf type="principled" id="{MATERIAL}">{_material(folder, UNKNOWN[name], mipmaps)}</bsdf>'
            f'{cameras.xml(resolution)}<emitter type="envmap"><string name="filename" value="{environment}"/></emitter>'
            f'<shape type="obj" id="mesh-object"><string name="filename" value="{shape}"/><ref id="{MATERIAL}"/></shape></scene>'
        )
    pictures = references(folder / "scene.xml", folder / "references.npz", spp, DEPTH)
    references(folder / "others.xml", folder / "others.npz", spp, DEPTH)
    keys = tuple(f"{MATERIAL}.{channel}.data" for channel in UNKNOWN[name])
    truth = mi.traverse(mi.load_file(str(folder / "scene.xml")))
    problem = ur.Problem(
        folder / "scene.xml",
        [ur.Parameter(key, initial=0.5) for key in keys],
        [ur.View(reference, sensor=n) for n, reference in enumerate(pictures)],
        max_depth=DEPTH,
        truth={key: np.array(truth[key], np.float32) for key in keys},
        name=name,
    )
    return Case(problem, folder, keys)
