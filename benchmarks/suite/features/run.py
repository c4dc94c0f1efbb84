"""Ties, expressions, worlds, priors, AOVs, displacement, a caustic and spectra: `auto` against Mitsuba's loop, written for each by hand.

The loop sets tied and derived parameters itself, renders worlds in scenes of their own, and adds the priors' derivatives. AOVs are those of
Mitsuba's `aov` integrator, and caustics are rendered by `ptracer`. It is tuned over samples per pixel and rates on a seed of its own.
Errors are means over unknowns, relative to the start. Seconds are the processor's.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

import unrender as ur
from benchmarks import markdown
from benchmarks.internals import Lenses, Relief, dr, mi, parts
from benchmarks.races import TUNING_SEED, relative_error, search
from benchmarks.runner.records import Record
from benchmarks.runner.timing import work_time
from benchmarks.suite.run import Points, compare, loop
from benchmarks.timed_runs import timed_run

MERGE = ("problems.*",)
QUICK: dict[str, Any] = {"problem": ("ties",), "seconds": 0.3, "seeds": 1, "spp": (2,), "rates": (0.02,)}
LEFT, RIGHT = "left.bsdf.reflectance.data", "right.bsdf.reflectance.data"
NEAR, FAR = "near.emitter.radiance.value", "far.emitter.radiance.value"
_SIDE, _TEXELS, _DARK = 32, 16, [0.0, 0.0, 0.0]
_PTRACER = {"type": "ptracer", "hide_emitters": False}


def picture() -> np.ndarray:
    """The true texture of both panels."""
    return parts.photograph("coffee", _TEXELS)


def _scene() -> dict[str, Any]:
    """Two textured panels on a floor under two lamps."""

    def panel(x: float) -> dict[str, Any]:
        paint = {"type": "diffuse", "reflectance": parts.bitmap(picture())}
        return parts.rectangle((x, 0, -0.3), (0.7, 0, 0.3 * np.sign(x)), (0, 0.8, 0), paint)

    def lamp(z: float) -> dict[str, Any]:
        return parts.rectangle(
            (0, 2, z), (0.4, 0, 0), (0, 0, 0.4), parts.diffuse(0.0), emitter=parts.light(1.5, 1.5, 1.5)
        )

    floor = parts.rectangle((0, -0.8, 0.5), (2, 0, 0), (0, 0, -1.5), parts.diffuse(0.6))
    camera = parts.camera((0, 0.3, 3.4), (0, 0, 0), 42, _SIDE)
    return {"type": "scene", "camera": camera, "left": panel(-0.75), "right": panel(0.75), "floor": floor} | {
        "near": lamp(2.0),
        "far": lamp(0.8),
    }


def _made(
    unknown: list[ur.Parameter], truth: dict[str, Any], worlds: tuple[Any, ...] = ({},), spp: int = 2048, **more: Any
) -> ur.Problem:
    """A problem of the panels, with references of our own, one for the known values of each world."""
    blank = [ur.View(np.ones((_SIDE, _SIDE, 3), np.float32), known=known) for known in worlds]
    made = ur.Problem(_scene, unknown, blank, max_depth=3, truth=truth, **more)
    references = [ur.render(made, made.truth, n, spp=spp, seed=n) for n in range(len(worlds))]
    return made.replaced(views=[ur.View(x, known=known) for x, known in zip(references, worlds, strict=True)])


def ties() -> ur.Problem:
    """One texture on both panels."""
    return _made([ur.Parameter("paint", initial=0.5, keys=[LEFT, RIGHT])], {"paint": picture()})


def expressions() -> ur.Problem:
    """One pattern, the mixture of two colours on the left and of two others on the right."""
    texts = {
        LEFT: "mix([0.1, 0.1, 0.2], [0.9, 0.8, 0.6], pattern)",
        RIGHT: "mix([0.7, 0.2, 0.1], [0.2, 0.5, 0.8], pattern)",
    }
    unknown = ur.Parameter("pattern", initial=np.full((_TEXELS, _TEXELS, 1), 0.5), bounds=(0.0, 1.0))
    return _made([unknown], {"pattern": picture().mean(axis=-1, keepdims=True)}, expressions=texts)


def worlds() -> ur.Problem:
    """The left panel's texture and two lamps from three views: both lamps, and each alone."""
    unknown = [ur.Parameter(LEFT, initial=0.5), *(ur.Parameter(key, initial=0.75) for key in (NEAR, FAR))]
    return _made(unknown, {LEFT: picture(), NEAR: [1.5] * 3, FAR: [1.5] * 3}, ({}, {NEAR: _DARK}, {FAR: _DARK}))


def priors() -> ur.Problem:
    """A texture with a total variation, from a noisy reference."""
    unknown = ur.Parameter(LEFT, initial=0.5, prior={"total_variation": 0.2})
    return _made([unknown], {LEFT: picture()}, spp=4)


def displacement() -> ur.Problem:
    """The gallery's height map under three lamps, each lit alone."""
    return ur.gallery.problem("relief", resolution=32, height_resolution=16)


def depth(name: str = "depth") -> ur.Problem:
    """The same height map from one map of depths, or of another AOV."""
    scene = mi.load_dict(Relief(resolution=32, height_resolution=16).target())
    aov = mi.load_dict({"type": "aov", "aovs": f"seen:{name}"})
    found = np.array(mi.render(scene, integrator=aov, spp=256))[..., : 1 if name == "depth" else 3]
    return displacement().replaced(views=[ur.View(found, aov=name)])


class _Gaussian(Lenses):
    """The lenses with Mitsuba's default filter: the place at which `ptracer` splats a path has no derivative with a box."""

    def _stage(self, heights: np.ndarray) -> dict[str, Any]:
        stage = super()._stage(heights)
        stage["camera"]["film"]["rfilter"] = {"type": "gaussian"}
        return stage


def caustic() -> ur.Problem:
    """Heights of three lenses from their caustics."""
    return _Gaussian(resolution=24, mesh_resolution=32).problem("lenses")


def spectra() -> ur.Problem:
    """The roughness of the gallery's chalice, in the spectral variant from here on, where Mitsuba's colours are no RGB."""
    ur.use((mi.variant() or "").replace("rgb", "spectral"))
    return ur.gallery.problem("chalice", resolution=32, texture_resolution=32)


PROBLEMS: dict[str, Callable[..., ur.Problem]] = {
    made.__name__: made for made in (ties, expressions, worlds, priors, displacement, caustic, depth)
}
PROBLEMS |= {"normals": lambda: depth("sh_normal"), "positions": lambda: depth("position"), "spectra": spectra}


def run(
    problem: tuple[str, ...] = tuple(PROBLEMS),
    seconds: float = 4.0,
    seeds: int = 3,
    spp: tuple[int, ...] = (4, 16),
    rates: tuple[float, ...] = (0.005, 0.02, 0.05),
) -> Iterator[dict[str, Any]]:
    for name in problem:
        made = PROBLEMS[name]()
        error = relative_error(made)
        integrator = _PTRACER if name == "caustic" else None

        def theirs_of(
            n: int, rate: float, seed: int, made: Any = made, error: Any = error, of: Any = integrator
        ) -> Points:
            return loop(made, error, seconds, seed, 2, {"spp": n, "rate": rate, "falling": False}, work_time, of)

        tuned = {n: search(rates, lambda rate, n=n, of=theirs_of: of(n, rate, TUNING_SEED)[-1][1]) for n in spp}
        samples = min(tuned, key=lambda n: min(one["error"] for one in tuned[n][1]))
        theirs = [theirs_of(samples, tuned[samples][0], seed) for seed in range(seeds)]
        kept = (timed_run(made, seconds, seed) for seed in range(seeds))
        mine = [[(at, error(values)) for at, values in one.found] for one in kept]
        found = compare(theirs, mine, seconds)
        found |= {"setting": [samples, tuned[samples][0]], "tried": sum(len(tried) for _, tried in tuned.values())}
        found["settings"] = {"seconds": seconds, "seeds": seeds, "spp": list(spp), "rates": list(rates)}
        print(name, found, flush=True)
        yield {"problems": {name: found}}
        del made
        dr.sync_thread()


def table(record: Record) -> str:
    """Errors at the end, and the speed-up."""
    rows = []
    for name, entry in record["problems"].items():
        ends = [markdown.spread(entry["final"][side]) for side in ("loop", "auto")]
        speed = f"{entry['speed']:.2g}" if entry["speed"] else "below 1"
        tried = "{seconds:g} s, {seeds} seeds".format(**entry["settings"])
        rows.append([name, tried, "{} spp, rate {:g}".format(*entry["setting"]), *ends, speed])
    head = "problem | of the processor | the loop's setting | error of the loop | of `auto` | speed-up"
    text = "Median (least to greatest), relative to the start."
    return markdown.blocks(text, markdown.table(head, rows))
