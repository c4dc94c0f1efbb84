"""Poses of lights from few pictures: a spotlight's aim, those of 16 at once, a projector's pose, places of area lights, the turn of an
environment map and of a sky. A lamp that is a mesh has path gradients with boundary terms, which get the processor time of `auto`.

A floor and a box, small pictures, starts that differ by seed. `auto` takes a fixed number of steps. Mitsuba's own loop (`mi.render`,
`mi.ad.Adam`) turns spotlights and the environment map by `prb`, and moves the area light by `prb_projective`. There the derivatives by the
transforms of the projector and of the sky were 0.04 and 0.16 of differences of pictures. The loop gets three times the seconds of `auto`,
and the better of two rates by the median error of the seeds.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

import unrender as ur
from benchmarks import markdown
from benchmarks.internals import dr, mi, parts
from benchmarks.runner.records import Record
from benchmarks.runner.timing import work_time
from benchmarks.stock_loop import StockViews
from benchmarks.timed_runs import Kept

MERGE = ("cases.*",)
QUICK: dict[str, Any] = {"cases": ("spot",), "views": (1,), "seeds": 1, "steps": 2, "reference_spp": 4}
UNKNOWN: dict[str, dict[str, float]] = {
    "spot": {"lamp.rotation.x": 0.15, "lamp.rotation.z": 0.12},
    "spots": {f"lamp_{n}.rotation.{axis}": 0.12 for n in range(16) for axis in "xz"},
    "places": {f"lamp_{n}.translation.{axis}": 0.15 for n in range(16) for axis in "xz"},
    "projector": {"lamp.translation": 0.2, "lamp.rotation": 0.1},
    "area": {"lamp.translation": 0.4},
    "mesh": {"lamp.translation": 0.4},
    "envmap": {"lamp.rotation.y": 0.5},
    "sunsky": {"lamp.rotation.y": 0.5},
}
"""{light: {key: distance of the start from the truth, in each number}}."""
LARGE: dict[str, dict[str, int]] = {
    "mesh": {"resolution": 48},
    "spots": {"steps": 400, "resolution": 32},
    "places": {"steps": 40, "resolution": 32},
}
"""{light: settings of its own}."""
RATES, SPP, TIMES = (0.01, 0.03), 16, 3
_PROJECTIVE = {"type": "prb_projective", "guiding": "none", "sppc": SPP, "sppp": SPP // 2, "sppi": SPP // 2}
WRONG = "projector", "sunsky"
"""Lights by whose transforms Mitsuba's derivatives are wrong."""
LOOPS: Any = {"area": _PROJECTIVE, "mesh": _PROJECTIVE} | {key: {"type": "prb"} for key in ("spot", "spots", "envmap")}
"""{light: integrator of Mitsuba's loop}."""


def lights(name: str) -> dict[str, Any]:
    """The lights of a case by id."""
    if name not in ("spots", "places"):
        return {"lamp": light(name)}
    colours, found = np.random.default_rng(0).uniform(1.2, 4.0, (16, 3)), {}
    for n, (x, z) in enumerate((x, z) for x in (-1.5, -0.5, 0.5, 1.5) for z in (-1.5, -0.5, 0.5, 1.5)):
        down = mi.ScalarTransform4f().look_at([x, 3.0, z], [0.9 * x, 0.0, 0.9 * z], [1, 0, 0])
        intensity = {"type": "rgb", "value": colours[n].tolist()}
        found[f"lamp_{n}"] = {"type": "spot", "to_world": down, "intensity": intensity}
    return found


def light(name: str) -> dict[str, Any]:
    """The light of a case with one."""
    picture = mi.Bitmap(np.random.default_rng(0).uniform(0.1, 1.0, (8, 8, 3)).astype(np.float32))
    down = mi.ScalarTransform4f().look_at([0.3, 3.0, 1.0], [0.0, 0.0, 0.0], [1, 0, 0])
    match name:
        case "spot":
            return {"type": "spot", "to_world": down, "intensity": 12.0, "cutoff_angle": 25.0}
        case "projector":
            irradiance = {"type": "bitmap", "bitmap": picture, "raw": True}
            return {"type": "projector", "to_world": down, "irradiance": irradiance, "fov": 35.0, "scale": 9.0}
        case "area" | "mesh":
            place = mi.ScalarTransform4f().translate([0.4, 2.2, 0.3]).rotate([1, 0, 0], 90).scale([0.3, 0.3, 0.02])
            kind, emitter = "rectangle" if name == "area" else "cube", {"type": "area", "radiance": parts.colour(12.0)}
            return {"type": kind, "to_world": place, "emitter": emitter}
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
        **lights(name),
    }


def problem(name: str, views: int, seed: int, resolution: int, spp: int, depth: int = 3) -> ur.Problem:
    """The problem, with a start at the given distances in directions of the seed."""
    described, signs = scene(name, views, resolution), np.random.default_rng(seed)
    loaded, path = mi.load_dict(described), mi.load_dict({"type": "path", "max_depth": depth})
    pictures = [np.array(mi.render(loaded, sensor=n, integrator=path, spp=spp, seed=n)) for n in range(views)]
    parameters, truth = [], {}
    for key, distance in UNKNOWN[name].items():
        shape = () if key[-2] == "." else (3,)
        truth[key] = np.zeros(shape, np.float32)
        parameters.append(ur.Parameter(key, initial=distance * signs.choice((-1.0, 1.0), shape)))
    seen = [ur.View(picture, sensor) for sensor, picture in enumerate(pictures)]
    return ur.Problem(lambda: scene(name, views, resolution), parameters, seen, max_depth=depth, truth=truth, name=name)


def by_part(ends: Mapping[str, Any]) -> dict[str, float]:
    """The largest error of each part of a pose, over lights; of several lights the root mean square, too."""
    found: dict[str, float] = {}
    for key, value in ends.items():
        part = key.partition(".")[2]
        found[part] = max(found.get(part, 0.0), float(np.abs(np.array(value)).max()))
    if len(ends) > len(found):
        found["root mean square"] = float(np.sqrt(np.mean(np.square([np.array(value) for value in ends.values()]))))
    return found


def moved(lamp: str, adam: Any, first: Any) -> Any:
    """The transform or vertices of a light in the loop: moved, or turned about its own place."""
    values = {key.partition(".")[2]: value for key, value in adam.items() if key.startswith(f"{lamp}.")}
    if isinstance(first, mi.Float):
        return dr.ravel(dr.unravel(mi.Point3f, first) + values["translation"])
    if "translation" in values:
        return mi.Transform4f().translate(values["translation"]) @ first
    place, turn = first @ mi.Point3f(0), mi.Transform4f()
    for part, value in values.items():
        turn = turn @ mi.Transform4f().rotate([float(part[-1] == axis) for axis in "xyz"], 180 / np.pi * value)
    return mi.Transform4f().translate(place) @ turn @ mi.Transform4f().translate(-place) @ first


def solved(made: ur.Problem, steps: int, seed: int, method: str = "auto", limit: float = math.inf) -> tuple[Any, float]:
    """The largest errors of a method, and its processor seconds."""
    clock = Kept(limit)
    result = ur.optimize(made, method, steps=steps, seed=seed, callbacks=[clock], progress=False)
    return by_part(result.parameters), clock.seconds


def together(ends: Sequence[Mapping[str, float]]) -> dict[str, list[float]]:
    return {part: [end[part] for end in ends] for part in ends[0]}


def loop(made: ur.Problem, name: str, rate: float, seed: int, seconds: float, resolution: int) -> dict[str, float]:
    """The largest errors at the end of Mitsuba's own loop."""
    loaded = mi.load_dict(scene(name, len(made.views), resolution))
    parameters = mi.traverse(loaded)
    stock = StockViews(made, LOOPS[name], (loaded, parameters))
    at = {lamp: f"{lamp}.vertex_positions" if name == "mesh" else f"{lamp}.to_world" for lamp in lights(name)}
    first = {lamp: type(parameters[key])(parameters[key]) for lamp, key in at.items()}
    adam = mi.ad.Adam(lr=rate)
    for key in UNKNOWN[name]:
        start = np.ravel(made.unknowns[key].initial).tolist()
        adam[key] = mi.Point3f(*start) if len(start) > 1 else mi.Float(start)
    began = 0.0
    for step in range(1 << 20):
        if step == 1:
            began = work_time()
        if step and work_time() - began > seconds:
            break
        for lamp, loaded_at in first.items():
            parameters[at[lamp]] = moved(lamp, adam, loaded_at)
        parameters.update()
        stock.backward(seed, step, range(len(made.views)), 0 if LOOPS[name] is _PROJECTIVE else SPP)
        adam.step()
    return by_part(dict(adam.items()))


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
        size = {"steps": steps, "resolution": resolution} | LARGE.get(name, {})
        for count in views:
            made = [problem(name, count, seed, size["resolution"], reference_spp) for seed in range(seeds)]
            runs = [solved(one, size["steps"], seed) for seed, one in enumerate(made)]
            ends, seconds = zip(*runs, strict=True)
            entry: dict[str, Any] = {"errors": together(ends), "seconds": float(np.median(seconds))}
            if name == "mesh":
                paths = [solved(one, 1 << 20, n, "plain", seconds[n])[0] for n, one in enumerate(made)]
                entry["paths"] = together(paths)
            if name in LOOPS:
                given = TIMES * entry["seconds"], size["resolution"]
                tried = [[loop(one, name, rate, n, *given) for n, one in enumerate(made)] for rate in RATES]
                best = min(tried, key=lambda ends: float(np.median([max(end.values()) for end in ends])))
                entry["loop"] = together(best)
            found.setdefault(name, {})[str(count)] = entry
            print(name, count, entry, flush=True)
    return {"cases": found}


def _ends(entry: Mapping[str, Any], side: str, other: str, key: str) -> str:
    return "{:.2g} ({:.2g})".format(*(f(entry[side][key]) for f in (np.median, max))) if side in entry else other


def table(record: Record) -> str:
    """Errors at the end, by light and number of pictures."""
    rows = []
    for name, counts in record["cases"].items():
        for count, entry in counts.items():
            none = "wrong derivative" if name in WRONG else "not measured"
            for key in entry["errors"]:
                ends = (_ends(entry, *of, key) for of in (("errors", ""), ("paths", ""), ("loop", none)))
                rows.append([name, count, key, f"{entry['seconds']:.2f}", *ends])
    head = "light | pictures | unknown | seconds | `auto` | boundary terms | Mitsuba's loop in three times these"
    text = "Largest errors, in scene units or radians: median (largest) of 5 starts, 20 steps, 16² pixels (`spots`: 2 starts, 400 steps, "
    text += "32²; `places`: 2 starts, 40 steps, 32²; `mesh`: 3 starts, 48²)."
    return markdown.blocks(text, markdown.table(head, rows))
