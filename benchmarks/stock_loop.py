"""The usual loop, as Mitsuba's tutorials write it."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from typing import Any

import numpy as np

import unrender as ur
from benchmarks.internals import dr, from_tensor, mi, project, stock_scene, volumetric


def step_seed(seed: int, step: int, view: int) -> int:
    """The first of two seeds of a view at a step, which no other step of the run has."""
    return (seed * 1_000_003 + step * 64 + view) * 2 % 2**31


def stock_loop(
    problem: ur.Problem,
    spp: int,
    learning_rate: float,
    seconds: float = float("inf"),
    steps: int = sys.maxsize,
    seed: int = 0,
    every: int = 5,
    falling: bool = False,
    error: Callable[[dict[str, Any]], Any] | None = None,
    timer: Callable[[], float] = time.perf_counter,
) -> list[dict[str, Any]]:
    """`mi.render` with `prb`, or `prbvolpath` where there are media, `dr.backward`, `mi.ad.Adam`, values clipped.

    With `falling`, rates fall over the budget as half a cosine.

    `error` is what the history has under "parameter_error"; None for the problem's own. `timer` counts the seconds: `time.process_time`
    for those of the processor.

    Warm-up (two steps) and error measurement are left out of the clock, as in `ur.optimize`. Returns its history.
    """
    scene, parameters = stock_scene(problem)
    kind = "prbvolpath" if volumetric(problem) else "prb"
    integrator = mi.load_dict({"type": kind, "max_depth": problem.max_depth})
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
            began = timer()
            loss: Any = 0.0
            for view in range(len(problem.views)):
                number = step_seed(seed, step, view)
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
            if falling:
                done = max(clock / seconds, step / steps)
                fall = ur.schedules.Cosine(1)(done)
                optimizer.set_learning_rate({key: max(rate * fall, 1e-9) for key, rate in rates.items()})
            optimizer.step()
            for key in start:
                low, high = problem.unknowns[key].bounds
                optimizer[key] = project(optimizer[key], low, high)
            parameters.update(optimizer)
            value = float(np.array(dr.detach(loss)).reshape(-1)[0])
            dr.sync_thread()
            clock += timer() - began
            step += 1
            if not warm and (step % every == 0 or clock >= seconds or step >= steps):
                now = {key: mi.TensorXf(dr.ravel(dr.detach(optimizer[key])), tuple(start[key].shape)) for key in start}
                history.append(
                    {
                        "step": step - 1,
                        "seconds": clock,
                        "loss": value,
                        "parameter_error": (error or problem.parameter_error)(now),
                    }
                )
    return history
