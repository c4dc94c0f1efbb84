"""`transforms.json` of NeRF, instant-ngp and nerfstudio, and `transforms_train.json` with `transforms_test.json`.

A frame has `file_path` (with or without extension, relative to the file) and `transform_matrix`: camera to world, axes right, up,
backwards. Intrinsics are at the top level or in a frame, which takes precedence: `fl_x`, `fl_y`, `cx`, `cy`, `w`, `h` in pixels,
`camera_angle_x` in radians without `fl_x`; OpenCV's `k1`, `k2`, `p1`, `p2`, `k3`, or `k1` to `k4` of a fisheye (`camera_model` =
"OPENCV_FISHEYE", or `is_fisheye`). Stanford-ORB and Synthetic4Relight use the second form, with masks in the locations of
`files.find_mask`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from unrender.app.capture.cameras import FISHEYE, RADIAL_TANGENTIAL, Lens
from unrender.app.capture.capture import Capture, Photograph, pose
from unrender.app.capture.formats import files
from unrender.core.errors import InputError, prefixed
from unrender.core.text import printable
from unrender.io import bounded_files

ONE, TRAINING, TEST = "transforms.json", "transforms_train.json", "transforms_test.json"
AXES = "opengl"
_LARGEST = 64 << 20
_FISHEYES = ("OPENCV_FISHEYE", "FISHEYE")
_PERSPECTIVES = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "PERSPECTIVE")


def recognise(folder: Path) -> bool:
    """Return whether a folder has such a file."""
    return any((folder / name).is_file() for name in (ONE, TRAINING))


def read(folder: Path, masks: Path | None = None) -> Capture:
    """Read the capture of such a folder. Raise `InputError`."""
    sources: list[tuple[Path, bool | None]] = [(folder / ONE, None)]
    if not sources[0][0].is_file():
        sources = [(folder / TRAINING, False), (folder / TEST, True)]
    photographs: list[Photograph] = []
    missing: list[str] = []
    count = 0
    for path, held_out in sources:
        if not path.is_file():
            continue
        document = bounded_files.parse_object(bounded_files.read_text(path, _LARGEST), str(path))
        frames = document.get("frames")
        if not isinstance(frames, list) or not frames:
            raise InputError(f"{path}: frames: expected a list of at least one frame")
        count += len(frames)
        files.check_count(count, path)
        for index, frame in enumerate(frames):
            where = f"{path}: frames[{index}]"
            if not isinstance(frame, dict) or not isinstance(frame.get("file_path"), str):
                raise InputError(f"{where}: expected a table with file_path")
            file = files.find_picture(folder, frame["file_path"])
            if file is None:
                missing.append(frame["file_path"])
                continue
            photographs.append(_photograph(folder, file, frame, document, where, masks, held_out))
    notices = files.notices([p.file for p in photographs], missing, count)
    return Capture(folder, "transforms", tuple(photographs), AXES, False, notices)


def _photograph(
    folder: Path,
    file: Path,
    frame: Mapping[str, Any],
    document: Mapping[str, Any],
    where: str,
    masks: Path | None,
    held_out: bool | None,
) -> Photograph:
    named = frame.get("mask_path")
    if named is not None and not isinstance(named, str):
        raise InputError(f"{where}: mask_path: expected a path, got {printable(repr(named)[:60])}")
    numbers = {**document, **frame}
    lens, angle = _lens(numbers, where)
    matrix, scale = pose(frame.get("transform_matrix"), AXES, False, f"{where}: transform_matrix")
    mask = files.find_mask(folder, file, masks, named)
    return Photograph(frame["file_path"], file, lens, matrix, mask, held_out, angle, scale)


def _lens(numbers: Mapping[str, Any], where: str) -> tuple[Lens | None, float]:
    """Return the lens; or None, and the horizontal field of view."""
    model = numbers.get("camera_model", "OPENCV")
    if model not in (*_FISHEYES, *_PERSPECTIVES):
        raise InputError(f"{where}: camera_model: expected OPENCV, OPENCV_FISHEYE or PINHOLE, got {str(model)[:60]!r}")
    fisheye = model in _FISHEYES or bool(numbers.get("is_fisheye", False))
    k = [_number(numbers, f"k{index}", where, 0.0) for index in range(1, 5)]
    p = [_number(numbers, f"p{index}", where, 0.0) for index in range(1, 3)]
    if not fisheye and k[3]:
        raise InputError(f"{where}: k4: programs differ in its meaning for a camera_model {model}; expected 0")
    distortion = tuple(k) if fisheye else (k[0], k[1], *p, k[2])
    if "fl_x" not in numbers:
        if any(distortion) or fisheye:
            raise InputError(f"{where}: fl_x: missing, expected the focal length in pixels of a lens with distortion")
        angle = _number(numbers, "camera_angle_x", where)
        if not 0 < angle < math.pi:
            raise InputError(f"{where}: camera_angle_x: expected radians from 0 to π, got {angle:g}")
        if not {"w", "h"} <= set(numbers) and not {"cx", "cy"} & set(numbers):
            return None, angle
        width, height = (round(_number(numbers, name, where)) for name in ("w", "h"))
        try:
            lens = Lens.of_field_of_view(angle, width, height)
            cx, cy = (_number(numbers, name, where, side / 2) for name, side in (("cx", width), ("cy", height)))
            return replace(lens, cx=cx, cy=cy), angle
        except InputError as error:
            raise InputError(f"{where}: {str(error).removeprefix(f'{where}: ')}") from error
    fx = _number(numbers, "fl_x", where)
    fy = _number(numbers, "fl_y", where, fx)
    width, height = (round(_number(numbers, name, where)) for name in ("w", "h"))
    cx, cy = _number(numbers, "cx", where, width / 2), _number(numbers, "cy", where, height / 2)
    with prefixed(where):
        return Lens(width, height, fx, fy, cx, cy, FISHEYE if fisheye else RADIAL_TANGENTIAL, distortion), 0.0


def _number(numbers: Mapping[str, Any], name: str, where: str, default: float | None = None) -> float:
    value = numbers.get(name, default)
    if value is None:
        raise InputError(f"{where}: {name}: missing, expected a number")
    try:
        if isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value):
            return float(value)
    except OverflowError:  # an integer of hundreds of digits
        pass
    raise InputError(f"{where}: {name}: expected a number, got {printable(repr(value)[:60])}")
