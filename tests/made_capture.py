"""Captures made for tests: a known mesh seen by known cameras, its pictures traced by Mitsuba, written in the formats that people have.

Cameras are Mitsuba's own `look_at`, lenses OpenCV's; nothing here uses the code that is tested but the class of a lens.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
from PIL import Image
from scipy.spatial.transform import Rotation

from unrender.app.capture.cameras import FISHEYE, Lens

PARTS = 4
"""Rays a side of a pixel."""
# From Mitsuba's axes of a camera (left, up, forwards) to those of the formats.
GL, CV = np.diag([-1.0, 1.0, -1.0, 1.0]), np.diag([-1.0, -1.0, 1.0, 1.0])
LLFF = np.array([[0.0, -1, 0, 0], [-1, 0, 0, 0], [0, 0, -1, 0], [0, 0, 0, 1]])


@dataclass(frozen=True)
class Shot:
    """A camera: its name, Mitsuba's `to_world`, its picture and mask."""

    name: str
    to_world: np.ndarray
    picture: np.ndarray
    mask: np.ndarray


def mesh(path: Path) -> Path:
    """A closed mesh without symmetry, about the point (0.3, -0.2, 0.5), with texture coordinates: an OBJ file."""
    rows, columns = 40, 80
    u, v = np.meshgrid(np.arange(columns + 1) / columns, np.arange(rows + 1) / rows)
    theta, phi = np.pi * v, 2 * np.pi * u
    x, y, z = np.sin(theta) * np.cos(phi), np.cos(theta), np.sin(theta) * np.sin(phi)
    radius = 1 + 0.35 * np.exp(-6 * ((x - 0.8) ** 2 + (y - 0.5) ** 2)) + 0.25 * np.sin(2 * x + 1) * z - 0.2 * y
    points = np.stack([1.1 * x, 0.8 * y, 0.6 * z], -1) * radius[..., None] + [0.3, -0.2, 0.5]
    lines = [f"v {a:.9f} {b:.9f} {c:.9f}" for a, b, c in points.reshape(-1, 3)]
    lines += [f"vt {a:.6f} {b:.6f}" for a, b in np.stack([u, v], -1).reshape(-1, 2)]
    for row in range(rows):
        for column in range(columns):
            a = row * (columns + 1) + column + 1
            b, c, d = a + 1, a + columns + 1, a + columns + 2
            lines += [f"f {a}/{a} {b}/{b} {d}/{d}", f"f {a}/{a} {d}/{d} {c}/{c}"]
    path.write_text("\n".join(lines) + "\n")
    return path


def look_at(azimuth: float, height: float, distance: float = 4.5) -> np.ndarray:
    """Mitsuba's matrix of a camera that looks about the mesh's middle, rolled a little."""
    origin = [0.3 + distance * np.cos(azimuth), -0.2 + height, 0.5 + distance * np.sin(azimuth)]
    transform = mi.ScalarTransform4f().look_at(origin=origin, target=[0.35, -0.1, 0.45], up=[0.1, 1, 0.05])
    return np.array(transform.matrix, float)


def shots(file: Path | None, lens: Lens, count: int = 4, names: Sequence[str] = ()) -> list[Shot]:
    """Pictures of the mesh in a file, from around it; black ones without a file."""
    scene: Any = (
        None
        if file is None
        else mi.load_dict({"type": "scene", "mesh": {"type": file.suffix[1:], "filename": str(file)}})
    )
    found = []
    for index in range(count):
        to_world = look_at(0.4 + 2 * np.pi * index / count, 0.9 * np.sin(1 + 2.3 * index))
        black = np.zeros((lens.height, lens.width, 3), np.float32)
        picture, mask = (black, black[..., :1]) if scene is None else _trace(scene, lens, to_world)
        found.append(Shot(names[index] if names else f"view_{index}", to_world, picture, mask))
    return found


def distorted(lens: Lens, points: np.ndarray) -> np.ndarray:
    """x/z and y/z (N, 2), where a lens has them: OpenCV's formulas written out."""
    a, b = points.T
    r2 = a**2 + b**2
    if lens.model == FISHEYE:
        radius = np.sqrt(np.maximum(r2, 1e-30))
        theta = np.arctan(radius)
        bent = theta * (1 + sum(k * theta ** (2 * n) for n, k in enumerate(lens.distortion, 1)))
        return points * (bent / radius)[:, None]
    if not lens.distortion:
        return points
    k1, k2, p1, p2 = lens.distortion
    radial = 1 + k1 * r2 + k2 * r2**2
    x = a * radial + 2 * p1 * a * b + p2 * (r2 + 2 * a**2)
    y = b * radial + p1 * (r2 + 2 * b**2) + 2 * p2 * a * b
    return np.stack([x, y], 1)


def _trace(scene: Any, lens: Lens, to_world: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Linear colours, normals turned to [0, 1] times 0.8, black outside; and coverage."""
    step = (np.arange(PARTS) + 0.5) / PARTS
    x, y = np.meshgrid(
        (np.arange(lens.width)[:, None] + step).ravel(), (np.arange(lens.height)[:, None] + step).ravel()
    )
    wanted = np.stack([(x - lens.cx) / lens.fx, (y - lens.cy) / lens.fy], -1).reshape(-1, 2)
    normalised = wanted.copy()
    for _ in range(100):
        residual = wanted - distorted(lens, normalised)
        normalised += residual
        if np.abs(residual).max() < 1e-7:
            break
    else:
        raise AssertionError("the lens has no inverse in its picture")
    local = np.stack([-normalised[:, 0], -normalised[:, 1], np.ones(len(normalised))])
    directions = to_world[:3, :3] @ local
    directions /= np.linalg.norm(directions, axis=0)
    origins = np.broadcast_to(to_world[:3, 3:], directions.shape)
    met = scene.ray_intersect(
        mi.Ray3f(mi.Point3f(origins.astype(np.float32)), mi.Vector3f(directions.astype(np.float32)))
    )
    inside = np.array(met.is_valid())
    colour = np.where(inside[:, None], 0.8 * (np.array(met.sh_frame.n).T / 2 + 0.5), 0)
    shape = lens.height, PARTS, lens.width, PARTS, -1
    return tuple(a.reshape(shape).mean((1, 3)).astype(np.float32) for a in (colour, inside.astype(float)))  # pyright: ignore


# ---------------------------------------------------------------------- writing


def srgb_bytes(linear: np.ndarray, levels: int = 255) -> np.ndarray:
    """Encoded by the sRGB curve."""
    encoded = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * np.maximum(linear, 1e-9) ** (1 / 2.4) - 0.055)
    return np.round(np.clip(encoded, 0, 1) * levels)


def save(shots: Sequence[Shot], folder: Path, masks: str | None = "masks") -> None:
    """8-bit PNG files NAME.png in `folder`, and masks in the folder of that name beside it."""
    folder.mkdir(parents=True, exist_ok=True)
    for shot in shots:
        Image.fromarray(srgb_bytes(shot.picture).astype(np.uint8)).save(folder / f"{shot.name}.png")
        if masks:
            place = folder.parent / masks
            place.mkdir(exist_ok=True)
            Image.fromarray((shot.mask[..., 0] * 255 + 0.5).astype(np.uint8)).save(place / f"{shot.name}.png")


def write_transforms(folder: Path, shots: Sequence[Shot], lens: Lens, angle_only: bool = False, **more: Any) -> None:
    """As instant-ngp and nerfstudio; or as NeRF's synthetic scenes, with an angle alone."""
    save(shots, folder / "images")
    document: dict[str, Any] = {"camera_angle_x": 2 * np.arctan(lens.width / (2 * lens.fx))}
    if not angle_only:
        document |= {"fl_x": lens.fx, "fl_y": lens.fy, "cx": lens.cx, "cy": lens.cy, "w": lens.width, "h": lens.height}
        names = ("k1", "k2", "k3", "k4") if lens.model == FISHEYE else ("k1", "k2", "p1", "p2", "k3")
        document |= dict(zip(names, lens.distortion, strict=False))
        document |= {"camera_model": "OPENCV_FISHEYE"} if lens.model == FISHEYE else {}
    document["frames"] = [
        {
            "file_path": f"images/{s.name}" + ("" if angle_only else ".png"),
            "transform_matrix": (s.to_world @ GL).tolist(),
        }
        for s in shots
    ]
    (folder / "transforms.json").write_text(json.dumps(document | more))


def write_llff(folder: Path, shots: Sequence[Shot], lens: Lens, factor: int = 4) -> None:
    """Poses of originals `factor` times as large as the files."""
    save(shots, folder / "images")
    size = np.array([lens.height, lens.width, lens.fx]) * factor
    rows = [np.r_[np.c_[(s.to_world @ LLFF)[:3], size].ravel(), 1.0, 9.0] for s in shots]
    np.save(folder / "poses_bounds.npy", np.array(rows))


def write_colmap(folder: Path, shots: Sequence[Shot], lens: Lens, binary: bool) -> None:
    """In sparse/0, with two points an image, to be read over."""
    save(shots, folder / "images")
    place = folder / "sparse" / "0"
    place.mkdir(parents=True, exist_ok=True)
    pinhole = (lens.fx, lens.fy, lens.cx, lens.cy)
    model, number = (
        ("PINHOLE", 1) if not lens.distorts else ("OPENCV_FISHEYE", 5) if lens.model == FISHEYE else ("OPENCV", 4)
    )
    parameters = (*pinhole, *lens.distortion)
    images = []
    for index, shot in enumerate(shots, 1):
        inverse = np.linalg.inv(shot.to_world @ CV)
        x, y, z, w = Rotation.from_matrix(inverse[:3, :3]).as_quat()
        images.append((index, (w, x, y, z, *inverse[:3, 3]), f"{shot.name}.png"))
    if binary:
        cameras = struct.pack("<QiiQQ", 1, 7, number, lens.width, lens.height) + struct.pack(
            f"<{len(parameters)}d", *parameters
        )
        (place / "cameras.bin").write_bytes(cameras)
        data = struct.pack("<Q", len(images))
        for index, numbers, name in images:
            data += struct.pack("<i7di", index, *numbers, 7) + name.encode() + b"\0"
            data += struct.pack("<QddqddQ", 2, 1.5, 2.5, -1, 3.5, 4.5, 9)
        (place / "images.bin").write_bytes(data)
        return
    text = " ".join(map(repr, map(float, parameters)))
    (place / "cameras.txt").write_text(f"# cameras\n7 {model} {lens.width} {lens.height} {text}\n")
    lines = ["# images"]
    for index, numbers, name in images:
        lines += [
            f"{index} {' '.join(repr(float(n)) for n in numbers)} 7 {name}",
            "1.5 2.5 -1 3.5 4.5 9" if index % 2 else "",
        ]
    (place / "images.txt").write_text("\n".join(lines) + "\n")


Writer = Callable[[Path, Sequence[Shot], Lens], None]
