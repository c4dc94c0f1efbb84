"""Poses of lights from few pictures: a spotlight's aim, a projector's pose, an area light's place, the turn of an environment
map and of a sky.

A floor and a box, pictures of few pixels, starts that differ by seed. `auto` takes a fixed number of steps. Mitsuba's own loop
(`mi.render` with `prb_projective`, `mi.ad.Adam`) moves the area light only: the transforms of other emitters have no derivative there, nor
has that of an area light in `prb`. It gets three times the seconds of `auto`, and the better of two rates by the median error of the seeds.
"""

from __future__ import annotations

import time
from typing import Any

import numpy as np

import unrender as ur
from benchmarks import markdown
from benchmarks.internals import mi, parts
from benchmarks.runner.records import Record
from benchmarks.stock_loop import StockViews

MERGE = ("cases.*",)
QUICK: dict[str, Any] = {"cases": ("spot",), "views": (1,), "seeds": 1, "steps": 2, "reference_spp": 4}
UNKNOWN: dict[str, dict[str, float]] = {
    "spot": {"rotation.x": 0.15, "rotation.z": 0.12},
    "projector": {"translation": 0.2, "rotation": 0.1},
    "area": {"translation": 0.4},
    "envmap": {"rotation.y": 0.5},
    "sunsky": {"rotation.y": 0.5},
}
"""{light: {key: distance of the start from the truth, in each number}}."""
RATES, SPP, TIMES = (0.01, 0.03), 16, 3


def light(name: str) -> dict[str, Any]:
    """The light of a case."""
    picture = mi.Bitmap(np.random.default_rng(0).uniform(0.1, 1.0, (8, 8, 3)).astype(np.float32))
    down = mi.ScalarTransform4f().look_at([0.3, 3.0, 1.0], [0.0, 0.0, 0.0], [1, 0, 0])
    match name:
        case "spot":
            return {"type": "spot", "to_world": down, "intensity": 12.0, "cutoff_angle": 25.0}
        case "projector":
            irradiance = {"type": "bitmap", "bitmap": picture, "raw": True}
            return {"type": "projector", "to_world": down, "irradiance": irradiance, "fov": 35.0, "scale": 9.0}
        case "area":
            place = mi.ScalarTransform4f().translate([0.4, 2.2, 0.3]).rotate([1, 0, 0], 90).scale(0.3)
            return {"type": "rectangle", "to_world": place, "emitter": {"type": "area", "radiance": parts.colour(12.0)}}
        case "sunsky":
            return {"type": "sunsky", "sun_direction": [0.5, 0.7, 0.4]}
    return {"type": "envmap", "bitmap": picture}


def scene(name: str, views: int, resolution: int) -> dict[str, Any]:
    """The true scene."""
    places = ([0, 2.5, 4], [3.5, 2.5, 2], [-3.5, 2.5, 2])[:views]
    box = mi.ScalarTransform4f().translate([-0.3, 0.35, 0.0]).rotate([0, 1, 0], 30).scale(0.35)
    return {
        "type": "scene",
        **{f"camera_{n}": parts.camera(place, (0, 0.2, 0), 45, resolution) for n, place in enumerate(places)},
        "floor": {"type": "rectangle", "to_world": mi.ScalarTransform4f().rotate([1, 0, 0], -90).scale(2)},
        "box": {"type": "cube", "to_world": box, "bsdf": {"type": "diffuse", "reflectance": parts.colour(0.7)}},
        "lamp": light(name),
    }


def problem(name: str, views: int, seed: int, resolution: int, spp: int, depth: int = 3) -> ur.Problem:
    """The problem, with a start at the given distances in directions of the seed."""
    described, signs = scene(name, views, resolution), np.random.default_rng(seed)
    loaded, path = mi.load_dict(described), mi.load_dict({"type": "path", "max_depth": depth})
    pictures = [np.array(mi.render(loaded, sensor=n, integrator=path, spp=spp, seed=n)) for n in range(views)]
    parameters, truth = [], {}
    for key, distance in UNKNOWN[name].items():
        shape = () if key[-2] == "." else (3,)
        truth[f"lamp.{key}"] = np.zeros(shape, np.float32)
        parameters.append(ur.Parameter(f"lamp.{key}", initial=distance * signs.choice((-1.0, 1.0), shape)))
    seen = [ur.View(picture, sensor) for sensor, picture in enumerate(pictures)]
    return ur.Problem(lambda: scene(name, views, resolution), parameters, seen, max_depth=depth, truth=truth, name=name)


def loop(made: ur.Problem, seconds: float, rate: float, seed: int, resolution: int) -> float:
    """The largest error of the area light's translation at the end of Mitsuba's own loop."""
    loaded = mi.load_dict(scene("area", len(made.views), resolution))
    parameters = mi.traverse(loaded)
    projective = {"type": "prb_projective", "guiding": "none", "sppc": SPP, "sppp": SPP // 2, "sppi": SPP // 2}
    stock = StockViews(made, projective, (loaded, parameters))
    first = mi.Transform4f(parameters["lamp.to_world"])
    adam = mi.ad.Adam(lr=rate)
    adam["shift"] = mi.Point3f(*made.unknowns["lamp.translation"].initial.tolist())
    began = 0.0
    for step in range(1 << 20):
        if step == 1:
            began = time.perf_counter()
        if step and time.perf_counter() - began > seconds:
            break
        parameters["lamp.to_world"] = mi.Transform4f().translate(adam["shift"]) @ first
        parameters.update()
        stock.backward(seed, step, range(len(made.views)))
        adam.step()
    return float(np.abs(np.array(adam["shift"])).max())


def run(
    cases: tuple[str, ...] = tuple(UNKNOWN),
    views: tuple[int, ...] = (1, 3),
    seeds: int = 5,
    steps: int = 20,
    resolution: int = 16,
    reference_spp: int = 1024,
) -> dict[str, Any]:
    """Every case.

    Args:
        cases: lights
        seeds: starts, and random numbers of the runs
    """
    found: dict[str, Any] = {}
    for name in cases:
        for count in views:
            made = [problem(name, count, seed, resolution, reference_spp) for seed in range(seeds)]
            results = [ur.optimize(one, steps=steps, seed=seed) for seed, one in enumerate(made)]
            entry: dict[str, Any] = {
                "errors": {
                    key: [float(np.abs(result.parameters[f"lamp.{key}"]).max()) for result in results]
                    for key in UNKNOWN[name]
                },
                "seconds": float(np.median([result.seconds for result in results])),
            }
            if name == "area":
                tried = {
                    rate: [loop(one, TIMES * entry["seconds"], rate, n, resolution) for n, one in enumerate(made)]
                    for rate in RATES
                }
                entry["loop"] = min(tried.values(), key=lambda errors: float(np.median(errors)))
            found.setdefault(name, {})[str(count)] = entry
            print(name, count, entry, flush=True)
    return {"cases": found}


def _middle(errors: list[float]) -> tuple[float, float]:
    return float(np.median(errors)), max(errors)


def table(record: Record) -> str:
    """Errors at the end, by light and number of pictures."""
    rows = []
    for name, counts in record["cases"].items():
        for count, entry in counts.items():
            for key, errors in entry["errors"].items():
                loop = "{:.2g} ({:.2g})".format(*_middle(entry["loop"])) if "loop" in entry else "no derivative"
                cells = *(f"{x:.2g}" for x in _middle(errors)), f"{entry['seconds']:.2f}", loop
                rows.append([name, count, key, *cells])
    head = "light | pictures | unknown | median error | largest | seconds of `auto` | Mitsuba's loop in three times these: median (largest)"
    settings = "{seeds} starts, {steps} steps, pictures of {resolution}². Errors are largest absolute ones, in scene units or radians."
    return markdown.blocks(settings.format(**record["settings"]), markdown.table(head, rows))
