"""LLFF's `poses_bounds.npy`: a row of 17 numbers for each picture of `images/`, in the order of their names.

The first 15 are a matrix of 3 x 5: [R | t | (height, width, focal)]. R's columns are the camera's axes down, right, backwards in the
world, and t is its position. The focal length is in pixels of a picture of that height and width; the files may be smaller copies. The
last two numbers, nearest and farthest depth, are not needed. The principal point is centred.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from unrender.app.capture.cameras import Lens
from unrender.app.capture.capture import Capture, Photograph, pose
from unrender.app.capture.formats import files
from unrender.core.errors import InputError, prefixed
from unrender.io import bounded_files

FILE = "poses_bounds.npy"
AXES = "llff"
_LARGEST = 64 << 20
_FOLDERS = ("images", "images_2", "images_4", "images_8")


def recognise(folder: Path) -> bool:
    """Return whether a folder has such a file."""
    return (folder / FILE).is_file()


def read(folder: Path, masks: Path | None = None) -> Capture:
    """Read the capture of such a folder. Raise `InputError`."""
    path = folder / FILE
    rows = bounded_files.read_array(path, _LARGEST)
    if rows.ndim != 2 or rows.shape[1] != 17 or not len(rows) or not np.isfinite(rows).all():
        raise InputError(f"{path}: expected rows of 17 finite numbers, got shape {rows.shape}")
    files.check_count(len(rows), path)
    place = next((folder / name for name in _FOLDERS if files.pictures(folder / name)), folder)
    pictures = files.pictures(place)
    mask_names = {f"{path.stem.removesuffix('_rgb').removesuffix('_rgba')}_mask" for path in pictures}
    pictures = [path for path in pictures if path.stem not in mask_names]
    if len(pictures) != len(rows):
        many = f"{len(rows)} poses, and {place} has {len(pictures)} pictures"
        raise InputError(f"{path}: {many}: they are matched in the order of names, so none may be missing")
    photographs = []
    for index, (row, file) in enumerate(zip(rows.astype(float), pictures, strict=True)):
        where = f"{path}: row {index}"
        matrix = row[:15].reshape(3, 5)
        height, width, focal = (float(number) for number in matrix[:, 4])
        with prefixed(where):
            lens = Lens(round(width), round(height), focal, focal, width / 2, height / 2)
        mask = files.find_mask(folder, file, masks)
        camera_pose, scale = pose(matrix[:, :4], AXES, False, where)
        photographs.append(Photograph(file.name, file, lens, camera_pose, mask, scale=scale))
    return Capture(folder, "llff", tuple(photographs), AXES, False)
