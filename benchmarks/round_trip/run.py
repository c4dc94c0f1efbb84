"""Assets read back: exports for other programs, read by other libraries, rendered for held-out photographs beside the run's own pictures.

Photographs are imported, an asset is recovered by `auto` and exported. Each file is read back (`readers.py`), put under the light that was
exported, and rendered by plain Mitsuba for the cameras of the held-out photographs. PSNR is as displayed, inside the masks: of both
pictures against the photographs, and of one against the other; "noise" is the run's own pictures at other random numbers.
Without --photographs, those of `unrender.gallery.photographs`; once with the default unknowns and once with normals, too.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

import unrender as ur
from benchmarks.internals import method, turntable_turns
from benchmarks.round_trip.readers import READERS, described
from benchmarks.runner.records import scratch
from unrender.app.evaluation.measures import measure

QUICK = {"steps": 2, "views": 9, "size": 24, "texture": 16, "faces": 300, "spp": 2, "unknowns": ("normals",)}
UNKNOWNS = {
    "default": ("colour", "roughness", "metallic", "light"),
    "normals": ("colour", "roughness", "metallic", "normal", "light"),
}
MERGE = ("found.*",)


def cameras(problem: ur.Problem) -> tuple[list[Any], np.ndarray]:
    """The held-out views' sensors, and the rotation of the light's picture before each, (V, 3, 3)."""
    renderer: Any = problem.renderer
    scene = renderer.pair.current
    sensors = [scene.sensors()[view.sensor] for view in problem.views]
    turns = turntable_turns(scene)
    times = [round(float(sensor.shutter_open())) for sensor in sensors]
    return sensors, np.array([np.eye(3) if turns is None else turns[time] for time in times])


def pictures(kind: str, folder: Path, held_out: ur.Problem, spp: int) -> list[np.ndarray]:
    """Of what a format's reader finds in an export, for all held-out views; of "mitsuba", of the scene as it is."""
    sensors, turns = cameras(held_out)
    path: Any = mi.load_dict({"type": "path", "max_depth": held_out.max_depth})
    looks = None if kind == "mitsuba" else READERS[kind](folder)
    scene: Any = mi.load_file(str(folder / "scene.xml")) if looks is None else None
    found = []
    for index, (sensor, turn) in enumerate(zip(sensors, turns, strict=True)):
        if looks is not None and (index == 0 or not np.array_equal(turn, turns[index - 1])):
            scene = mi.load_dict(described(looks, folder / "environment.exr", turn))
        image = mi.render(scene, sensor=sensor, integrator=path, spp=spp, seed=mi.UInt32(1))  # pyright: ignore
        found.append(np.array(image)[..., :3])
    return found


def compare(problem: ur.Problem, held_out: ur.Problem, values: dict[str, np.ndarray], folder: Path, spp: int) -> dict:
    """{format: PSNR of each held-out photograph, and of the run's own pictures}."""
    formats = ["mitsuba", "environment", *READERS]
    ur.app.export((problem, values), folder, formats=formats)
    known = held_out.renderer.parameters()
    shown = {key: value for key, value in values.items() if key in known}
    judged = ur.Problem(
        held_out.origin["scene"],
        [ur.Parameter(key) for key in shown],
        held_out.given_views,
        max_depth=held_out.max_depth,
    )
    own, other = (
        [np.asarray(ur.render(judged, shown, view=view, spp=spp, seed=seed)) for view in range(len(judged.views))]
        for seed in (0, 1)
    )
    photographs = [(np.asarray(view.reference), np.asarray(view.mask)) for view in judged.views]

    def psnr(images: list[np.ndarray], against: list[np.ndarray]) -> list[float]:
        triples = zip(images, against, photographs, strict=True)
        return [measure(image, wanted, mask).psnr for image, wanted, (_, mask) in triples]

    references = [reference for reference, _ in photographs]
    found = {"run": {"photographs": psnr(own, references), "pictures": psnr(other, own)}}
    for kind in ("mitsuba", *READERS):
        images = pictures(kind, folder, judged, spp)
        found[kind] = {"photographs": psnr(images, references), "pictures": psnr(images, own)}
    return found


def run(
    photographs: Path | None = None,
    unknowns: tuple[str, ...] = tuple(UNKNOWNS),
    steps: int = 40,
    views: int = 24,
    size: int = 96,
    texture: int = 128,
    faces: int = 4000,
    pixels: int = 32768,
    spp: int = 256,
    seed: int = 0,
) -> Iterator[dict[str, Any]]:
    """A part for each list of unknowns.

    Args:
        photographs: folder of a capture; made ones where it is not given
        unknowns: with or without normals
        views: how many photographs are made
        size: pixels along the longer side of a photograph
        pixels: of a step, from all photographs
        spp: of the pictures that are measured
    """
    given = photographs
    if given is None:
        given = scratch("round_trip/photographs")
        shutil.rmtree(given, ignore_errors=True)
        ur.gallery.photographs(given, views=views, size=size, seed=seed)
    for name in unknowns:
        folder = scratch("round_trip/asset")
        shutil.rmtree(folder, ignore_errors=True)
        options = ur.app.ImportOptions(resolution=size, texture=texture, faces=faces, unknowns=UNKNOWNS[name])
        ur.app.import_capture(given, folder, options)
        problem = ur.Problem.from_file(folder / "problem.toml")
        choice = method("auto").configure({"pixels": pixels}).plan(problem)
        result = ur.optimize(problem, choice, steps=steps, seed=seed)
        held_out = ur.Problem.from_file(folder / "held-out.toml")
        found = compare(problem, held_out, result.parameters, folder / "export", spp)
        for kind, row in found.items():
            print(name, kind, {key: round(float(np.mean(values)), 2) for key, values in row.items()}, flush=True)
        whose = "made" if photographs is None else given.resolve().name
        sizes = {"held_out": len(held_out.views), "training": len(problem.views), "steps": steps, "size": size}
        yield {"found": {f"{whose}, {name}": {"rows": found, **sizes}}}
