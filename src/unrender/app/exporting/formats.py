"""The formats of an export, by name."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from unrender.app.exporting import blender, gltf, mesh_formats, ready_made, usd
from unrender.app.exporting.asset import Asset
from unrender.core.errors import InputError
from unrender.core.suggestions import did_you_mean

__all__ = ["FORMATS", "MITSUBA", "OWN", "Format", "check", "write"]

MITSUBA = "mitsuba"


@dataclass(frozen=True)
class Format:
    """What a format writes.

    Attributes:
        write: given the asset and the folder.
        files: the names in the folder, besides those of the formats that it needs.
        needs: formats that are written with it.
        check_installed: raises `InputError` where a package is missing.
    """

    write: Callable[[Asset, Path], None]
    files: tuple[str, ...]
    needs: tuple[str, ...] = ()
    check_installed: Callable[[], None] = lambda: None


def _write_glb(asset: Asset, folder: Path) -> None:
    (folder / "asset.glb").write_bytes(gltf.glb(asset))


def _write_environment(asset: Asset, folder: Path) -> None:
    if asset.environment is None:
        return
    for ending in (".exr", ".hdr"):
        ready_made.write_bitmap(
            ready_made.as_bitmap(np.ascontiguousarray(asset.environment)), folder / f"environment{ending}"
        )


def _in_folder(name: str, write: Callable[[Asset, Path], None]) -> Callable[[Asset, Path], None]:
    def inside(asset: Asset, folder: Path) -> None:
        (folder / name).mkdir()
        write(asset, folder / name)

    return inside


FORMATS = {
    "glb": Format(_write_glb, ("asset.glb",), check_installed=gltf.check_installed),
    "obj": Format(_in_folder("obj", mesh_formats.write_obj), ("obj",)),
    "ply": Format(_in_folder("ply", mesh_formats.write_ply), ("ply",)),
    "environment": Format(_write_environment, ("environment.exr", "environment.hdr")),
    "blender": Format(blender.write, (blender.SCRIPT,), ("glb", "environment"), gltf.check_installed),
    "usd": Format(usd.write, (usd.FILE,), check_installed=usd.check_installed),
}
"""All but Mitsuba's own."""
OWN = frozenset(name for known in FORMATS.values() for name in known.files)


def check(formats: Sequence[str]) -> tuple[str, ...]:
    """The formats to write, with those that they need, each once. Raises `InputError` for unknown ones and missing packages."""
    known = (MITSUBA, *FORMATS)
    for name in formats:
        if name not in known:
            raise InputError(f"--format {name}: expected {', '.join(known)}{did_you_mean(name, known)}")
    if not formats:
        raise InputError(f"--format: expected one or more of {', '.join(known)}")
    found = dict.fromkeys(
        each for name in formats for each in (*(FORMATS[name].needs if name in FORMATS else ()), name)
    )
    for name in found:
        if name in FORMATS:
            FORMATS[name].check_installed()
    return tuple(found)


def write(asset: Asset, folder: Path, formats: Sequence[str]) -> list[str]:
    """Write the asset in these formats, but for Mitsuba's. Returns a line for each thing that is not carried over."""
    notices = list(asset.notices)
    for name in formats:
        if name in FORMATS:
            FORMATS[name].write(asset, folder)
    if asset.environment is None and "environment" in formats:
        notices.append("no environment.exr: no light comes from all around")
    elif "environment" in formats and not np.allclose(asset.environment_to_world, np.eye(3), atol=1e-5):
        notices.append("environment.exr is as the scene's file has it; the scene, and open_in_blender.py, turn it")
    return notices
