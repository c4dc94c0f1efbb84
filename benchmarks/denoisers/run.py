"""The denoisers that run here, on one noisy picture of the truth: error against a picture without noise, and time.

Open Image Denoise in both qualities, total variation, and on a GPU the denoiser of OptiX (`mi.OptixDenoiser`), each with and without
albedo and normals as guides where it takes them. Errors are root mean squares over pixels, relative to that of the noisy picture; the
reference's own noise is a part of them.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from typing import Any

import numpy as np

import unrender as ur
from benchmarks.internals import SampleRequest, arrays, dr, mi, prepare, stock_scene
from benchmarks.paths import truth
from unrender.core.errors import InputError
from unrender.images.denoising import Denoiser, choose, denoise

DENOISERS: tuple[Denoiser, ...] = ("oidn", "optix", "variation")
PROBLEMS = ("indirect-room", "glossy-room")
QUICK = {"problem": ("indirect-room",), "size": (32,), "reference_spp": 16, "repeats": 1}
MERGE = ("problems.*",)


def runs_here(by: Denoiser) -> bool:
    """Whether this denoiser can run; printed where it cannot."""
    try:
        choose(by)
    except InputError as error:
        print(error, flush=True)
        return False
    return True


def guides(problem: ur.Problem, spp: int = 64) -> tuple[np.ndarray, np.ndarray]:
    """Albedo, and normals in the sensor's frame, (H, W, 3) each, of what the pixels see first."""
    scene, _ = stock_scene(problem)
    found = mi.load_dict({"type": "aov", "aovs": "albedo:albedo,normals:sh_normal"}).render(scene, sensor=0, spp=spp)
    channels = np.array(found)[..., -6:]
    to_sensor = np.array(scene.sensors()[0].world_transform().inverse().matrix).reshape(4, 4)[:3, :3]
    return np.clip(channels[..., :3], 0, 1), np.clip(channels[..., 3:] @ to_sensor.T, -1, 1)


def ways(albedo: np.ndarray, normals: np.ndarray) -> dict[str, dict[str, Any]]:
    """{name: arguments of `denoise`} of all that runs here."""
    guided = {"albedo": albedo, "normals": normals}
    found: dict[str, dict[str, Any]] = {}
    for by in filter(runs_here, DENOISERS):
        found[by] = {"by": by}
        if by != "variation":
            found[f"{by}, guided"] = {"by": by, **guided}
        if by == "oidn":
            found["oidn, fast"] = {"by": by, "fast": True}
    return found


def compare(problem: ur.Problem, spp: int, reference_spp: int, repeats: int) -> dict[str, Any]:
    """Error over the noise's, and milliseconds, the least of the repeats."""
    albedo, normals = guides(problem)  # of the scene's own values, which are the truth
    at = truth(problem)
    session = prepare(problem, at, derivatives=False)

    def picture(samples: int, seed: int) -> np.ndarray:
        image = session.image(at, SampleRequest(0, samples, seed, 1)).images
        dr.eval(image)
        return arrays.numpy(image)[0]

    clean = np.mean([picture(min(reference_spp, 256), 1000 + n) for n in range(max(1, reference_spp // 256))], axis=0)
    noisy = picture(spp, 1)
    noise = float(np.sqrt(np.mean((noisy - clean) ** 2)))
    found = {}
    for name, arguments in ways(albedo, normals).items():
        denoise(noisy, **arguments)
        times = []
        for _ in range(repeats):
            began = time.perf_counter()
            result = denoise(noisy, **arguments)
            times.append(1e3 * (time.perf_counter() - began))
            error = float(np.sqrt(np.mean((result - clean) ** 2)))
        found[name] = {"error": error / noise, "ms": min(times)}
    return found


def run(
    problem: tuple[str, ...] = PROBLEMS,
    size: tuple[int, ...] = (64, 192),
    spp: int = 4,
    reference_spp: int = 512,
    repeats: int = 3,
) -> Iterator[dict[str, Any]]:
    """A part per problem and size.

    Args:
        problem: of the gallery
        size: of the film, pixels along a side
        spp: of the noisy picture
        reference_spp: of the picture without noise
        repeats: of each, for its time
    """
    for name in problem:
        entries: dict[str, Any] = {}
        for side in size:
            made = ur.gallery.problem(name, resolution=side, reference_spp=1)
            entries[str(side)] = compare(made, spp, reference_spp, repeats)
            print(name, side, entries[str(side)], flush=True)
            yield {"problems": {name: dict(entries)}}
