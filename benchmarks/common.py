# Dr.Jit's stubs know less than its functions return.
# pyright: reportArgumentType=false, reportAttributeAccessIssue=false, reportReturnType=false

"""What the benchmarks share: the stock loop they compare with, records, hardware, pictures."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import drjit as dr
import matplotlib
import mitsuba as mi
import numpy as np

import unrender as ur
from unrender.problem.bounds import project
from unrender.rendering.mitsuba.renderer import MitsubaRenderer
from unrender.rendering.mitsuba.tensors import from_tensor
from unrender.runs.result import hardware, versions

matplotlib.use("Agg")


def write(folder: Path, figures: dict[str, Any]) -> None:
    """Write results.json beside the script, with hardware, versions and the command that made it; those of figures that were read back
    and added to give way."""
    folder.mkdir(parents=True, exist_ok=True)
    made = {"command": " ".join(["python", *sys.argv]), "hardware": hardware(), "versions": versions()}
    record = made | figures | made
    (folder / "results.json").write_text(json.dumps(record, indent=1) + "\n")
    print(f"wrote {folder / 'results.json'}")


def read(folder: Path) -> dict[str, Any]:
    """The figures that `write` left."""
    return json.loads((folder / "results.json").read_text())


def mitsuba_renderer(problem: ur.Problem) -> MitsubaRenderer:
    """The problem's renderer, known to be Mitsuba's."""
    assert isinstance(problem.renderer, MitsubaRenderer)
    return problem.renderer


def stock_loop(
    problem: ur.Problem,
    spp: int,
    learning_rate: float,
    seconds: float = float("inf"),
    steps: int = sys.maxsize,
    seed: int = 0,
    every: int = 5,
) -> list[dict[str, Any]]:
    """The usual loop, as Mitsuba's tutorials write it: `mi.render` with `prb`, `dr.backward`, `mi.ad.Adam`, values clipped.

    Warm-up (two steps) and error measurement are left out of the clock, as in `ur.optimize`. Returns its history.
    """
    scene = mitsuba_renderer(problem).pair.previous
    parameters = mitsuba_renderer(problem).pair.previous_parameters
    integrator = mi.load_dict({"type": "prb", "max_depth": problem.max_depth})
    start = problem.initial()
    history: list[dict[str, Any]] = []
    for warm in (True, False):
        rates = {key: problem.learning_rates.get(key, learning_rate) for key in start}
        optimizer = mi.ad.Adam(lr=learning_rate)
        for key, value in start.items():
            optimizer[key] = from_tensor(value, parameters[key])
        optimizer.set_learning_rate(rates)
        parameters.update(optimizer)
        clock, step = 0.0, 0
        while clock < seconds and step < (2 if warm else steps):
            began = time.perf_counter()
            loss = 0.0
            for view in range(len(problem.views)):
                number = (seed * 1_000_003 + step * 64 + view) * 2 % 2**31
                image = mi.render(
                    scene,
                    parameters,
                    sensor=problem.views[view].sensor,
                    integrator=integrator,
                    spp=spp,
                    seed=number,
                    seed_grad=number + 1,
                )
                loss += problem.loss_value(view, image)
            dr.backward(loss)
            optimizer.step()
            for key in start:
                low, high = problem.bounds[key]
                optimizer[key] = project(optimizer[key], low, high)
            parameters.update(optimizer)
            value = float(np.array(dr.detach(loss)).reshape(-1)[0])
            dr.sync_thread()
            clock += time.perf_counter() - began
            step += 1
            if not warm and (step % every == 0 or clock >= seconds or step >= steps):
                now = {key: mi.TensorXf(dr.ravel(dr.detach(optimizer[key])), tuple(start[key].shape)) for key in start}
                history.append(
                    {"step": step - 1, "seconds": clock, "loss": value, "parameter_error": problem.parameter_error(now)}
                )
    return history


def median_time(function: Callable[[int], Any], repeats: int = 15, warm: int = 4) -> tuple[float, float, float]:
    """Median, 10th and 90th percentile in milliseconds of `function(seed)`, which must evaluate what it makes."""
    times = []
    for number in range(warm + repeats):
        dr.sync_thread()
        began = time.perf_counter()
        function(number)
        dr.sync_thread()
        if number >= warm:
            times.append(1e3 * (time.perf_counter() - began))
    low, middle, high = np.percentile(times, [10, 50, 90])
    return float(middle), float(low), float(high)


def total_error(errors: dict[str, float], start: dict[str, float]) -> float:
    """One number for several parameters: the mean of each one's error relative to where it began."""
    return float(np.mean([errors[key] / start[key] for key in errors]))
