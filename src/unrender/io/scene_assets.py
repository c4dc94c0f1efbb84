"""The files that objects of a scene name, checked before Mitsuba reads them: of the right kind, bounded, and as large as they declare."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from unrender.core.errors import InputError
from unrender.core.text import shorten
from unrender.io import bounded_files, image_size, mesh_files, spectrum_files, tensor_files, volumes

__all__ = ["MOST_VALUES", "AssetChecks"]

MOST_VALUES = 1 << 30
"""Of all pictures and grids of a scene together."""
_LARGEST = 1 << 32


@dataclass
class AssetChecks:
    """Checks the files of one scene.

    Attributes:
        values: of the pictures and grids so far.
    """

    values: int = 0

    def check(self, plugin: str, path: Path, index: int = 0) -> None:
        """Check a file that an object names.

        Args:
            plugin: the object's type.
            path: the file.
            index: the object's `shape_index`.

        Raises:
            InputError: one line that names the file.
        """
        if (found := bounded_files.kind(path)) != "file":
            raise InputError(f"{shorten(str(path), 200)}: {_KINDS[found]}")
        if plugin == "serialized":
            mesh_files.check_serialized(path, index)
        else:
            self.values += _CHECKS.get(plugin, _plain)(path) or 0
        if self.values > MOST_VALUES:
            raise InputError(f"{path}: with it the scene's pictures and grids have more than {MOST_VALUES} values")


_KINDS = {"": "no such file", "folder": "a folder, expected a file", "other": "not a regular file"}


def _picture(path: Path) -> int:
    try:
        return image_size.check(path)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error


def _plain(path: Path) -> None:
    size = path.stat().st_size
    if size > _LARGEST:
        raise InputError(f"{path}: larger than {_LARGEST >> 30} GiB")


def _splats(path: Path) -> None:
    mesh_files.check_ply(path, splats=True)


_CHECKS: dict[str, Callable[[Path], int | None]] = {
    **dict.fromkeys(("bitmap", "envmap"), _picture),
    **dict.fromkeys(("gridvolume", "sdfgrid"), volumes.check_vol),
    **dict.fromkeys(("ellipsoids", "ellipsoidsmesh"), _splats),
    **dict.fromkeys(("measured", "measured_polarized"), tensor_files.check),
    "ply": mesh_files.check_ply,
    "obj": mesh_files.check_obj,
    "spectrum": spectrum_files.check,
}
