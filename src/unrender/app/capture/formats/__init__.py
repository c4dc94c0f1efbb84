"""Formats of posed photographs: recognition and reading.

| format | files | poses | lens |
|---|---|---|---|
| `transforms` | `transforms.json` (NeRF, instant-ngp, nerfstudio) | camera to world, `opengl` | `fl_x`, `fl_y`, `cx`, `cy`, `w`, `h` |
| | or `transforms_train.json` and `transforms_test.json` (held out) | | or `camera_angle_x`; `k1`, `k2`, `p1`, `p2`, `k3` |
| | | | `k1` to `k4` of `OPENCV_FISHEYE` |
| `colmap` | `cameras`, `images` (`.bin` or `.txt`) | world to camera, `opencv` | all models but `FOV` and the thin prism |
| | in the folder, `sparse/0`, `sparse`, `colmap/sparse/0`, `colmap` | | |
| `llff` | `poses_bounds.npy`; photographs in `images`, by name | camera to world, `llff` | one focal length, centred |
| `lights` | `lights.txt`: one camera under known lights | none | orthographic |

Poses without a photograph, and photographs without a pose, are left out with a note. Masks are looked for in this order: `--masks`;
`mask_path` of a frame; `NAME_mask.png`; a folder such as `train_mask`; `masks` or `mask`; the alpha channel. All photographs have a mask,
or none has. White (above 0.5) is inside.

| topic | convention |
|---|---|
| world | axes, origin and unit of the files, also for `--mesh`; mirrored matrices are refused |
| pixels | from the upper left corner; the centre of the first pixel is (0.5, 0.5) |
| distortion | OpenCV's model, removed on import |
| EXIF rotation | pixels as stored, unless the camera's proportions say otherwise, with a note |
| values | 8 and 16 bits are sRGB (`--response` names another curve); floating point is linear |
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from unrender.app.capture.capture import Capture
from unrender.app.capture.formats import colmap, lights, llff, transforms
from unrender.core.errors import InputError
from unrender.core.text import printable
from unrender.io import bounded_files, confinement

__all__ = ["FORMATS", "LIGHTS", "is_lit", "read"]


@dataclass(frozen=True)
class _Format:
    recognise: Callable[[Path], bool]
    read: Callable[[Path, Path | None], Capture]
    files: str


FORMATS = {
    "transforms": _Format(transforms.recognise, transforms.read, "transforms.json or transforms_train.json"),
    "colmap": _Format(colmap.recognise, colmap.read, "cameras and images (.bin or .txt), here or in sparse/0"),
    "llff": _Format(llff.recognise, llff.read, "poses_bounds.npy"),
}
"""{name: format}, in order of precedence if a folder has several."""

LIGHTS = "lights"
"""Name of the format of `lights`, which has no poses."""


def is_lit(folder: Path, kind: str | None) -> bool:
    """Return whether a folder is to be read as one camera under known lights: `kind` says so, or no other format fits."""
    if kind is not None:
        return kind == LIGHTS and lights.recognise(folder)
    return lights.recognise(folder) and not any(each.recognise(folder) for each in FORMATS.values())


def read(folder: Path, kind: str | None = None, masks: Path | None = None) -> Capture:
    """Read the capture in a folder; of the first format whose files exist if `kind` is None.

    `masks` is a folder of masks named like the photographs; None for masks that the format names or that are next to the photographs.
    Raises `InputError` if the folder does not exist, has none of the formats, or contains unreadable files.
    """
    for place, name in ((folder, "FOLDER"), (masks, "--masks")):
        if place is not None and bounded_files.kind(place) != "folder":
            problem = "not a folder" if bounded_files.exists(place) else "no such folder"
            raise InputError(f"{place}: {problem}" if name == "FOLDER" else f"{name} {place}: {problem}")
    if kind == LIGHTS:
        raise InputError(f"{folder}: not in the format {LIGHTS}: expected {lights.FILE}")
    if kind is not None and kind not in FORMATS:
        raise InputError(f"--format {kind}: expected one of {', '.join((*FORMATS, LIGHTS))}")
    for name, each in FORMATS.items():
        if kind in (None, name) and each.recognise(folder):
            capture = each.read(folder, masks)
            if not capture.photographs:
                first = "".join(capture.notices).partition(", the first")
                raise InputError(f"{folder}: all of its photographs are missing{''.join(first[1:])}")
            _check(capture, masks)
            return _each_once(capture)
    if kind is not None:
        raise InputError(f"{folder}: not in the format {kind}: expected {FORMATS[kind].files}")
    raise InputError(
        f"{folder}: no camera poses: expected {'; '.join([*(each.files for each in FORMATS.values()), lights.FILE])}"
    )


def _each_once(capture: Capture) -> Capture:
    """Return the capture with each file once, and held out if it is so anywhere: evaluation must not see what the run has."""
    unique = {each.file.resolve(): each for each in sorted(capture.photographs, key=lambda each: bool(each.held_out))}
    if not (twice := len(capture.photographs) - len(unique)):
        return capture
    notice = f"{twice} of {len(capture.photographs)} photographs are listed again and were skipped"
    kept = {id(each) for each in unique.values()}
    photographs = tuple(each for each in capture.photographs if id(each) in kept)
    return replace(capture, photographs=photographs, notices=(*capture.notices, notice))


def _check(capture: Capture, masks: Path | None) -> None:
    """Raise `InputError` if a photograph or a mask is outside the capture's folder (masks may also be in `masks`), a photograph is listed
    with two poses, or two photographs share a mask."""
    cameras: dict[Path, np.ndarray] = {}
    owners: dict[Path, Path] = {}
    for photograph in capture.photographs:
        file, mask, pose = photograph.file, photograph.mask, photograph.camera_to_world
        confinement.check(file, [capture.folder], f"{capture.folder}: it names the photograph")
        if not np.array_equal(cameras.setdefault(file.resolve(), pose), pose):
            raise InputError(
                f"{capture.folder}: {printable(photograph.name)}: listed twice, with different poses; expected one pose"
            )
        if mask is None:
            continue
        places = [capture.folder] if masks is None else [capture.folder, masks]
        confinement.check(mask, places, f"{capture.folder}: it names the mask")
        if (other := owners.setdefault(mask.resolve(), file)) != file:
            two = f"{printable(str(other))} and {printable(str(file))}"
            raise InputError(
                f"{mask}: shared by two photographs, {two}; put masks into folders like those of the photographs"
            )
