"""Reference images kept between processes: the gallery's take half a minute to render, and never change.

An image is found by everything that decides it: the numbers and the structure of the loaded scene, sensor, samples, path length, the
versions of what renders it. The files are `.npz` archives of one array, written beside their place and renamed, and checked when they
are read; one that cannot be used is rendered anew and replaced.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import re
from collections.abc import Callable
from importlib import metadata
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

from unrender.backend import cache
from unrender.backend.variant import current, llvm_version
from unrender.core.errors import InputError
from unrender.io import bounded_files, files
from unrender.rendering.mitsuba.pixel_filter import is_box

__all__ = ["digest", "recall"]

_FORMAT = 2
_NAME = "reference"
_ADDRESS = re.compile(r"\bobject_\d+|0x[0-9a-f]+|\[\d{9,}\]")
"""Parts of a scene's description that differ from one load to the next."""
_SAMPLER = re.compile(r"^\s*(sample_count|samples_per_wavefront|wavefront_size) = .*\n", re.MULTILINE)
"""What a rendering leaves behind in a sampler, and the next one sets."""


def recall(scene: Any, sensor: int, spp: int, max_depth: int, render: Callable[[], np.ndarray]) -> np.ndarray:
    """The image of the cache, else what `render` returns, which is kept there.

    Args:
        scene: a loaded Mitsuba scene.
        sensor, spp, max_depth: how it is rendered.
        render: makes the image, (H, W, 3) float32.
    """
    place = cache.folder(cache.REFERENCES)
    if place is None:
        return render()
    path = place / f"{digest(scene, sensor, spp, max_depth)}.npz"
    width, height = scene.sensors()[sensor].film().crop_size()
    found = _read(path, (int(height), int(width), 3))
    if found is None:
        found = render()
        with contextlib.suppress(InputError):  # a full disk: the image is there all the same
            files.write_arrays(path, {_NAME: found})
            cache.trim(place, cache.LARGEST[cache.REFERENCES])
    return found


def digest(scene: Any, sensor: int, spp: int, max_depth: int) -> str:
    """A name for the image: SHA-256 of what decides it."""
    state = hashlib.sha256()
    versions = [f"{name} {metadata.version(name)}" for name in ("mitsuba", "drjit")]
    facts = [
        _FORMAT,
        *versions,
        current(),
        llvm_version(),
        sensor,
        spp,
        max_depth,
        _SAMPLER.sub("", _ADDRESS.sub("", str(scene))),
        *(["filtered"] if not is_box(scene.sensors()[sensor].film()) else []),
    ]
    state.update("\n".join(map(str, facts)).encode())
    parameters = mi.traverse(scene)
    for key in sorted(_ADDRESS.sub("", name) + "\0" + name for name in parameters.keys()):  # noqa: SIM118 (iterating gives pairs)
        name = key.partition("\0")[2]
        state.update(f"\n{key.partition(chr(0))[0]} ".encode())
        state.update(_bytes(parameters[name]))
    return state.hexdigest()[:40]


def _bytes(value: Any) -> bytes:
    if isinstance(value, (bool, int, float, str)):
        return repr(value).encode()
    array = np.asarray(value.matrix if hasattr(value, "matrix") else value)
    return f"{array.dtype} {array.shape} ".encode() + np.ascontiguousarray(array).tobytes()


def _read(path: Path, shape: tuple[int, ...]) -> np.ndarray | None:
    """The image, or None where there is none that can be used."""
    if not path.exists():
        return None
    try:
        found = bounded_files.read_float_arrays(path, path.parent).get(_NAME)
    except InputError:
        return None
    if found is None or found.shape != shape or found.dtype != np.float32:
        return None
    with contextlib.suppress(OSError):
        os.utime(path)  # used just now
    return found
