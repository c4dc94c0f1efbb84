"""The optimisation loop: estimate, update, precondition, bound. Everything else is a `Hook`."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from unrender.core import arrays, memory, phases, trees
from unrender.core.errors import InputError
from unrender.core.random import WARM_UP, Key, check_seed
from unrender.core.trees import Tree
from unrender.estimators.base import Estimate
from unrender.estimators.capabilities import Capabilities, LossFunction
from unrender.estimators.coordinates import by_coordinates
from unrender.estimators.penalties import penalized
from unrender.methods.plan import Plan
from unrender.optimizers.base import Choosing, Measuring, Optimizer
from unrender.runs.hooks import Hook
from unrender.runs.mesh_guard import guarded
from unrender.runs.metadata import RunMetadata
from unrender.runs.noise import GradientNoise
from unrender.runs.phase_times import COMPILING
from unrender.runs.result import Result
from unrender.runs.run import Run, RunState, interruptible, snapshot
from unrender.scene.problem import Problem

__all__ = ["Descent", "descend", "initialize", "prepare"]

_ERRORS_PER_SECOND = 10.0
_ERROR_PAUSE = 20.0
"""Ratio of the pause before the next measurement of the parameters' error to the measurement's duration."""


@dataclass
class Descent:
    """A run with everything that belongs to it.

    Attributes:
        run: part that callbacks get.
        state: further state from step to step.
        log: history and description of the run.
        hooks: hooks in calling order.
    """

    run: Run
    state: RunState
    log: RunMetadata
    hooks: Sequence[Hook] = field(default_factory=tuple)

    def result(self, info: bool = False) -> Result:
        """Return the current result; with `info`, including the information of the last estimate."""
        optimizer = self.run.optimizer
        adapted = optimizer.choices(self.state.optimizer) if isinstance(optimizer, Choosing) else ()
        result = self.log.result(self.run, [line for hook in self.hooks for line in hook.warnings(self)], info, adapted)
        return replace(result, standard_error=self._standard_errors())

    def _standard_errors(self) -> dict[str, np.ndarray]:
        """Return the standard error of the parameters that have one, in their units."""
        run, optimizer = self.run, self.run.optimizer
        if not isinstance(optimizer, Measuring):
            return {}
        coordinates = run.problem.coordinates
        errors = optimizer.standard_errors(self.state.optimizer, coordinates.of(run.parameters))
        slopes = coordinates.slopes({key: run.parameters[key] for key in errors})
        by_x = {key: np.abs(arrays.numpy(slopes[key])) * x if key in slopes else x for key, x in errors.items()}
        return {key: x.astype(np.float32) for key, x in by_x.items()}

    def snapshot(self) -> dict[str, Any]:
        """Return everything that determines the next steps."""
        return snapshot(self.run, self.state)

    def warm_up(self) -> tuple[float, dict[str, Any]]:
        """Trace and compile every kernel of a step by taking two steps whose results are discarded.

        Returns:
            The elapsed seconds, and the snapshot after the two steps.
        """
        started = time.perf_counter()
        run, state = replace(self.run, warnings=[]), replace(self.state, noise=GradientNoise())
        for _ in range(2):
            estimate, state.estimator = run.estimator.estimate(
                run.problem, run.parameters, state.estimator, Key(run.seed, 0, WARM_UP)
            )
            estimate = penalized(estimate, run.problem, run.parameters)
            memory.trim_cache(run.parameters)
            update = _apply(run.problem, estimate, state.optimizer, run.optimizer, run.parameters)
            run.parameters, state.optimizer = update.parameters, update.state
            del update
            memory.evaluate_in_turn(state.optimizer)
            state.noise.update(estimate.gradient, estimate.variance)
        return time.perf_counter() - started, snapshot(run, state)


def prepare(plan: Plan, steps: int | None, seconds: float | None, seed: int) -> tuple[Run, RunState]:
    """Return a run before its first step. Raises `InputError` for a seed that files cannot store."""
    seed = check_seed("seed", seed)
    problem, estimator = plan.configured(), plan.estimator
    optimizer = plan.bound_optimizer(problem)
    problem.executor.check(estimator)
    if optimizer.requires == Capabilities(LossFunction):  # a search, whose mean would differ from the loop's parameters
        for key in problem.coordinates.preconditioners:
            raise InputError(
                f"{type(optimizer).__name__}: parameter {key} has a preconditioner; remove it, because a search adapts its own covariance"
            )
    run = Run(plan, problem, estimator, optimizer, seed, steps, seconds, {})
    state = RunState(None, None, GradientNoise(), dict.fromkeys(problem.shapes(), True))
    initialize(run, state, 0)
    return run, state


def initialize(run: Run, state: RunState, step: int) -> None:
    """Set the initial parameters of a new run at the resolution of a step, and initial states for that resolution."""
    problem = run.problem
    run.parameters = {k: problem.unknowns[k].project(x) for k, x in problem.start(step).items()}
    state.estimator = run.estimator.init(problem, run.parameters)
    state.optimizer = run.optimizer.init(problem.coordinates.of(run.parameters), problem.learning_rates)


def descend(descent: Descent) -> Result:
    """Take steps until a hook, a callback or Ctrl-C stops the run. See `Hook` for the order of events."""
    run, hooks = descent.run, descent.hooks
    try:
        fresh = descent.snapshot()
        with phases.phase(COMPILING):
            seconds, warm = descent.warm_up()
        descent.log.warmup_seconds += seconds
        for hook in hooks:
            hook.on_warm_up(descent, fresh, warm)
        del fresh, warm  # they hold as much as the run itself does
        memory.trim_cache(run.parameters)
        with interruptible(run):
            for hook in hooks:
                hook.on_start(descent)
            while not run.stopped:
                for hook in hooks:
                    hook.before_step(descent)
                record = _step(run, descent.state, lambda estimate, applied: _announce(descent, estimate, applied))
                descent.log.history.append(record)
                for hook in hooks:
                    hook.on_step(descent, record)
        memory.trim_cache(run.parameters)
        result = descent.result(info=True)
        for hook in hooks:
            result = hook.on_result(descent, result)
    except BaseException as error:
        for hook in hooks:
            hook.on_error(descent, error)
        raise
    for hook in hooks:
        hook.on_end(descent, result)
    return result


def _announce(descent: Descent, estimate: Estimate, applied: bool) -> None:
    for hook in descent.hooks:
        hook.on_update(descent, estimate, applied)


def _step(
    run: Run, state: RunState, on_update: Callable[[Estimate, bool], None] = lambda estimate, applied: None
) -> dict[str, Any]:
    """Take one step, and return its record of the history.

    A step is not applied if its estimate is not finite, or if the optimizer's step is not finite.
    """
    problem = run.problem
    started = time.perf_counter()
    run.estimate = None  # frees a gradient as large as the next one
    memory.trim_cache(run.parameters)
    estimate, after = run.estimator.estimate(problem, run.parameters, state.estimator, Key(run.seed, run.step))
    estimate = penalized(estimate, problem, run.parameters)
    memory.trim_cache(run.parameters)
    culprit = _not_finite(estimate)
    if not culprit:
        update = _apply(problem, estimate, state.optimizer, run.optimizer, run.parameters)
        culprit = update.not_finite
        if not culprit:
            _warn_of_shortened(run, update.shortened)
            run.parameters, state.optimizer, state.estimator = update.parameters, update.state, after
            del update
            memory.evaluate_in_turn(state.optimizer)
    finite = not culprit
    if culprit:
        _warn_of_skipping(run, culprit)
    run.clock += time.perf_counter() - started

    run.step += 1
    run.estimate = estimate
    state.samples += int(estimate.info.get("samples", 0))
    state.skipped_in_a_row = 0 if finite else state.skipped_in_a_row + 1
    run.skipped += not finite
    on_update(estimate, finite)
    record: dict[str, Any] = {
        "step": run.step - 1,
        "seconds": run.clock,
        "loss": estimate.loss,
        "samples": state.samples,
        "gradient_noise": state.noise.update(estimate.gradient, estimate.variance) if finite else None,
    }
    if problem.has_truth and (run.stopped or run.clock >= state.next_error):
        measured = time.perf_counter()
        record["parameter_error"] = problem.parameter_error(run.parameters)
        state.next_error = run.clock + max(1 / _ERRORS_PER_SECOND, _ERROR_PAUSE * (time.perf_counter() - measured))
    return record


def _not_finite(estimate: Estimate) -> str:
    """Return which part of an estimate is not finite, "" if all are."""
    if not np.isfinite(estimate.loss):
        return "the loss"
    for what, tree in (("gradient", estimate.gradient), ("gradient's variance", estimate.variance or {})):
        for key, value in tree.items():
            if not arrays.all_finite(value):
                return f"the {what} of {key}"
    return ""


def _warn_of_skipping(run: Run, culprit: str) -> None:
    """Warn of a step that is not applied, once per cause."""
    line = f"{culprit} was not finite; such steps are not applied"
    if not any(known.endswith(line) for known in run.warnings):
        run.warnings.append(f"step {run.step}: {line}")


def _warn_of_shortened(run: Run, keys: Sequence[str]) -> None:
    """Warn of shortened steps of meshes, once per mesh."""
    for key in keys:
        also = " or passed through others" if run.problem.unknowns[key].parameter.self_intersection == "prevent" else ""
        line = f"{key}: triangles would have turned over{also}; such steps are shortened"
        if not any(known.endswith(line) for known in run.warnings):
            run.warnings.append(f"step {run.step}: {line}")


@dataclass(frozen=True)
class _Update:
    """Result of an optimizer's update.

    Attributes:
        parameters, state: values after the update; large arrays of the state are not yet evaluated.
        shortened: meshes whose triangles would have turned over.
        not_finite: part that is not finite, "" for none; the update must then not be applied.
    """

    parameters: Tree
    state: Any
    not_finite: str
    shortened: tuple[str, ...] = ()


def _apply(problem: Problem, estimate: Estimate, state: Any, optimizer: Optimizer, parameters: Tree) -> _Update:
    """Transform, update, transform back, and bound: the optimizer uses the problem's `coordinates`; bounds apply to the parameters."""
    coordinates = problem.coordinates
    mapped = by_coordinates(estimate, problem, parameters)
    steps, state = optimizer.update(mapped, state, coordinates.of(parameters))
    moved, reached = coordinates.moved(parameters, steps)
    bounded = {k: problem.unknowns[k].project(x) for k, x in reached.items()}
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
