"""What photographs do: a made capture with lens distortion, exposure drift, vignetting, wrong poses, masks off and 8-bit JPEG files.

A painted body under a sky, seen by eight cameras, is photographed (`capture.py`), imported with its mesh, and its base colour and light are
recovered by `auto`, at equal steps: with no nuisance, with each, and with all at once; without and with what models it: the lens's
coefficients in transforms.json, `exposure`, `vignetting` and `poses` among the unknowns, a band of low weight in the masks. JPEG files need
nothing. A camera whose curve is not sRGB has captures of its own, under the sky and on a turntable: unknown exposures hide it. Errors are
root mean squares: of the base colour after the best factor per channel (only the product of colour and light is seen), of the light's
logarithm likewise, of exposures in stops, of the vignetting at the corners in stops, of the response's curve over [0, 1]; of poses the mean
angle, in degrees, by which the direction towards the body's middle is wrong.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

import unrender as ur
from benchmarks.internals import Corrections, curve, method
from benchmarks.nuisances import capture

COLOUR, LIGHTS = "asset.bsdf.base_color.data", ("light.data", "light.map.data")
BAND = 4
KNOWN = "known light"
"""In place of an unknown one; no nuisance."""
CASES = {"none": (), **{name: (name,) for name in capture.NUISANCES}, "all": capture.NUISANCES}
CASES |= {
    "response": (capture.RESPONSE,),
    "turntable": (capture.TURNTABLE,),
    "response, turntable": (capture.RESPONSE, capture.TURNTABLE),
    "response, turntable, known light": (capture.RESPONSE, capture.TURNTABLE, KNOWN),
}
MERGE = ("faults.*",)
QUICK = {"steps": 3, "size": 24, "spp": 1, "pixels": 512, "fault": ("none", "all")}


def imported(folder: Path, nuisances: tuple[str, ...], models: tuple[str, ...], size: int, spp: int) -> Any:
    """The problem of a capture with these nuisances and these models, and what was put in."""
    made = capture.make(folder / "photographs", nuisances, size, spp, "distortion" in models)
    unknowns = (
        "colour",
        *(() if KNOWN in nuisances else ("light",)),
        *(name for name in ("exposure", "vignetting", "response", "poses") if name in models),
    )
    options = ur.app.ImportOptions(
        mesh=folder / "photographs" / "body.ply",
        masks=folder / "photographs" / "masks",
        resolution=size,
        hold_out=0,
        texture=capture.TEXELS,
        unknowns=unknowns,
        band=BAND if "masks" in models else 0,
        turntable=capture.TURNTABLE in nuisances,
    )
    ur.app.import_capture(folder / "photographs", folder / "problem", options)
    if KNOWN in nuisances:
        mi.Bitmap(made.sky.astype(np.float32)).write(str(folder / "problem" / "textures" / "light.exr"))
    return ur.Problem.from_file(folder / "problem" / "problem.toml"), made


def errors(problem: ur.Problem, found: dict[str, np.ndarray], made: capture.Made, seen: np.ndarray) -> dict[str, float]:
    """Of what was recovered; of poses also where they are taken as given."""
    colour, sky = capture.truth()
    # Rows of texels of a bitmap run downwards, as those of the truth do.
    own, true = found[COLOUR][seen], colour[seen]
    scale = (own * true).sum(0) / np.square(own).sum(0)
    result = {"colour": _rms(scale * own - true)}
    if lit := [found[key] for key in LIGHTS if key in found]:
        # Mitsuba repeats a column at either end.
        light = np.log(np.maximum(lit[0][:, 1:-1], 1e-6)) - np.log(sky)
        result["light"] = _rms((light - light.mean((0, 1)))[1:-1])
    if "exposure" in found:
        result["exposure"] = _rms(found["exposure"] - found["exposure"].mean(0) - made.drift)
    if "vignetting" in found:
        result["vignetting"] = float(abs(found["vignetting"].sum() - made.vignetting))
    if made.responded:
        x = np.linspace(0, 1, 101)[:, None]
        contrast, brightness = found.get("response", np.zeros((3, 2))).T
        result["response"] = _rms(curve(contrast, brightness, x).values - capture.responded(x))
    rows = found.get("poses", np.zeros_like(made.rows))
    result["poses"] = float(np.mean(_angles(problem, rows, made)))
    return result


def _rms(x: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(x, dtype=np.float64))))


def _angles(problem: ur.Problem, rows: np.ndarray, made: capture.Made) -> list[float]:
    """Of each camera, between the directions towards the body's middle, in its own axes."""
    from scipy.spatial.transform import Rotation

    cameras = {v: capture.Camera(f"{v}r", f"{v}t", pose[:3, 3]) for v, pose in enumerate(made.cameras)}
    moved, found = Corrections(cameras).poses(np.asarray(rows, float)), []
    for v, (wrong, true) in enumerate(zip(made.cameras, capture.poses(), strict=True)):
        turned = Rotation.from_rotvec(moved[f"{v}r"]).as_matrix() @ wrong[:3, :3]
        place = wrong[:3, 3] + moved[f"{v}t"]
        a, b = turned.T @ -place, true[:3, :3].T @ -true[:3, 3]
        found.append(np.degrees(np.arccos(np.clip(a @ b / np.linalg.norm(a) / np.linalg.norm(b), -1, 1))))
    return found


def run(
    fault: tuple[str, ...] = tuple(CASES),
    steps: int = 60,
    size: int = 32,
    spp: int = 8,
    pixels: int | None = None,
    seeds: int = 1,
) -> Iterator[dict[str, Any]]:
    """A part for each nuisance, without and with its models.

    Args:
        fault: of the cases; the others' figures stay
        size: pixels along a side of a photograph
        spp: samples in each of the 16 parts of a photograph's pixel
        pixels: of a step, from all photographs; as many as `auto` takes where it is not given
    """
    with tempfile.TemporaryDirectory() as scratch:
        problem, _ = imported(Path(scratch), (), (), size, 1)
        gradient = ur.estimate(problem, ur.PathGradient(spp=16)).gradient[COLOUR]
        seen = np.abs(gradient).sum(-1) > 0
    for name in fault:
        everything = CASES["all"] if name == "none" else CASES[name]
        part: dict[str, Any] = {}
        for way, models in (("without", ()), ("with", everything)):
            if name in ("jpeg", "turntable") and models:
                continue
            with tempfile.TemporaryDirectory() as scratch:
                problem, made = imported(Path(scratch), CASES[name], models, size, spp)
                rows = []
                for seed in range(seeds):
                    choice = method("auto").configure({} if pixels is None else {"pixels": pixels}).plan(problem)
                    result = ur.optimize(problem, choice, steps=steps, seed=seed)
                    rows.append(errors(problem, result.parameters, made, seen))
            part[way] = {key: [row[key] for row in rows] for key in rows[0]}
            print(name, way, part[way], flush=True)
        yield {"faults": {name: part}, "steps": steps, "size": size}
