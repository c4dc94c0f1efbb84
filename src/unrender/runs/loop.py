"""The optimisation loop: estimate, update, precondition, bound. Everything else is a `Callback`."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import numpy as np

from unrender.backend import cache
from unrender.core import arrays, memory, phases, trees
from unrender.core.errors import InputError
from unrender.core.random import WARM_UP, Key, check_seed
from unrender.core.trees import Tree
from unrender.estimators.base import Estimate
from unrender.estimators.capabilities import Capabilities, GradientAtBounds, LossFunction
from unrender.estimators.coordinates import (
    bounded_with_preconditioner,
    by_coordinates,
    free_of_bounds,
    with_held_elements,
)
from unrender.estimators.gauss_newton import GaussNewton
from unrender.estimators.penalties import penalized
from unrender.methods.plan import Plan, bind
from unrender.optimizers.base import Measuring, Optimizer
from unrender.runs.budget import shorter_steps
from unrender.runs.callbacks import COMPILING
from unrender.runs.metadata import described, first_values
from unrender.runs.result import Result
from unrender.runs.run import GradientNoise, Run, RunState, interruptible
from unrender.runs.watches import remarks
from unrender.scene.executor import LocalExecutor
from unrender.scene.surfaces import guarded

WARM_UP_STEPS = 2  # number of discarded steps before the first one
_LONG_STEP = 0.2  # share of the budget in seconds from which the first of them is the only one
_ERRORS_PER_SECOND = 10.0
_ERROR_PAUSE = 20.0
"""Ratio of the pause before the next measurement of the parameters' error to the measurement's duration."""


def prepare(plan: Plan, steps: int | None, seconds: float | None, seed: int) -> Run:
    """Return a run before its first step. Raises `InputError` for a seed that files cannot store."""
    seed = check_seed("seed", seed)
    problem, estimator = plan.configured(), plan.estimator
    optimizer: Optimizer = bind(plan.optimizer, problem.topology, problem.coordinates.repeated)
    problem.executor.check(estimator)
    if isinstance(estimator, GaussNewton) and not isinstance(optimizer, Measuring):
        estimator = replace(estimator, scores=False)
    if optimizer.requires == Capabilities(LossFunction):  # a search, whose mean would differ from the loop's parameters
        for key in problem.coordinates.preconditioners:
            raise InputError(
                f"{type(optimizer).__name__}: parameter {key} has a preconditioner; remove it, because a search adapts its own covariance"
            )
    state = RunState(None, None, GradientNoise(), dict.fromkeys(problem.shapes(), True))
    steps, seconds = None if steps is None else int(steps), None if seconds is None else float(seconds)
    run = Run(plan, problem, estimator, optimizer, seed, steps, seconds, {}, state)
    run.warnings += remarks(plan.problem, plan.optimizer)
    initialize(run, 0)
    return run


def initialize(run: Run, step: int) -> None:
    """Set the initial parameters of a new run at the resolution of a step, and initial states for that resolution."""
    begin_at(run, run.problem.start(step))


def begin_at(run: Run, parameters: Tree) -> None:
    """Set parameters, and initial states of estimator and optimizer."""
    problem = run.problem
    run.parameters = {k: problem.unknowns[k].project(x) for k, x in parameters.items()}
    arrays.evaluate(run.parameters)  # Dr.Jit resizes an unevaluated number in place where it meets an array
    run.state.estimator = run.estimator.init(problem, run.parameters)
    run.state.optimizer = run.optimizer.init(problem.coordinates.of(run.parameters), problem.learning_rates)


def descend(run: Run) -> Result:
    """Take steps until a callback or Ctrl-C stops the run. See `Callback` for the order of events."""
    callbacks = run.callbacks
    try:
        fresh = run.snapshot()
        with phases.phase(COMPILING):
            seconds, warm = warm_up(run)
            if (plan := shorter_steps(run)) is not None:
                _adopt(run, plan)
                fresh, spent = run.snapshot(), seconds
                seconds, warm = warm_up(run)
                seconds += spent
        run.warmup_seconds += seconds
        for callback in callbacks:
            callback.on_warm_up(run, fresh, warm)
        del fresh, warm  # they hold as much as the run itself does
        memory.trim_cache(run.parameters)
        with interruptible(run):
            for callback in callbacks:
                callback.on_start(run)
            while not run.stopped:
                for callback in callbacks:
                    callback.before_step(run)
                record = _step(run)
                run.history.append(record)
                for callback in callbacks:
                    callback.on_step(run, record)
        memory.trim_cache(run.parameters)
        result = run.result(info=True)
        for callback in callbacks:
            result = callback.on_result(run, result)
    except BaseException as error:
        for callback in callbacks:
            callback.on_error(run, error)
        raise
    for callback in callbacks:
        callback.on_end(run, result)
    return result


def _adopt(run: Run, plan: Plan) -> None:
    """Continue a run, before its first step, by another plan for its problem."""
    made = prepare(plan, run.steps, run.seconds, run.seed)
    run.plan, run.problem, run.estimator, run.optimizer = made.plan, made.problem, made.estimator, made.optimizer
    run.parameters, run.state, run.initial = made.parameters, made.state, first_values(made)
    run.description |= described(run)
    run.replanned = True


def warm_up(run: Run) -> tuple[float, dict[str, Any]]:
    """Compile every kernel of a step by steps whose results are discarded. Return the elapsed seconds, and the snapshot after them.

    It is one step if that takes much of a budget in seconds without compiling, or half of what is left where the plan has cheaper steps,
    unless a resumed run compares its state with the snapshot.
    """
    started, kernels, whole = time.perf_counter(), _compiled_kernels(run), run
    run = replace(run, warnings=[], state=replace(run.state, noise=GradientNoise()))
    state = run.state
    trials: list[tuple[float, int]] = []
    for _ in range(WARM_UP_STEPS):
        began = time.perf_counter()
        estimate, state.estimator = run.estimator.estimate(
            run.problem, run.parameters, state.estimator, Key(run.seed, 0, WARM_UP)
        )
        state.samples += int(estimate.info.get("samples", 0))
        estimate = penalized(estimate, run.problem, run.parameters)
        memory.trim_cache(run.parameters)
        update = _apply(run, estimate, {})
        run.parameters, state.optimizer = update.parameters, update.state
        del update
        memory.evaluate_in_turn(state.optimizer)
        _gradient_noise(run, estimate)
        whole.trial = time.perf_counter() - began, int(estimate.info.get("samples", 0))
        trials.append(whole.trial)
        is_long = run.deadline is not None and whole.trial[0] > _LONG_STEP * (run.seconds or math.inf)
        # A plan with cheaper steps looks at a step without tracing, if that leaves half of the time.
        is_long &= run.plan.cheaper is None or whole.trial[0] > 0.5 * run.time_left()
        if is_long and kernels == _compiled_kernels(run) and run.resumed is None:
            break
    (first, paths), (last, own) = trials[0], trials[-1]  # the first may trace more paths
    whole.tracing = max(first - last * paths / max(own, 1), 0.0) if len(trials) > 1 else first
    whole.compiled |= kernels != _compiled_kernels(run)
    return time.perf_counter() - started, run.snapshot()


def _compiled_kernels(run: Run) -> tuple[int, int | None]:
    """Return a value that changes when a kernel is compiled: in this process, or if workers trace paths, in any with this cache."""
    local = isinstance(run.problem.executor, LocalExecutor)
    return dr.detail.launch_stats()[2], None if local else cache.kernels_changed()


def _step(run: Run) -> dict[str, Any]:
    """Take one step and return its record. It is not applied if its estimate or the optimizer's step is not finite."""
    state, started = run.state, time.perf_counter()
    mean = run.state.noise.mean
    free = {} if mean is None else free_of_bounds(run.problem, run.parameters, mean, run.step)
    problem = with_held_elements(run.problem, free)
    run.estimate = None  # frees a gradient as large as the next one
    memory.trim_cache(run.parameters)
    estimate, after = run.estimator.estimate(problem, run.parameters, state.estimator, Key(run.seed, run.step))
    estimate = penalized(estimate, problem, run.parameters)
    memory.trim_cache(run.parameters)
    culprit = _not_finite(estimate)
    if not culprit:
        update = _apply(run, estimate, free)
        culprit = update.not_finite
        if not culprit:
            _warn_of_shortened(run, update.shortened)
            run.parameters, state.optimizer, state.estimator = update.parameters, update.state, after
            del update
            memory.evaluate_in_turn(state.optimizer)
    finite = not culprit
    if culprit:
        _warn_once(run, f"{culprit} was not finite; such steps are not applied")
    run.clock += time.perf_counter() - started

    run.step += 1
    run.estimate = estimate
    state.samples += int(estimate.info.get("samples", 0))
    state.skipped_in_a_row = 0 if finite else state.skipped_in_a_row + 1
    run.skipped += not finite
    for callback in run.callbacks:
        callback.on_update(run, estimate, finite)
    record: dict[str, Any] = {
        "step": run.step - 1,
        "seconds": run.clock,
        "loss": estimate.loss,
        "samples": state.samples,
        "gradient_noise": _gradient_noise(run, estimate) if finite else None,
    }
    if problem.has_truth and (run.stopped or run.clock >= state.next_error):
        measured = time.perf_counter()
        record["parameter_error"] = problem.parameter_error(run.parameters)
        state.next_error = run.clock + max(1 / _ERRORS_PER_SECOND, _ERROR_PAUSE * (time.perf_counter() - measured))
    return record


def _gradient_noise(run: Run, estimate: Estimate) -> float | None:
    """Add a gradient to the statistics, and return its fraction of noise."""
    fresh = estimate.get(GradientAtBounds)
    known = estimate.gradient | (fresh.values if fresh else {})
    bounded = {key: known[key] for key in bounded_with_preconditioner(run.problem)}
    return run.state.noise.update(estimate.gradient, estimate.variance, bounded)


def _not_finite(estimate: Estimate) -> str:
    """Return which part of an estimate is not finite, "" if all are."""
    if not np.isfinite(estimate.loss):
        return "the loss"
    for what, tree in (("gradient", estimate.gradient), ("gradient's variance", estimate.variance or {})):
        for key, value in tree.items():
            if not arrays.all_finite(value):
                return f"the {what} of {key}"
    return ""


def _warn_once(run: Run, line: str) -> None:
    if not any(known.endswith(f": {line}") for known in run.warnings):
        run.warnings.append(f"step {run.step + 1}: {line}")


def _warn_of_shortened(run: Run, keys: Sequence[str]) -> None:
    for key in keys:
        also = " or passed through others" if run.problem.unknowns[key].parameter.self_intersection == "prevent" else ""
        _warn_once(run, f"{key}: triangles would have turned over{also}; such steps are shortened")


@dataclass(frozen=True)
class _Update:
    """Result of an optimizer's update: values and state, the part that is not finite, "" for none, and meshes whose triangles would have
    turned over."""

    parameters: Tree
    state: Any
    not_finite: str
    shortened: tuple[str, ...] = ()


def _apply(run: Run, estimate: Estimate, free: Tree) -> _Update:
    """Transform, update, transform back, and bound: the optimizer uses the problem's `coordinates`; bounds apply to the parameters."""
    problem, parameters, state = run.problem, run.parameters, run.state.optimizer
    if estimate.preconditioned:  # in coordinates in which elements that stay are apart
        problem, free = with_held_elements(problem, free), {}
    coordinates = problem.coordinates
    mapped = by_coordinates(estimate, problem, parameters, free)
    steps, state = run.optimizer.update(mapped, state, coordinates.of(parameters))
    moved, reached = coordinates.moved(parameters, steps, free)
    bounded = {k: problem.unknowns[k].reached(x) for k, x in reached.items()}
    # Checked before projection, because the projection of a NaN may be a bound.
    finite = trees.map(arrays.is_finite, moved)
    del steps, moved, reached
    arrays.evaluate(bounded, finite, memory.small_parts(state))
    broken = next((key for key, mask in finite.items() if not arrays.all_true(mask)), "")
    culprit = f"the optimizer's step for {broken} (from its own state, or the preconditioner)" if broken else ""
    if culprit:
        return _Update(bounded, state, culprit)
    shortened = []
    for key, faces in problem.faces.items():
        values = arrays.numpy(bounded[key])
        crossing = problem.unknowns[key].parameter.self_intersection != "prevent"
        allowed = guarded(arrays.numpy(parameters[key]), values, faces, crossing)
        if allowed is not values:
            bounded[key] = arrays.like(allowed, bounded[key])
            shortened.append(key)
    return _Update(bounded, state, "", tuple(shortened))
