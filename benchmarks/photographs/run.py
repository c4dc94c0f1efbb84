"""Photographs: held-out ones against the hull with photographs projected on it, a stock loop, stages and `auto`, at equal time or steps.

The folder holds posed photographs with masks, such as an LLFF capture. One import makes the hull, the atlas and the unknowns, a normal map
among them; all start from it.
"projection": each texel has the mean of the training photographs that see it, weighted by the square of the cosine. "stages": the file that
the import writes, as `unrender run stages.toml` has it; "stages-flat": that of an import without normals, with roughness from 0.02; "auto":
one run of all unknowns. "stock": `mi.render` of a few views a step, `dr.backward`, `mi.ad.Adam`, values clipped, with the
unknowns of "stages-flat"; "stock-normals": with those of "stages". Both are tuned over samples and rates; the best by held-out photographs
is kept, which is in its favour. Seconds are of one thread of the processor, so that others on the machine cost nobody steps; what compiles
before the first step does not count. PSNR is as displayed, inside the masks, the mean of the held-out photographs.

A folder of one camera under known lights has a plate with a colour and a normal per pixel in place of a hull, held-out
lights, and "least-squares" (Woodham 1980) as a further entrant.
"""

from __future__ import annotations

import os
import shutil
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

import unrender as ur
from benchmarks import figures, markdown
from benchmarks.internals import StagedProblem, dr, method, stages_file
from benchmarks.photographs.projection import Projection
from benchmarks.runner.records import Record, scratch
from benchmarks.stock_loop import stock_loop
from benchmarks.timed_runs import Kept
from unrender.app.capture import formats, importing, photometric_folder
from unrender.app.evaluation.measures import measure

ENTRANTS = ("start", "projection", "stages", "stages-flat", "auto", "stock", "stock-normals", "least-squares")
FLAT = ("colour", "roughness", "metallic", "light")
LAST_RATE = 1 / 20
"""Of the stock loop's falling rates, as a share of the first."""
MERGE = ("races.*.found", "maps")
QUICK = {
    "seconds": 0.2, "resolution": 16, "texture": 16, "faces": 300, "spp": (2,), "rates": (0.02,), "final_spp": 2,
    "entrant": ("start", "projection", "stages", "auto", "stock", "stock-normals"),
}  # fmt: skip


class Judge:
    """Held-out photographs of an import."""

    def __init__(self, folder: Path, keys: list[str], spp: int):
        given = ur.Problem.from_file(folder / "held-out.toml")
        parameters = [ur.Parameter(key) for key in keys]
        self.problem = ur.Problem(given.origin["scene"], parameters, given.original_views, max_depth=given.max_depth)
        self.folder, self.spp = folder, spp
        self.picture = np.zeros(0)

    def psnr(self, image: Callable[[int], np.ndarray]) -> list[float]:
        """Of the pictures of all held-out views; the first is kept as `picture`."""
        pictures = [image(index) for index in range(len(self.problem.views))]
        self.picture = pictures[0]
        return [
            measure(picture, np.asarray(view.reference), np.asarray(view.mask)).psnr
            for picture, view in zip(pictures, self.problem.views, strict=True)
        ]

    def cut(self, picture: np.ndarray) -> np.ndarray:
        """What a picture of the first held-out view shows inside the mask, cropped to it; white elsewhere."""
        mask = np.asarray(self.problem.views[0].mask) > 0
        rows, columns = np.nonzero(mask)
        box = slice(rows.min(), rows.max() + 1), slice(columns.min(), columns.max() + 1)
        return np.where(mask[..., None], picture, 1.0)[box]

    def of(self, values: dict[str, np.ndarray]) -> list[float]:
        """Of a result."""
        return self.psnr(lambda view: np.asarray(ur.render(self.problem, values, view=view, spp=self.spp)))


def by_least_squares(photographs: Path, resolution: int) -> Callable[[int], np.ndarray]:
    """Return the pictures of held-out lights, by number, by normals and colours from least squares over the others."""
    views = photometric_folder.prepare(formats.lights.read(photographs), resolution, None, None)
    kept, held_out = views.training, views.directions[np.flatnonzero(views.held_out)]
    normal, colour = photometric_folder.least_squares(views.values[kept], views.directions[kept])
    return lambda index: colour * np.maximum(normal @ held_out[index], 0.0)[..., None]


def stock(problem: ur.Problem, spp: int, rate: float, falling: bool, seconds: float, seed: int) -> tuple[dict, int]:
    """The usual loop over two random views a step; its values and its number of steps, without the warm-up of a step with each view.

    With `falling`, the rate falls exponentially, to a twentieth at the end.
    """
    options: dict[str, Any] = {"fall": (lambda done: LAST_RATE**done) if falling else None, "views": 2}
    options["error"] = lambda values: {key: np.array(value) for key, value in values.items()}
    options["timer"] = time.process_time
    (end,) = stock_loop(problem, spp, rate, seconds, seed=seed, every=sys.maxsize, **options)
    return end["parameter_error"], end["step"] + 1


def in_stages(folder: Path, seconds: float, seed: int) -> tuple[dict[str, np.ndarray], int]:
    """What the stages of an import find, and in how many steps."""
    stages = stages_file.read(folder / stages_file.FILE)
    whole = StagedProblem.read(stages)
    shares = [share or 0.0 for _, share in stages_file.split(replace(stages, steps=None, seconds=seconds))]
    values: dict[str, np.ndarray] = {}
    steps = 0
    for index, (stage, share) in enumerate(zip(stages.stages, shares, strict=True)):
        problem = whole.of_stage(stage, values, folder / "scenes" / stage.name)
        plan = method(stage.method or stages.method).plan(problem, stages.settings_of(stage))
        clock = Kept(share, points=1)
        result = ur.optimize(problem, plan, steps=1_000_000, seed=seed + index, callbacks=[clock])
        values |= {key: np.asarray(value) for key, value in result.parameters.items()}
        steps += clock.steps
    return values, steps


def run(
    photographs: Path | None = None,
    seconds: float = 60.0,
    resolution: int = 96,
    texture: int = 256,
    faces: int = 10_000,
    entrant: tuple[str, ...] = ENTRANTS,
    spp: tuple[int, ...] = (4,),
    rates: tuple[float, ...] = (0.003, 0.01),
    falling: tuple[float, ...] = (),
    seeds: int = 1,
    final_spp: int = 64,
    steps: int | None = None,
) -> Iterator[dict[str, Any]]:
    """A part for each entrant, all on one import.

    Args:
        photographs: folder of a capture; left out, photographs of a vase that the project renders
        seconds: of the processor, for each descent, without compiling
        entrant: who takes part; the others' figures stay
        spp: of the stock loop, tried with each of the rates
        rates: of the stock loop, that stay
        falling: likewise, that fall to a twentieth
        final_spp: of the pictures that are measured
        steps: after which `auto` ends if its time has not; such runs have a race of their own
    """
    dr.set_thread_count(1)
    own = photographs is None
    name = "vase" if photographs is None else photographs.resolve().name
    folder = scratch(f"photographs/{name}-{resolution}-{'-'.join(entrant)}-{os.getpid()}")
    shutil.rmtree(folder)
    given = photographs or ur.gallery.photographs(folder / "photographs", size=resolution, spp=64)
    imports: dict[str, tuple[ur.Problem, Judge]] = {}
    maps: dict[str, np.ndarray] = {}
    settings = [(s, r, falls) for s in spp for falls, rs in ((False, rates), (True, falling)) for r in rs]
    for who in entrant:
        kind = "flat" if who in ("stock", "stages-flat") else "normals"
        if kind not in imports:
            # The others' scenes would be in all kernels.
            imports.clear()
            unknowns = FLAT if kind == "flat" else None
            options = importing.ImportOptions(resolution=resolution, texture=texture, faces=faces, unknowns=unknowns)
            if formats.is_lit(given, None):
                options = importing.ImportOptions(resolution=resolution)
            importing.import_capture(given, folder / kind, options, overwrite=True)
            problem = ur.Problem.from_file(folder / kind / "problem.toml")
            keys = [parameter.key for parameter in problem.parameters]
            imports[kind] = problem, Judge(folder / kind, keys, final_spp)
        problem, judge = imports[kind]
        found: dict[str, Any] = {"psnr": [], "steps": []}
        if who == "start":
            found = {"psnr": [judge.of(problem.initial_values())]}
        elif who == "projection":
            projection = Projection(judge.folder, problem, texture)
            found = {"psnr": [judge.psnr(lambda view, by=projection, of=judge: by.picture(of.problem, view))]}
        elif who == "least-squares":
            found = {"psnr": [judge.psnr(by_least_squares(given, resolution))]}
        elif who in ("stock", "stock-normals"):
            found = tuned(problem, judge, settings, seconds, seeds)
        else:
            for seed in range(seeds):
                if who in ("stages", "stages-flat"):
                    values, taken = in_stages(judge.folder, seconds, 100 * seed)
                else:
                    clock = Kept(seconds, 1, steps)
                    plan = method("auto").plan(problem)
                    result = ur.optimize(problem, plan, steps=steps or 1_000_000, seed=seed, callbacks=[clock])
                    values, taken = result.parameters, clock.steps
                found["psnr"].append(judge.of(values))
                found["steps"].append(taken)
                print(who, seed, taken, np.mean(found["psnr"][-1]), flush=True)
        print(who, np.mean(found["psnr"]), flush=True)
        race = f"{name}, {resolution}, {steps or seconds:g}{' steps' if steps else ''}"
        conditions = {"views": len(problem.views), "held_out": len(judge.problem.views)}
        conditions |= {"pixels": problem.pixels, "seconds": seconds}
        part: dict[str, Any] = {"races": {race: {**conditions, "found": {who: found}}}}
        if own:
            maps["photograph"] = judge.cut(np.asarray(judge.problem.views[0].reference))
            maps[who] = judge.cut(judge.picture)
            part["maps"] = maps
        yield part
    shutil.rmtree(folder)


def tuned(
    problem: ur.Problem, judge: Judge, settings: list[tuple[int, float, bool]], seconds: float, seeds: int
) -> dict[str, Any]:
    """The stock loop with each of the settings, samples, rate and whether that falls; then further seeds of the best."""
    tried: list[dict[str, Any]] = []
    pictures = []
    for samples, rate, falling in settings:
        values, steps = stock(problem, samples, rate, falling, seconds, 0)
        tried.append({"spp": samples, "rate": rate, "falling": falling, "steps": steps, "psnr": judge.of(values)})
        pictures.append(judge.picture)
        print("stock", samples, rate, "falling" if falling else "", steps, np.mean(tried[-1]["psnr"]), flush=True)
    best = max(tried, key=lambda row: np.mean(row["psnr"]))
    judge.picture = pictures[tried.index(best)]
    found: dict[str, Any] = {"psnr": [best["psnr"]], "steps": [best["steps"]], "tried": tried}
    found["settings"] = {key: best[key] for key in ("spp", "rate", "falling")}
    for seed in range(1, seeds):
        values, steps = stock(problem, best["spp"], best["rate"], best["falling"], seconds, seed)
        found["psnr"].append(judge.of(values))
        found["steps"].append(steps)
    return found


def table(record: Record) -> str:
    """Held-out PSNR of each, of each capture, resolution and time."""
    races = sorted(record["races"].items(), key=lambda item: (item[1]["pixels"], item[1]["seconds"]))
    return markdown.blocks(*(_race(name, race) for name, race in races))


def _race(name: str, race: Record) -> str:
    rows, tried = [], []
    for who, entry in race["found"].items():
        means = [float(np.mean(one)) for one in entry["psnr"]]
        spread = f" ± {np.std(means):.2f}" if len(means) > 1 else ""
        given = {key: value for key, value in entry.get("settings", {}).items() if value is not False}
        settings = ", ".join(key if value is True else f"{key} {value:g}" for key, value in given.items())
        steps = f"{np.mean(entry['steps']):.0f}" if "steps" in entry else ""
        worst = f"{min(entry['psnr'][0]):.2f}"
        rows.append([who, f"{np.mean(means):.2f}{spread}", worst, len(means), steps, settings])
        for row in entry.get("tried", []):
            rate = f"{row['rate']:g}{' falling' if row.get('falling') else ''}"
            tried.append([who, row["spp"], rate, row["steps"], f"{np.mean(row['psnr']):.2f}"])
    capture, size, budget = name.rsplit(", ", 2)
    counts = f"{race['views']} photographs of {size} pixels along the longer side, {race['held_out']} more held out"
    given = budget if budget.endswith("steps") else f"{budget} s of the processor each"
    parts = [
        f"{capture}: {counts}, {given}.",
        markdown.table(" | held-out PSNR (dB) | the worst of them | seeds | steps | settings", rows),
    ]
    if tried:
        parts.append(markdown.table("tried | spp | rate | steps | held-out PSNR (dB)", tried))
    return markdown.blocks(*parts)


def plot(record: Record) -> figures.Figure:
    """A held-out photograph of the vase that the project renders, and what each makes of it."""
    maps = record["maps"]
    shown = ("photograph", "projection", "stock", "stock-normals", "stages")
    return figures.pictures([{name: maps[name] for name in shown if name in maps}])
