"""The usual loop, as Mitsuba's tutorials write it."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np

import unrender as ur
from benchmarks.internals import dr, from_tensor, mi, project, stock_scene, volumetric


def step_seed(seed: int, step: int, view: int) -> int:
    """The first of two seeds of a view at a step, which no other step of the run has."""
    return (seed * 1_000_003 + step * 64 + view) * 2 % 2**31


def backward(
    problem: ur.Problem,
    scene: Any,
    parameters: Any,
    integrator: Any,
    seed: int,
    step: int,
    views: Iterable[int],
    spp: int = 0,
) -> Any:
    """Render views by `mi.render`, sum their losses, and call `dr.backward`. Return the sum; 0 samples are the integrator's own."""
    loss: Any = 0.0
    for view in views:
        sensor, number = problem.views[view].sensor, step_seed(seed, step, view)
        options = {"sensor": sensor, "integrator": integrator, "spp": spp, "seed": number, "seed_grad": number + 1}
        loss += problem.loss_value(view, mi.render(scene, parameters, **options))
    dr.backward(loss)
    return loss


def stock_loop(
    problem: ur.Problem,
    spp: int,
    learning_rate: float,
    seconds: float = float("inf"),
    steps: int = sys.maxsize,
    seed: int = 0,
    every: int = 5,
    fall: Callable[[float], float] | None = None,
    error: Callable[[dict[str, Any]], Any] | None = None,
    timer: Callable[[], float] = time.perf_counter,
    views: int | None = None,
) -> list[dict[str, Any]]:
    """Take the steps of `mi.render` with `prb`, or `prbvolpath` for media, `dr.backward`, `mi.ad.Adam`, values clipped. Return the history.

    Warm-up (two steps, or one of each view) and error measurement are left out of the clock, as in `ur.optimize`.

    Args:
        fall: factor of all rates by the share of the budget that is spent; None for constant rates.
        error: what the history has under "parameter_error"; None for the problem's own.
        timer: counts the seconds: `time.process_time` for those of the processor.
        views: random views a step, with one rate for all parameters; None for all views, and the problem's own rates where it has some.
    """
    scene, parameters = stock_scene(problem)
    kind = "prbvolpath" if volumetric(problem) else "prb"
    integrator = mi.load_dict({"type": kind, "max_depth": problem.max_depth})
    start, count, rng = problem.initial(), len(problem.views), np.random.default_rng(seed)
    own = {} if views else problem.learning_rates
    history: list[dict[str, Any]] = []
    for warm in (True, False):
        rates = {key: own.get(key, learning_rate) for key in start}
        optimizer = mi.ad.Adam(lr=learning_rate)
        for key, value in start.items():
            optimizer[key] = from_tensor(value, parameters[key])
        optimizer.set_learning_rate(rates)
        parameters.update(optimizer)
        clock, step = 0.0, 0
        while clock < seconds and step < ((count if views else 2) if warm else steps):
            began = timer()
            drawn = [step] if warm else rng.choice(count, min(views or count, count), replace=False).tolist()
            chosen = drawn if views else range(count)
            loss = backward(problem, scene, parameters, integrator, seed, step, chosen, spp)
            if fall:
                factor = fall(min(max(clock / seconds, step / steps), 1.0))
                optimizer.set_learning_rate({key: max(rate * factor, 1e-9) for key, rate in rates.items()})
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
                history.append({"step": step - 1, "seconds": clock, "loss": value})
                history[-1]["parameter_error"] = (error or problem.parameter_error)(now)
    return history
