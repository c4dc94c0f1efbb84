"""Construction of a problem with references and true values from a specification: true scene and unknown parameters.

Reference images are cached between processes. The key of an image contains everything that determines it: numbers and structure of the
loaded scene, sensor, samples, path length, and software versions. A file that cannot be read is rendered again and replaced.
"""

from __future__ import annotations

import contextlib
import hashlib
import math
import os
import re
from collections.abc import Callable, Sequence
from importlib import metadata
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import drjit as dr
import mitsuba as mi
import numpy as np

from unrender.backend import cache
from unrender.backend.variant import current, ensure, llvm_version
from unrender.core import phases
from unrender.core.errors import InputError
from unrender.core.random import Key
from unrender.gallery import meshes
from unrender.io import bounded_files, files
from unrender.losses import Loss
from unrender.rendering.mitsuba import film
from unrender.rendering.mitsuba.film_response import FilmResponse, response_table
from unrender.rendering.mitsuba.integrators.aov import AovKernel
from unrender.rendering.mitsuba.pixel_filter import PixelFilters, is_box
from unrender.rendering.mitsuba.renderer import MitsubaRenderer
from unrender.rendering.mitsuba.scene_loading import load, media
from unrender.scene.parameter import Parameter
from unrender.scene.problem import Problem
from unrender.scene.references import View

_FORMAT = 2
_NAME = "reference"
_ADDRESS = re.compile(r"\bobject_\d+|0x[0-9a-f]+|\[\d{9,}\]")
"""Parts of a scene's description that differ between loads."""
_SAMPLER = re.compile(r"^\s*(sample_count|samples_per_wavefront|wavefront_size) = .*\n", re.MULTILINE)
"""State of a sampler that every rendering overwrites."""


def recall(
    scene: Any, sensor: int, spp: int, max_depth: int, render: Callable[[], np.ndarray], aov: str = ""
) -> np.ndarray:
    """Return the cached image (H, W, 3) of these settings, or the result of `render`, which is then cached if a cache folder exists."""
    place = cache.folder(cache.REFERENCES)
    if place is None:
        return render()
    path = place / f"{digest(scene, sensor, spp, max_depth, aov)}.npz"
    width, height = scene.sensors()[sensor].film().crop_size()
    image = _read(path, (int(height), int(width), 3))
    if image is None:
        image = render()
        with contextlib.suppress(InputError):  # on a full disk the image is just not cached
            files.write_arrays(path, {_NAME: image})
            cache.trim(place, cache.LARGEST[cache.REFERENCES])
    return image


def digest(scene: Any, sensor: int, spp: int, max_depth: int, aov: str = "") -> str:
    """Return a name for the image: 40 hexadecimal digits of the SHA-256 of everything that determines it."""
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
        *([aov] if aov else []),
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
    """Return the image, or None if there is no usable one."""
    if not path.exists():
        return None
    try:
        image = bounded_files.read_float_arrays(path, path.parent).get(_NAME)
    except InputError:
        return None
    if image is None or image.shape != shape or image.dtype != np.float32:
        return None
    with contextlib.suppress(OSError):
        os.utime(path)  # marks it as recently used
    return image


_LANES = 1 << 21  # paths per pass of a reference, within the memory of a small machine
_REFERENCE = Key(seed=0x9A11E47)  # base of the references' seeds, distinct from those of runs, which count from 0


class Specification(Protocol):
    """A gallery problem: a frozen dataclass whose fields are its options (see `fields.py`)."""

    @property
    def resolution(self) -> int:
        """Pixels along a side of each view."""
        ...

    @property
    def reference_spp(self) -> int:
        """Samples per pixel of the references."""
        ...

    @property
    def max_depth(self) -> int:
        """Maximum path length in segments."""
        ...

    @property
    def loss(self) -> Loss:
        """Loss between rendered and reference images."""
        ...

    def scene(self) -> dict[str, Any]:
        """Return the true scene as a new Mitsuba dictionary. Called after a variant is set."""
        ...

    def parameters(self) -> tuple[Parameter, ...]:
        """Return the unknown parameters with their initial values."""
        ...


@runtime_checkable
class ProblemSource(Protocol):
    """A gallery problem with its own construction: without a renderer, or with references of another scene."""

    def problem(self, name: str) -> Problem:
        """Return the problem with these options and this name."""
        ...


def build_problem(name: str, specification: Specification, views: Sequence[View] = ()) -> Problem:
    """Return the problem: true values from the scene, `views` or one view per sensor, references by Mitsuba's integrators."""
    ensure()
    renderer = MitsubaRenderer(specification.scene, specification.max_depth)
    parameters = specification.parameters()
    truth = {key: value.numpy() for key, value in renderer.values([p.key for p in parameters]).items()}
    views = views or views_of(renderer.pair.current, specification)
    return Problem(renderer, parameters, views, specification.loss, specification.max_depth, truth=truth, name=name)


def reconstruction(
    name: str, specification: Any, aov: str = "", surface_of: str | None = None, max_depth: int | None = None
) -> Problem:
    """Return the problem of a specification whose references show another scene, `target()`, than the initial `scene()`.

    `surface_of` is the key of the vertex positions whose true surface is that of the first mesh of the target, None for no true values.
    """
    true = load(specification.target)
    body = next((shape for shape in true.shapes() if shape.is_mesh()), None)
    return Problem(
        specification.scene,
        specification.parameters(),
        views_of(true, specification, aov),
        specification.loss,
        max_depth or specification.max_depth,
        name=name,
        surfaces={surface_of: meshes.surface(body)} if surface_of else {},
    )


def views_of(scene: Any, specification: Specification, aov: str = "") -> list[View]:
    """Return a view of each sensor of a loaded scene, with its `reference`."""
    spp, depth = specification.reference_spp, specification.max_depth
    sensors = range(len(scene.sensors()))
    return [View(reference(scene, sensor, spp, depth, aov), sensor, aov=aov or None) for sensor in sensors]


def reference(scene: Any, sensor: int, spp: int, max_depth: int, aov: str = "") -> np.ndarray:
    """Return a reference image by Mitsuba's `path` integrator, or `volpath` with media: (H, W, 3) float32. Unbiased up to `max_depth`.

    With an AOV (`rendering.AOVS`), the image has that property of the first surface in place of radiance.

    It uses the film's reconstruction filter, and `spp` samples or slightly more, in as many equal passes as memory requires. Equal
    arguments give equal images, which are stored in the cache folder (`backend.cache`).
    """
    with phases.phase("reference images") as advance:
        return recall(scene, sensor, spp, max_depth, lambda: _render(scene, sensor, spp, max_depth, aov, advance), aov)


def _render(
    scene: Any, sensor: int, spp: int, max_depth: int, aov: str, advance: Callable[[float], None]
) -> np.ndarray:
    volumes = bool(media(scene))
    integrator = mi.load_dict({"type": "volpath" if volumes else "path", "max_depth": max_depth})
    camera = scene.sensors()[sensor]
    width, height = (int(size) for size in camera.film().crop_size())
    numbers, take = "independent", -(-spp // -(-spp * width * height // _LANES))
    if not volumes:
        # Equivalent to 1.4 to 14 times as many independent samples on the gallery; in media, hardly better.
        numbers, take = "multijitter", _grid(take)
    sampler = mi.load_dict({"type": numbers, "sample_count": take})
    sampler.set_samples_per_wavefront(take)
    total, done = np.zeros((height, width, 3)), 0
    while done < spp:
        seed = _REFERENCE.fold(sensor).fold(done).uint32()
        samples = film.camera_samples(
            camera, sampler, mi.UInt32(seed), take, None, width * height, filters=PixelFilters.of([camera])
        )
        ray, weight = film.rays(samples)
        if aov:
            radiance = AovKernel(aov).value(scene.ray_intersect(ray), ray, True)
        else:
            radiance, _, _ = integrator.sample(scene, sampler, ray, camera.get_medium())
        values = FilmResponse(weight, ray.wavelengths, response_table()).film(radiance)
        dr.eval(values)
        total += take * film.develop(values, take, 1, total.shape).numpy()[0]
        done += take
        advance(min(1.0, done / spp))
    return (total / done).astype(np.float32)


def _grid(count: int) -> int:
    """Return the smallest number of cells, at least `count`, of a grid of n by n or n by n + 1."""
    side = math.isqrt(count)
    return next(cells for cells in (side * side, side * (side + 1), (side + 1) ** 2) if cells >= count)
