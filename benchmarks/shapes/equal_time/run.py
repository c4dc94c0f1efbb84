"""Meshes from pictures at equal time: `auto` against the stock loop with `prb_projective`, tuned.

The stock loop is that of Mitsuba's tutorial on shapes: `mi.render` with `prb_projective`, `dr.backward`, and `mi.ad.Adam` on the vertices,
or, with one rate for all, on the differential coordinates of `mi.ad.LargeSteps`. It is tuned on a seed of its own, one setting after
another: the rate, whether the boundary of shadows and indirect light is sampled, samples per pixel, λ, and the rate again; without a guide,
whose octree takes seconds at every step.
Textures, where there are any, move by the same Adam. Errors are distances between surfaces, and root mean square differences of pictures
from their references, relative to the start. Time is the processor's, of all threads, so that other work on the machine does not count.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

import unrender as ur
from benchmarks import figures, markdown
from benchmarks.internals import dr, from_tensor, mi, project, stock_scene
from benchmarks.races import TUNING_SEED, first_at, search
from benchmarks.runner.records import Record
from benchmarks.runner.timing import work_time
from benchmarks.stock_loop import StockViews
from benchmarks.timed_runs import POINTS, Point, measured, timed_run

QUICK: dict[str, Any] = {
    "seconds": 0.5, "seeds": 1, "problems": ["sphere-to-bunny"], "resolution": 8, "subdivisions": 1, "views": 2, "rates": [0.01],
    "indirect": [], "spp": [], "strengths": [],
}  # fmt: skip
_TEXTURE_RATE = 0.02
STOCK = ("Adam", "LargeSteps")


@dataclass(frozen=True)
class Setting:
    """Of the stock loop.

    Attributes:
        kind: of `STOCK`.
        rate: of the vertices.
        indirect: samples per pixel of the boundary of shadows and indirect light.
        spp: samples per pixel of the picture, and of the boundary of what the camera sees.
        strength: λ of large steps.
    """

    kind: str
    rate: float = 0.0
    indirect: int = 0
    spp: int = 2
    strength: float = 19.0


def stock_shapes(problem: ur.Problem, setting: Setting, seconds: float, seed: int) -> list[Point]:
    """Take the steps of the stock loop on a problem whose unknowns are the vertices of one mesh, and maybe textures.

    Return (processor seconds, parameters) along the run. Two steps of warm-up and the keeping of parameters are left out of the clock.
    """
    _, parameters = stock_scene(problem)
    (mesh,) = problem.faces
    counts = {"sppc": setting.spp, "sppp": setting.spp, "sppi": setting.indirect, "guiding": "none"}
    stock = StockViews(problem, {"type": "prb_projective", **counts})
    start, views = problem.initial(), range(len(problem.views))
    found = []
    for limit in (2, None):
        for key, value in start.items():
            parameters[key] = from_tensor(value, parameters[key])
        parameters.update()
        large = None
        if setting.kind == "LargeSteps":
            faces = parameters[f"{mesh.rpartition('.')[0]}.faces"]
            large = mi.ad.LargeSteps(parameters[mesh], faces, setting.strength)
        vertices = mi.ad.Adam(lr=setting.rate, uniform=large is not None)
        vertices["u"] = parameters[mesh] if large is None else large.to_differential(parameters[mesh])
        others = mi.ad.Adam(lr=_TEXTURE_RATE)
        for key in start.keys() - {mesh}:
            others[key] = parameters[key]
        clock, step, next_at = 0.0, 0, 0.0
        while step < limit if limit is not None else clock < seconds:
            began = work_time()
            parameters[mesh] = vertices["u"] if large is None else large.from_differential(vertices["u"])
            for key in others.keys():  # noqa: SIM118 (iterating gives pairs)
                others[key] = project(others[key], *problem.unknowns[key].bounds)
                parameters[key] = others[key]
            parameters.update()
            stock.backward(seed, step, views)
            vertices.step()
            others.step()
            dr.eval(vertices["u"])
            dr.sync_thread()
            clock += work_time() - began
            step += 1
            if limit is None and (clock >= next_at or clock >= seconds):
                next_at = clock + seconds / POINTS
                now = {mesh: vertices["u"] if large is None else large.from_differential(vertices["u"])}
                now |= {key: others[key] for key in start.keys() - {mesh}}
                kept = {key: np.array(dr.detach(now[key])).reshape(value.shape) for key, value in start.items()}
                found.append((clock, {key: value.astype(np.float32) for key, value in kept.items()}))
    return found


def ours(problem: ur.Problem, seconds: float, seed: int) -> dict[str, Any]:
    """`auto`, no option given."""
    return measured(problem, timed_run(problem, seconds, seed).found)


def tuned(
    problem: ur.Problem, kind: str, seconds: float, rates: Sequence[float], others: Mapping[str, Sequence[float]]
) -> Setting:
    """The setting of least surface error that the search meets: rates, then the others one after another, then half and twice the rate."""
    (key,) = problem.faces

    def final(setting: Setting) -> float:
        return problem.parameter_error(stock_shapes(problem, setting, seconds, TUNING_SEED)[-1][1])[key]

    best = Setting(kind)
    rate, tried = search(tuple(rates), lambda rate: final(replace(best, rate=rate)))
    best, least = replace(best, rate=rate), min(one["error"] for one in tried)
    trials = [{name: value} for name, values in others.items() for value in values]
    for change in (*trials, {"rate": 0.5}, {"rate": 2.0}):
        if kind == "Adam" and "strength" in change:
            continue
        other = replace(best, rate=best.rate * change["rate"]) if "rate" in change else replace(best, **change)
        if (error := final(other)) < least:
            best, least = other, error
    return best


def race(
    problem: ur.Problem, seconds: float, seeds: int, rates: Sequence[float], others: Mapping[str, Sequence[float]]
) -> dict[str, Any]:
    """All methods on one problem, the stock loops tuned first."""
    found: dict[str, Any] = {"auto": {"runs": []}}
    settings = {}
    for kind in STOCK:
        settings[kind] = tuned(problem, kind, seconds, rates, others)
        found[kind] = {**asdict(settings[kind]), "runs": []}
        print(settings[kind], flush=True)
    for seed in range(seeds):
        found["auto"]["runs"].append(ours(problem, seconds, seed))
        for kind in STOCK:
            found[kind]["runs"].append(measured(problem, stock_shapes(problem, settings[kind], seconds, seed)))
    best_final = min(float(np.median([run["surface"] for run in found[kind]["runs"]])) for kind in STOCK)
    reached = (first_at(run["curve"], best_final) for run in found["auto"]["runs"])
    found["seconds to the stock loops' best"] = [at if math.isfinite(at) else None for at in reached]
    return found


def run(
    seconds: float = 60.0,
    seeds: int = 3,
    problems: tuple[str, ...] = ("sphere-to-bunny", "statue"),
    resolution: int = 64,
    subdivisions: int = 4,
    views: int = 6,
    rates: tuple[float, ...] = (0.003, 0.01, 0.03, 0.1),
    indirect: tuple[int, ...] = (2,),
    spp: tuple[int, ...] = (4, 8),
    strengths: tuple[float, ...] = (5.0, 50.0),
) -> Iterator[dict[str, Any]]:
    """Every problem.

    Args:
        seconds: of a run, of the processor
        problems: of the gallery, whose surfaces are known
        subdivisions: of the sphere
        rates: of the stock loops, tried on a seed of its own
        indirect: samples per pixel of the stock loops' boundary of shadows and indirect light, likewise, beside 0
        spp: samples per pixel of the stock loops, beside 2
        strengths: λ of the stock loop of large steps, beside 19
    """
    found, others = {}, {"indirect": indirect, "spp": spp, "strength": strengths}
    for name in problems:
        problem = ur.gallery.problem(name, resolution=resolution, subdivisions=subdivisions, views=views)
        found[name] = race(problem, seconds, seeds, rates, others)
        print(name, found[name]["seconds to the stock loops' best"], flush=True)
        yield {"problems": found}


def table(record: Record) -> str:
    """What was left of the errors, and when `auto` was where the stock loops ended."""
    rows = []
    for name, found in record["problems"].items():
        for method, of in ((method, of) for method, of in found.items() if "runs" in of):
            finals = [markdown.spread([run[what] for run in of["runs"]]) for what in ("surface", "pictures")]
            names = ("rate", "spp", "indirect", "strength") if method == "LargeSteps" else ("rate", "spp", "indirect")
            tuned = ", ".join(f"{of[name]:g}" for name in names) if "rate" in of else ""
            reached = found["seconds to the stock loops' best"] if method == "auto" else []
            when = ", ".join("never" if at is None else f"{at:.1f} s" for at in reached)
            rows.append([name, method, tuned, *finals, when])
    head = "problem | method | rate, spp, indirect spp, λ | surface error | picture error | at the best stock loop's end after"
    text = "Of the start's, after {seconds:g} s of the processor, {seeds} seeds: median (least to greatest)."
    return markdown.blocks(text.format(**record["settings"]), markdown.table(head, rows))


def plot(record: Record) -> figures.Figure:
    panels = {name: figures.run_curves(found) for name, found in record["problems"].items()}
    return figures.curves(panels, "processor seconds", "surface error / at the start")
