"""COLMAP's sparse models: `cameras` and `images`, as text or binary.

A camera has a model, its size and its parameters. An image has a unit quaternion (w, x, y, z) and a translation, which map world points
to the camera (x right, y down, z forwards), and the id of its camera. Positions in pictures are in pixels from the upper left corner:
the centre of the first pixel is (0.5, 0.5). Points of the model are not read.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from unrender.app.capture.cameras import FISHEYE, RADIAL_TANGENTIAL, Lens
from unrender.app.capture.capture import Capture, Photograph, pose
from unrender.app.capture.formats import files
from unrender.core.errors import InputError, prefixed
from unrender.core.text import printable
from unrender.io import bounded_files

AXES = "opencv"
_PLACES = (".", "sparse/0", "sparse", "colmap/sparse/0", "colmap")
_LARGEST = 1 << 31
_LONGEST_NAME = 4096
_PHOTOGRAPHS = ("images", ".", "images_2", "images_4", "images_8", "input")

Numbers = tuple[float, ...]
_Parts = Callable[[Numbers], tuple[Numbers, str, Numbers]]


@dataclass(frozen=True)
class _Model:
    """Camera model: its id in binary files, its number of parameters, and their conversion to (fx, fy, cx, cy), kind, distortion."""

    number: int
    count: int
    parts: _Parts


def _one_focal(kind: str) -> _Parts:
    return lambda p: ((p[0], p[0], p[1], p[2]), kind, p[3:])


def _two_focals(kind: str) -> _Parts:
    return lambda p: (p[:4], kind, p[4:])


MODELS = {
    "SIMPLE_PINHOLE": _Model(0, 3, _one_focal(RADIAL_TANGENTIAL)),
    "PINHOLE": _Model(1, 4, _two_focals(RADIAL_TANGENTIAL)),
    "SIMPLE_RADIAL": _Model(2, 4, _one_focal(RADIAL_TANGENTIAL)),
    "RADIAL": _Model(3, 5, _one_focal(RADIAL_TANGENTIAL)),
    "OPENCV": _Model(4, 8, _two_focals(RADIAL_TANGENTIAL)),
    "OPENCV_FISHEYE": _Model(5, 8, _two_focals(FISHEYE)),
    "FULL_OPENCV": _Model(6, 12, _two_focals(RADIAL_TANGENTIAL)),
    "SIMPLE_RADIAL_FISHEYE": _Model(8, 4, _one_focal(FISHEYE)),
    "RADIAL_FISHEYE": _Model(9, 5, _one_focal(FISHEYE)),
}
"""Camera models that OpenCV supports as well."""
_BY_NUMBER = {model.number: name for name, model in MODELS.items()}


def recognise(folder: Path) -> bool:
    """Return whether a folder has such a model, or a subfolder that COLMAP would create."""
    return _place(folder) is not None


def read(folder: Path, masks: Path | None = None) -> Capture:
    """Read the capture of such a folder. Raise `InputError`."""
    location = _place(folder)
    if location is None:
        raise InputError(f"{folder}: no cameras and images of COLMAP")
    place, ending = location
    cameras_file, images_file = place / f"cameras{ending}", place / f"images{ending}"
    text = ending == ".txt"
    lenses = dict(_text_cameras(cameras_file) if text else _binary_cameras(cameras_file))
    images = sorted(_text_images(images_file) if text else _binary_images(images_file), key=lambda image: image.name)
    files.check_count(len(images), images_file)
    root = next(
        (folder / name for name in _PHOTOGRAPHS if images and files.is_file(folder / name / images[0].name)), None
    )
    if root is None:
        here = next((folder / n for n in _PHOTOGRAPHS if any(files.is_file(folder / n / i.name) for i in images)), None)
        root = here or folder / "images"
    photographs, missing = [], []
    for image in images:
        file = root / image.name
        if not files.is_file(file):
            missing.append(image.name)
            continue
        if image.camera not in lenses:
            raise InputError(f"{images_file}: {printable(image.name)}: no camera {image.camera} in {cameras_file.name}")
        matrix, _ = pose(_matrix(image, images_file), AXES, True, f"{images_file}: {printable(image.name)}")
        mask = files.find_mask(folder, file, masks)
        photographs.append(Photograph(image.name, file, lenses[image.camera], matrix, mask))
    notices = files.notices([p.file for p in photographs], missing, len(images))
    return Capture(folder, "colmap", tuple(photographs), AXES, True, notices)


def _place(folder: Path) -> tuple[Path, str] | None:
    for name in _PLACES:
        for ending in (".bin", ".txt"):
            if all((folder / name / f"{what}{ending}").is_file() for what in ("cameras", "images")):
                return folder / name, ending
    return None


@dataclass(frozen=True)
class _Image:
    name: str
    camera: int
    quaternion: Numbers
    translation: Numbers


def _matrix(image: _Image, path: Path) -> np.ndarray:
    """Return the world-to-camera matrix, (3, 4)."""
    q = np.array(image.quaternion)
    length = float(np.linalg.norm(q))
    if not np.isfinite([length, *image.translation]).all() or abs(length - 1) > 0.01:
        raise InputError(f"{path}: {printable(image.name)}: expected a unit quaternion, got one of length {length:g}")
    w, v = q[0] / length, q[1:] / length
    cross = np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])
    rotation = np.eye(3) + 2 * w * cross + 2 * cross @ cross
    return np.column_stack([rotation, image.translation])


def _lens(model: str, width: int, height: int, parameters: Numbers, where: str) -> Lens:
    if model not in MODELS:
        raise InputError(f"{where}: camera model {printable(model)}: expected one of {', '.join(MODELS)}")
    if len(parameters) != MODELS[model].count:
        raise InputError(f"{where}: {model} has {MODELS[model].count} parameters, got {len(parameters)}")
    pinhole, kind, distortion = MODELS[model].parts(parameters)
    with prefixed(where):
        fx, fy, cx, cy = pinhole
        return Lens(width, height, fx, fy, cx, cy, kind, distortion)


# ---------------------------------------------------------------------- text


def _lines(path: Path) -> Iterator[tuple[int, str]]:
    for number, line in enumerate(bounded_files.read_text(path, _LARGEST).splitlines(), 1):
        if not line.startswith("#"):
            yield number, line


def _text_cameras(path: Path) -> Iterator[tuple[int, Lens]]:
    for number, line in _lines(path):
        words = line.split()
        if not words:
            continue
        where = f"{path}:{number}"
        try:
            camera, model, width, height = int(words[0]), words[1], int(words[2]), int(words[3])
            parameters = tuple(float(word) for word in words[4:])
        except (ValueError, IndexError) as error:
            raise InputError(f"{where}: expected CAMERA_ID MODEL WIDTH HEIGHT PARAMETERS") from error
        yield camera, _lens(model, width, height, parameters, where)


def _text_images(path: Path) -> Iterator[_Image]:
    """Yield the images, which are every second line. The other lines list points, and may be empty."""
    for index, (number, line) in enumerate(_lines(path)):
        if index % 2:
            words = line.split()
            if len(words) % 3 or (words and not words[-1].lstrip("-").isdigit()):
                raise InputError(
                    f"{path}:{number}: expected the points of the image before, X Y POINT3D_ID each, or an empty line"
                )
            continue
        words = line.split(None, 9)
        if not words:
            continue
        try:
            numbers = [float(word) for word in words[1:8]]
            camera, name = int(words[8]), words[9].strip()
        except (ValueError, IndexError) as error:
            what = "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME"
            raise InputError(f"{path}:{number}: expected {what}, then a line of points") from error
        yield _Image(name, camera, tuple(numbers[:4]), tuple(numbers[4:]))


# ---------------------------------------------------------------------- binary


class _Reader:
    """Numbers of a binary file, little-endian, one after the other."""

    def __init__(self, path: Path):
        self.path = path
        self._data = bounded_files.read_bytes(path, _LARGEST)
        self._at = 0

    def take(self, kinds: str) -> tuple:
        try:
            values = struct.unpack_from(f"<{kinds}", self._data, self._at)
        except struct.error as error:
            raise InputError(f"{self.path}: ends in the middle of an entry") from error
        self._at += struct.calcsize(f"<{kinds}")
        return values

    def name(self) -> str:
        end = self._data.find(b"\0", self._at, self._at + _LONGEST_NAME)
        if end < 0:
            raise InputError(f"{self.path}: a name without an end")
        text = self._data[self._at : end]
        self._at = end + 1
        try:
            return text.decode()
        except UnicodeDecodeError as error:
            raise InputError(f"{self.path}: a name that is not UTF-8") from error

    def skip(self, size: int) -> None:
        self._at += size
        if self._at > len(self._data):
            raise InputError(f"{self.path}: ends in the middle of an entry")


def _binary_cameras(path: Path) -> Iterator[tuple[int, Lens]]:
    reader = _Reader(path)
    for _ in range(reader.take("Q")[0]):
        camera, model, width, height = reader.take("iiQQ")
        where = f"{path}: camera {camera}"
        name = _BY_NUMBER.get(model)
        if name is None:
            raise InputError(f"{where}: camera model {model}: expected one of {', '.join(MODELS)}")
        yield camera, _lens(name, width, height, reader.take(f"{MODELS[name].count}d"), where)


def _binary_images(path: Path) -> Iterator[_Image]:
    reader = _Reader(path)
    for _ in range(reader.take("Q")[0]):
        numbers = reader.take("i7di")
        name = reader.name()
        points = reader.take("Q")[0]
        reader.skip(24 * points)
        yield _Image(name, numbers[8], numbers[1:5], numbers[5:8])
