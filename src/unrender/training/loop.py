"""The descent: estimate, update, precondition, bound, listen."""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, is_dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from unrender import arrays, trees
from unrender.errors import InputError
from unrender.gradients.estimate import Estimate, Estimator
from unrender.keys import Key
from unrender.optimizers.base import Optimizer
from unrender.problem.bounds import project
from unrender.problem.problem import Problem
from unrender.problem.render import as_tree
from unrender.training.callbacks import Callback
from unrender.training.noise import GradientNoise
from unrender.training.pictures import pictures
from unrender.training.result import Result
from unrender.trees import Tree

_INFLUENCE_STEPS = 5
_HOPELESS_STEPS = 20
_ERRORS_PER_SECOND = 10.0


@dataclass
class Run:
    """A run as callbacks see it.

    Attributes:
        problem, estimator, optimizer, seed: what runs.
        steps, seconds: the budget; None where there is none.
        step: how many steps are done.
        clock: seconds of optimization so far.
        parameters: the current ones (the renderer's arrays).
        estimate: the last one.
        skipped: steps not applied so far.
        warnings: one line each.
    """

    problem: Problem
    estimator: Estimator
    optimizer: Optimizer
    seed: int
    steps: int | None
    seconds: float | None
    parameters: Tree
    step: int = 0
    clock: float = 0.0
    estimate: Estimate | None = None
    skipped: int = 0
    warnings: list[str] = field(default_factory=list)
    stopped: str = ""

    def stop(self, reason: str = "callback") -> None:
        """End the run after the present step."""
        self.stopped = self.stopped or reason

    def progress(self) -> float:
        """The share of the budget used, in [0, 1]."""
        shares = [self.step / self.steps if self.steps else 0.0, self.clock / self.seconds if self.seconds else 0.0]
        return min(max(shares), 1.0)


def optimize(
    problem: Problem,
    estimator: Estimator,
    optimizer: Optimizer,
    steps: int | None = None,
    seconds: float | None = None,
    seed: int = 0,
    callbacks: Sequence[Callback] = (),
    run_directory: str | Path | None = None,
) -> Result:
    """Recover the problem's parameters by descent.

    Args:
        problem: what to recover, from which images.
        estimator: where gradients come from.
        optimizer: what becomes of them.
        steps: how many steps at most, >= 1.
        seconds: how much time at most, > 0, without warm-up and callbacks. One of the two must be given.
        seed: of every random number of the run. Equal arguments give equal results: bit for bit with one thread; with more, the
            threads add to a gradient in the order they finish, and results agree to rounding.
        callbacks: listeners.
        run_directory: where to save the result, with final pictures of every view for the report; None for nowhere.

    Ctrl-C ends the run after the present step and returns what was reached; a second one interrupts at once. A step whose loss or
    gradient is not finite is not applied, nor remembered by the estimator; it is counted in `Result.skipped`.

    Raises:
        InputError: the optimizer requires what the estimator does not provide, or the budget makes no sense.
    """
    _check(estimator, optimizer, steps, seconds)
    parameters = {k: project(x, *problem.bounds[k]) for k, x in problem.initial().items()}
    state = estimator.init(problem, parameters)
    memory = optimizer.init(parameters, problem.learning_rates)
    run = Run(problem, estimator, optimizer, seed, steps, seconds, parameters)
    history: list[dict[str, Any]] = []
    noise = GradientNoise()
    silent = dict.fromkeys(parameters, True)
    samples, in_a_row, next_error = 0, 0, 0.0

    warmup = _warm_up(run, state, memory)
    with _interruptible(run):
        for callback in callbacks:
            callback.on_start(run)
        while not run.stopped:
            started = time.perf_counter()
            key = Key(seed, run.step)
            estimate, next_state = estimator.estimate(problem, run.parameters, state, key)
            finite = np.isfinite(estimate.loss) and trees.all_finite(estimate.gradient)
            finite = finite and (estimate.variance is None or trees.all_finite(estimate.variance))
            if finite:
                run.parameters, memory = _apply(problem, estimate, memory, optimizer, run.parameters)
                state = next_state
            run.clock += time.perf_counter() - started

            run.step += 1
            run.estimate = estimate
            samples += int(estimate.info.get("samples", 0))
            in_a_row = 0 if finite else in_a_row + 1
            run.skipped += not finite
            if finite and run.step <= _INFLUENCE_STEPS:
                _watch_influence(run, estimate, silent)
            _budget(run, in_a_row)
            record: dict[str, Any] = {
                "step": run.step - 1,
                "seconds": run.clock,
                "loss": estimate.loss,
                "samples": samples,
                "gradient_noise": noise.update(estimate.gradient, estimate.variance) if finite else None,
            }
            if problem.truth and (run.stopped or run.clock >= next_error):
                record["parameter_error"] = problem.parameter_error(run.parameters)
                next_error = run.clock + 1 / _ERRORS_PER_SECOND
            history.append(record)
            for callback in callbacks:
                callback.on_step(run, record)

    result = Result(
        parameters=trees.numpy(run.parameters),
        initial=trees.numpy(parameters),
        history=history,
        seconds=run.clock,
        warmup_seconds=warmup,
        stopped=run.stopped,
        skipped=run.skipped,
        warnings=run.warnings,
        info=_as_numpy(run.estimate.info) if run.estimate else {},
        name=problem.name,
        method=describe(estimator),
        settings={"estimator": repr(estimator), "optimizer": repr(optimizer), "steps": steps, "seconds": seconds},
        seed=seed,
        problem=_describe_problem(problem),
        truth=problem.truth,
    )
    if run_directory is not None:
        result.save(run_directory)  # what took long is safe before what takes seconds more
        result = replace(result, pictures=pictures(problem, result))
        result.save(run_directory)
    for callback in callbacks:
        callback.on_end(run, result)
    return result


def estimate(
    problem: Problem, estimator: Estimator, parameters: Mapping[str, np.ndarray] | None = None, seed: int = 0
) -> Estimate:
    """One estimate from a fresh state, its arrays as NumPy: to look at a gradient.

    Args:
        problem: what to recover.
        estimator: where gradients come from.
        parameters: {key: array} for all parameters of the problem, or None for the initial ones.
        seed: of its random numbers.
    """
    point = as_tree(problem, parameters)
    state = estimator.init(problem, point)
    found, _ = estimator.estimate(problem, point, state, Key(seed))
    return replace(
        found,
        gradient=trees.numpy(found.gradient),
        variance=None if found.variance is None else trees.numpy(found.variance),
        hessian=None if found.hessian is None else arrays.numpy(found.hessian),
        info=_as_numpy(found.info),
    )


def describe(estimator: Estimator) -> str:
    """A short name: the class, whether it is the coupled form, and the class of its image where it has one."""
    image = getattr(estimator, "image", None)
    words = ["coupled"] if getattr(estimator, "coupled", False) else []
    words += [type(image).__name__] if image is not None else []
    return type(estimator).__name__ + (f"({', '.join(words)})" if words else "")


def _check(estimator: Estimator, optimizer: Optimizer, steps: int | None, seconds: float | None) -> None:
    missing = optimizer.requires - estimator.provides
    if missing:
        raise InputError(
            f"{type(optimizer).__name__} requires {_list(missing)}, which {describe(estimator)} does not provide "
            f"(it provides {_list(estimator.provides)}); choose an estimator that does, or an optimizer that requires "
            "the gradient alone, such as Adam"
        )
    if steps is None and seconds is None:
        raise InputError("optimize: give a budget, steps= or seconds=")
    if steps is not None and (not isinstance(steps, int) or steps < 1):
        raise InputError(f"optimize: steps must be a whole number of at least 1, got {steps!r}")
    if seconds is not None and not (0 < float(seconds) < float("inf")):
        raise InputError(f"optimize: seconds must be positive and finite, got {seconds!r}")


def _list(names: frozenset[str]) -> str:
    return ", ".join(f'"{name}"' for name in sorted(names)) or "nothing"


def _warm_up(run: Run, state: Any, memory: Any) -> float:
    """Trace and compile every kernel of a step by taking two that are thrown away. Returns the seconds it took."""
    started = time.perf_counter()
    parameters = run.parameters
    for _ in range(2):
        key = Key(run.seed, 0, stream=1)
        found, state = run.estimator.estimate(run.problem, parameters, state, key)
        parameters, memory = _apply(run.problem, found, memory, run.optimizer, parameters)
    return time.perf_counter() - started


def _apply(
    problem: Problem, estimate: Estimate, memory: Any, optimizer: Optimizer, parameters: Tree
) -> tuple[Tree, Any]:
    """Precondition, update, bound. The optimizer sees S g, the parameters S (step): descent in u where x = S u."""
    if not estimate.preconditioned:
        estimate = replace(estimate, gradient=problem.precondition(estimate.gradient), preconditioned=True)
    steps, memory = optimizer.update(estimate, memory, parameters)
    moved = trees.add(parameters, problem.precondition(steps))
    moved = {k: project(x, *problem.bounds[k]) for k, x in moved.items()}
    arrays.evaluate(moved, memory)
    return moved, memory


def _watch_influence(run: Run, estimate: Estimate, silent: dict[str, bool]) -> None:
    for key, gradient in estimate.gradient.items():
        silent[key] = silent[key] and arrays.number(arrays.total(gradient * gradient)) == 0.0
        if silent[key] and run.step == _INFLUENCE_STEPS:
            run.warnings.append(
                f"parameter {key}: its gradient is zero so far; it does not seem to influence the images"
            )


def _budget(run: Run, non_finite_in_a_row: int) -> None:
    if run.steps is not None and run.step >= run.steps:
        run.stop("steps")
    if run.seconds is not None and run.clock >= run.seconds:
        run.stop("seconds")
    if non_finite_in_a_row >= _HOPELESS_STEPS:
        run.stop("non-finite")
        run.warnings.append(f"the last {_HOPELESS_STEPS} gradients were not finite: the run was given up")


@contextmanager
def _interruptible(run: Run) -> Iterator[None]:
    """Let the first Ctrl-C end the run after the present step; the second one interrupts at once."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.getsignal(signal.SIGINT)

    def ask(number: int, frame: Any) -> None:
        del number, frame
        run.stop("interrupted")
        signal.signal(signal.SIGINT, before)

    signal.signal(signal.SIGINT, ask)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def _as_numpy(info: Any) -> Any:
    if isinstance(info, Mapping):
        return {key: _as_numpy(value) for key, value in info.items()}
    return arrays.numpy(info) if arrays.is_drjit(info) else info


def _describe_problem(problem: Problem) -> dict[str, Any]:
    return {
        "parameters": [p.key for p in problem.parameters],
        "views": len(problem.views),
        "loss": repr(problem.loss) if is_dataclass(problem.loss) else type(problem.loss).__name__,
        "max_depth": problem.max_depth,
    }
