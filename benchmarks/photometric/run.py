"""Photometric stereo: a descent against least squares, on photographs of one camera under known lights.

The folder has `lights.txt`, photographs and a mask. All normals start facing the camera. Angles are between the normals of the descent
and those of least squares (Woodham 1980); a pixel is lit where under no training light it is darker than a tenth of its brightest.
Held-out lights: PSNR as displayed, inside the mask.
"""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np

import unrender as ur
from benchmarks.runner.records import scratch
from unrender.app.capture import importing, photometric
from unrender.app.capture.formats import lights
from unrender.app.evaluation.measures import measure

QUICK = {"steps": 3, "resolution": 24, "seeds": 1, "final_spp": 1}
COLOUR, NORMAL = "plate.bsdf.nested_bsdf.reflectance.data", "plate.bsdf.normalmap.data"


def normals(values: np.ndarray) -> np.ndarray:
    """Of a normal map in [0, 1], unit."""
    found = 2 * values - 1
    return found / np.linalg.norm(found, axis=-1, keepdims=True)


def run(
    photographs: Path, steps: int = 150, resolution: int = 256, seeds: int = 1, final_spp: int = 16
) -> dict[str, Any]:
    """Both on the training lights.

    Args:
        photographs: folder of the capture
        final_spp: of the pictures that are measured
    """
    folder = scratch("photometric/plate")
    shutil.rmtree(folder, ignore_errors=True)
    importing.import_capture(photographs, folder, importing.ImportOptions(resolution=resolution))
    views = photometric.prepare(lights.read(photographs), resolution, None, None)
    problem, held_out = (ur.Problem.from_file(folder / name) for name in ("problem.toml", "held-out.toml"))
    inside = np.asarray(problem.views[0].mask) > 0
    training, judged = views.training, np.flatnonzero(views.held_out)
    clear = inside & photometric.lit(views.values[training].mean(-1))
    normal, colour = photometric.least_squares(views.values[training], views.directions[training])
    places = {"all": inside, "lit": clear, "in shadow": inside & ~clear}

    def psnr(pictures: list[np.ndarray]) -> dict[str, list[float]]:
        return {
            name: [
                measure(picture, views.values[light], place.astype(np.float32)).psnr
                for picture, light in zip(pictures, judged, strict=True)
            ]
            for name, place in places.items()
            if place.any()
        }

    shading = [np.maximum(normal @ views.directions[light], 0)[..., None] for light in judged]
    found: dict[str, Any] = {"least squares": {"psnr": [psnr([colour * one for one in shading])]}}
    rows = found.setdefault("descent", {"psnr": [], "angle": []})
    for seed in range(seeds):
        result = ur.optimize(problem, "auto", steps=steps, seed=seed)
        pictures = [
            np.asarray(ur.render(held_out, result.parameters, view=view, spp=final_spp)) for view in range(len(judged))
        ]
        rows["psnr"].append(psnr(pictures))
        angle = np.degrees(np.arccos(np.clip((normals(result.parameters[NORMAL]) * normal).sum(-1), -1, 1)))
        rows["angle"].append({name: float(np.median(angle[place])) for name, place in places.items() if place.any()})
        print(seed, rows["angle"][-1], rows["psnr"][-1], flush=True)
    counts = {name: int(place.sum()) for name, place in places.items()}
    return {"found": found, "pixels": counts, "lights": [len(training), len(judged)], "linear": views.linear}
