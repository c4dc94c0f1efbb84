"""Photographs: held-out ones against the hull with photographs projected on it, a stock loop and each method, at equal time.

The folder holds posed photographs with masks, such as an LLFF capture. One import makes the hull, the atlas and the unknowns; all start
from it.
"projection": each texel has the mean of the training photographs that see it, weighted by the square of the cosine. "stock": `mi.render`
of a few views a step, `dr.backward`, `mi.ad.Adam`, values clipped, tuned over samples and rates; the best by held-out photographs is
kept, which is in its favour. PSNR is as displayed, inside the masks, the mean of the held-out photographs.
"""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

import unrender as ur
from benchmarks.internals import dr, from_tensor, project, stock_scene
from benchmarks.photographs.projection import Projection
from benchmarks.runner.records import scratch
from unrender import methods
from unrender.capture import importing
from unrender.judging.measures import measure

METHODS: dict[str, dict[str, Any]] = {
    "auto": {},
    "adaptive": {"pixels": 16384, "spp": 8, "learning_rate": 0.02},
    "plain": {"spp": 2, "learning_rate": 0.02},
    "rcv": {"spp": 2, "learning_rate": 0.02},
}
UNKNOWNS = ("colour", "roughness", "metallic", "light")
QUICK = {
    "seconds": 0.2,
    "resolution": 16,
    "texture": 16,
    "faces": 300,
    "method": ("auto",),
    "spp": (2,),
    "rates": (0.02,),
    "final_spp": 2,
}


class Judge:
    """Held-out photographs of an import."""

    def __init__(self, folder: Path, keys: list[str], spp: int):
        given = ur.Problem.from_file(folder / "held-out.toml")
        parameters = [ur.Parameter(key) for key in keys]
        self.problem = ur.Problem(given.origin["scene"], parameters, given.given_views, max_depth=given.max_depth)
        self.spp = spp

    def psnr(self, image: Callable[[int], np.ndarray]) -> list[float]:
        """Of the pictures of all held-out views."""
        return [
            measure(image(index), np.asarray(view.reference), np.asarray(view.mask)).psnr
            for index, view in enumerate(self.problem.views)
        ]

    def of(self, values: dict[str, np.ndarray]) -> list[float]:
        """Of a result."""
        return self.psnr(lambda view: np.asarray(ur.render(self.problem, values, view=view, spp=self.spp)))


def stock(problem: ur.Problem, spp: int, rate: float, seconds: float, views: int, seed: int) -> tuple[dict, int]:
    """The usual loop over random views; its values, and how many steps it took. A step with each view, to warm up, does not count."""
    scene, parameters = stock_scene(problem)
    integrator = mi.load_dict({"type": "prb", "max_depth": problem.max_depth})
    start, rng, step = problem.initial(), np.random.default_rng(seed), 0
    optimizer: Any = None
    for warm in (True, False):
        optimizer = mi.ad.Adam(lr=rate)
        for key, value in start.items():
            optimizer[key] = from_tensor(value, parameters[key])
        parameters.update(optimizer)
        clock, step = 0.0, 0
        while step < len(problem.views) if warm else clock < seconds:
            began = time.perf_counter()
            loss: Any = 0.0
            drawn = rng.choice(len(problem.views), min(views, len(problem.views)), replace=False)
            for view in [step] if warm else drawn:
                number = int(rng.integers(1 << 30))
                sensor = problem.views[view].sensor
                image = mi.render(
                    scene,
                    parameters,
                    sensor=sensor,
                    integrator=integrator,
                    spp=1 if warm else spp,
                    seed=mi.UInt32(number),
                    seed_grad=number + 1,
                )
                loss += problem.loss_value(int(view), image)
            dr.backward(loss)
            optimizer.step()
            for key in start:
                optimizer[key] = project(optimizer[key], *problem.bounds[key])
            parameters.update(optimizer)
            dr.sync_thread()
            clock += time.perf_counter() - began
            step += 1
    shapes = {key: tuple(value.shape) for key, value in start.items()}
    return {key: np.array(dr.ravel(optimizer[key])).reshape(shape) for key, shape in shapes.items()}, step


def prepare(photographs: Path, folder: Path, resolution: int, texture: int, faces: int) -> None:
    """Import the photographs."""
    shutil.rmtree(folder, ignore_errors=True)
    options = importing.ImportOptions(resolution=resolution, texture=texture, faces=faces, unknowns=UNKNOWNS)
    importing.import_capture(photographs, folder, options)


def run(
    photographs: Path,
    seconds: float = 60.0,
    resolution: int = 250,
    texture: int = 256,
    faces: int = 10_000,
    method: tuple[str, ...] = tuple(METHODS),
    spp: tuple[int, ...] = (8, 32),
    rates: tuple[float, ...] = (0.01, 0.03),
    stock_views: int = 2,
    seeds: int = 1,
    final_spp: int = 32,
) -> dict[str, Any]:
    """All on one import.

    Args:
        photographs: folder of the capture
        seconds: budget of each descent, without compiling
        spp: of the stock loop, tried with each of the rates
        stock_views: views a step of the stock loop
        final_spp: of the pictures that are measured
    """
    folder = scratch("photographs/asset")
    prepare(photographs, folder, resolution, texture, faces)
    problem = ur.Problem.from_file(folder / "problem.toml")
    judge = Judge(folder, [parameter.key for parameter in problem.parameters], final_spp)
    sizes = {"views": len(problem.views), "held_out": len(judge.problem.views), "pixels": problem.pixels}
    found: dict[str, Any] = {"start": {"psnr": [judge.of(problem.initial_values())]}}
    projection = Projection(folder, problem, texture)
    found["projection"] = {"psnr": [judge.psnr(lambda view: projection.picture(judge.problem, view))]}
    print({name: np.mean(row["psnr"]) for name, row in found.items()}, flush=True)
    for name in method:
        parts = method_parts(name, problem)
        rows = found.setdefault(name, {"psnr": [], "steps": [], "settings": METHODS[name]})
        for seed in range(seeds):
            result = ur.optimize(problem, *parts, seconds=seconds, seed=seed)
            rows["psnr"].append(judge.of(result.parameters))
            rows["steps"].append(len(result.history))
            print(name, seed, rows["steps"][-1], np.mean(rows["psnr"][-1]), flush=True)
    grid: list[dict[str, Any]] = []
    for samples in spp:
        for rate in rates:
            values, steps = stock(problem, samples, rate, seconds, stock_views, 0)
            grid.append({"spp": samples, "rate": rate, "steps": steps, "psnr": judge.of(values)})
            print("stock", samples, rate, steps, np.mean(grid[-1]["psnr"]), flush=True)
    best = max(grid, key=lambda row: np.mean(row["psnr"]))
    found["stock"] = {
        "psnr": [best["psnr"]],
        "steps": [best["steps"]],
        "settings": {k: best[k] for k in ("spp", "rate")},
    }
    for seed in range(1, seeds):
        values, steps = stock(problem, best["spp"], best["rate"], seconds, stock_views, seed)
        found["stock"]["psnr"].append(judge.of(values))
        found["stock"]["steps"].append(steps)
    return {"sizes": sizes, "found": found, "grid": grid, "seconds": seconds}


def method_parts(name: str, problem: ur.Problem) -> tuple[Any, Any]:
    """Estimator and optimizer of a method for the problem."""
    choice = methods.method(name).choose(problem, METHODS[name])
    return choice.estimator, choice.optimizer
