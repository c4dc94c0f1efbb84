"""The descent: estimate, update, precondition, bound, listen."""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Mapping, Sequence, Set
from dataclasses import dataclass, field, is_dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from unrender.core import arrays, checks, trees
from unrender.core.errors import InputError
from unrender.estimators.base import Estimate, Estimator, as_numpy
from unrender.core.random import Key
from unrender.optimizers.base import Optimizer
from unrender.problem.bounds import project
from unrender.problem.fingerprint import fingerprint
from unrender.problem.problem import Problem
from unrender.problem.render import as_tree
from unrender.problem.serialization import origin
from unrender.runs.folder import method_file
from unrender.runs import multiresolution
from unrender.runs.callbacks import Callback
from unrender.runs.folder.writer import RunWriter
from unrender.runs.noise import GradientNoise
from unrender.runs.final_images import pictures
from unrender.runs.result import Result
from unrender.runs.run import Memory, Run, interruptible, snapshot
from unrender.core.trees import Tree

_ADDRESS = re.compile(r" at 0x[0-9a-f]+")
_INFLUENCE_STEPS = 5
_HOPELESS_STEPS = 20
_ERRORS_PER_SECOND = 10.0


@dataclass(frozen=True)
class RunAnnotations:
    """What else a run folder should say of its run.

    Attributes:
        method: its name; "" for the estimator's.
        settings: of the method, in words that JSON has.
        command: what was typed.
        final_spp: samples per pixel of the final pictures; None chooses.
    """

    method: str = ""
    settings: Mapping[str, Any] = field(default_factory=dict)
    command: str = ""
    final_spp: int | None = None


def optimize(
    problem: Problem,
    estimator: Estimator,
    optimizer: Optimizer,
    steps: int | None = None,
    seconds: float | None = None,
    seed: int = 0,
    callbacks: Sequence[Callback] = (),
    run_directory: str | Path | None = None,
    checkpoint_every: int | None = None,
    annotations: RunAnnotations | None = None,
) -> Result:
    """Recover the problem's parameters by descent.

    Args:
        problem: what to recover, from which images.
        estimator: where gradients come from.
        optimizer: what becomes of them.
        steps: how many steps at most, >= 1.
        seconds: how much time at most, > 0, without warm-up, callbacks and checkpoints. One of the two must be given.
        seed: of every random number of the run. Equal arguments give equal results: bit for bit with one thread; with more, the
            threads add to a gradient in the order they finish, and results agree to rounding.
        callbacks: listeners.
        run_directory: the run folder: history and checkpoints as the run goes, the result with final pictures of every view at its end; in
            place of an earlier run's. `resume` takes up a run that ended early. None for nowhere.
        checkpoint_every: steps between checkpoints, >= 1; None for 50 or so, as far as they take no more than a fiftieth of the time. There
            is one at the end, too.
        about: what else the run folder should say.

    Ctrl-C ends the run after the present step and returns what was reached; a second one interrupts at once. A step whose loss or
    gradient is not finite is not applied, nor remembered by the estimator; it is counted in `Result.skipped`.

    What goes wrong with the run folder while the run goes is a line among the warnings (and in the log), and the run goes on.

    Raises:
        InputError: the optimizer requires what the estimator does not provide, or the budget makes no sense; the run folder is in use,
            cannot be begun, or cannot be written in the end.
    """
    check(estimator, optimizer, steps, seconds)
    if checkpoint_every is not None:
        checks.integer("optimize", "checkpoint_every", checkpoint_every, at_least=1)
    annotations = annotations or RunAnnotations()
    run, memory = prepare(problem, estimator, optimizer, steps, seconds, seed)
    metadata = RunMetadata(describe_run(run, annotations), run.full(), annotations.final_spp)
    if run_directory is None:
        return descend(run, memory, callbacks, metadata)
    run.folder = Path(run_directory)
    method = method_file.serialize(run, annotations.method, checkpoint_every, annotations.final_spp)
    metadata.facts["problem"] |= {"fingerprint": fingerprint_of(run), "origin": origin(problem)}
    writer = RunWriter(run.folder, problem, method, checkpoint_every, lambda line: run.warnings.append(line))
    writer.take()
    try:
        writer.begin(metadata.result(run))
        return descend(run, memory, callbacks, metadata, writer)
    finally:
        writer.close()


@dataclass
class RunMetadata:
    """What a result says of its run beside what the run found.

    Attributes:
        facts: fields of `Result`.
        initial: {key: array}, where the descent began.
        final_spp: of the final pictures.
        history: one record per step.
        warmup: seconds of tracing and compiling.
    """

    facts: dict[str, Any]
    initial: dict[str, np.ndarray]
    final_spp: int | None = None
    history: list[dict[str, Any]] = field(default_factory=list)
    warmup: float = 0.0

    def result(self, run: Run, info: bool = False) -> Result:
        """What the run has reached so far; with `info`, what the last estimate tells besides."""
        return Result(
            parameters=run.full(),
            initial=self.initial,
            history=self.history,
            seconds=run.clock,
            warmup_seconds=self.warmup,
            stopped=run.stopped,
            skipped=run.skipped,
            warnings=[*run.warnings, *(multiresolution.unfinished(run) if run.stopped else [])],
            info=_as_numpy(run.estimate.info) if info and run.estimate else {},
            **self.facts,
        )


def prepare(
    problem: Problem,
    estimator: Estimator,
    optimizer: Optimizer,
    steps: int | None,
    seconds: float | None,
    seed: int,
) -> tuple[Run, Memory]:
    """A run before its first step."""
    run = Run(problem, estimator, optimizer, seed, steps, seconds, {})
    memory = Memory(None, None, GradientNoise(), dict.fromkeys(problem.shapes(), True))
    place(run, memory, 0)
    return run, memory


def place(run: Run, memory: Memory, step: int) -> None:
    """Bring a run that has not begun to the resolutions that parameters have at a step: the start, and states that know nothing."""
    problem = run.problem
    run.parameters = {k: project(x, *problem.bounds[k]) for k, x in problem.start(step).items()}
    memory.estimator = run.estimator.init(problem, run.parameters)
    memory.optimizer = run.optimizer.init(run.parameters, problem.learning_rates)


def descend(
    run: Run,
    memory: Memory,
    callbacks: Sequence[Callback],
    metadata: RunMetadata,
    writer: RunWriter | None = None,
    take_up: Callable[[dict[str, Any], dict[str, Any]], None] | None = None,
) -> Result:
    """Run until the budget is used up.

    Args:
        run, memory: from `prepare`.
        callbacks: listeners.
        labels: for the result; its history goes on.
        keeper: of the run folder, already begun.
        take_up: brings the run to where it goes on from, called after the warm-up; it is shown the snapshots of a fresh run and of one
            after two steps, which tell the form of states.
    """
    problem = run.problem
    try:
        fresh = snapshot(run, memory)
        seconds, warm = _warm_up(run, memory)
        metadata.warmup += seconds
        if take_up is not None:
            take_up(fresh, warm)
        with interruptible(run):
            _budget(run, memory.in_a_row)
            for callback in callbacks:
                callback.on_start(run)
            while not run.stopped:
                upsampler = multiresolution.is_due(run)
                if upsampler:
                    metadata.warmup += multiresolution.refine(run, memory) + _warm_up(run, memory)[0]
                record = _step(run, memory)
                if upsampler or (run.step == 1 and problem.coarse_to_fine):
                    record["resolution"] = {key: run.parameters[key].shape[:-1] for key in problem.coarse_to_fine}
                metadata.history.append(record)
                if writer is not None:
                    writer.step(record)
                    if writer.is_due(run.step):
                        writer.checkpoint(metadata.result(run), run.seed, snapshot(run, memory))
                for callback in callbacks:
                    callback.on_step(run, record)
        result = metadata.result(run, info=True)
        if writer is not None:
            writer.checkpoint(result, run.seed, snapshot(run, memory))
            writer.save(result, "running")  # what took long is safe before what takes seconds more
            result = replace(result, pictures=pictures(run.problem, result, metadata.final_spp))
            writer.save(result, result.status)
    except BaseException as error:
        if writer is not None:
            writer.fail(metadata.result(run), error)
        raise
    for callback in callbacks:
        callback.on_end(run, result)
    return result


def _step(run: Run, memory: Memory) -> dict[str, Any]:
    """One step. Returns its line of the history."""
    problem = run.problem
    started = time.perf_counter()
    estimate, after = run.estimator.estimate(problem, run.parameters, memory.estimator, Key(run.seed, run.step))
    finite = bool(np.isfinite(estimate.loss)) and trees.all_finite(estimate.gradient)
    finite = finite and (estimate.variance is None or trees.all_finite(estimate.variance))
    if finite:
        run.parameters, memory.optimizer = _apply(problem, estimate, memory.optimizer, run.optimizer, run.parameters)
        memory.estimator = after
    run.clock += time.perf_counter() - started

    run.step += 1
    run.estimate = estimate
    memory.samples += int(estimate.info.get("samples", 0))
    memory.in_a_row = 0 if finite else memory.in_a_row + 1
    run.skipped += not finite
    if finite and run.step <= _INFLUENCE_STEPS:
        _watch_influence(run, estimate, memory.silent)
    _budget(run, memory.in_a_row)
    record: dict[str, Any] = {
        "step": run.step - 1,
        "seconds": run.clock,
        "loss": estimate.loss,
        "samples": memory.samples,
        "gradient_noise": memory.noise.update(estimate.gradient, estimate.variance) if finite else None,
    }
    if problem.truth and (run.stopped or run.clock >= memory.next_error):
        record["parameter_error"] = problem.parameter_error(run.parameters)
        memory.next_error = run.clock + 1 / _ERRORS_PER_SECOND
    return record


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
    return replace(as_numpy(found), info=_as_numpy(found.info))


def describe(estimator: Estimator) -> str:
    """A short name: the class, whether it is the coupled form, and the class of its image where it has one."""
    image = getattr(estimator, "image", None)
    words = ["coupled"] if getattr(estimator, "coupled", False) else []
    words += [type(image).__name__] if image is not None else []
    return type(estimator).__name__ + (f"({', '.join(words)})" if words else "")


def check(estimator: Estimator, optimizer: Optimizer, steps: int | None, seconds: float | None) -> None:
    """Raise `InputError` where the two do not go together, or the budget makes no sense."""
    missing = optimizer.requires - estimator.provides
    if missing:
        raise InputError(
            f"{type(optimizer).__name__} requires {_list(missing)}, which {describe(estimator)} does not provide "
            f"(it provides {_list(estimator.provides)}); choose an estimator that does, or an optimizer that requires "
            "the gradient alone, such as Adam"
        )
    check_budget(steps, seconds)


def check_budget(steps: int | None, seconds: float | None) -> None:
    """Raise `InputError` unless a run can have this budget."""
    if steps is None and seconds is None:
        raise InputError("optimize: give a budget, steps= or seconds=")
    if steps is not None and (not isinstance(steps, int) or steps < 1):
        raise InputError(f"optimize: steps must be a whole number of at least 1, got {steps!r}")
    if seconds is not None and not (0 < float(seconds) < float("inf")):
        raise InputError(f"optimize: seconds must be positive and finite, got {seconds!r}")


def _list(names: Set[str]) -> str:
    return ", ".join(f'"{name}"' for name in sorted(names)) or "nothing"


def _warm_up(run: Run, memory: Memory) -> tuple[float, dict[str, Any]]:
    """Trace and compile every kernel of a step by taking two that are thrown away. Returns the seconds it took, and the snapshot after."""
    started = time.perf_counter()
    there = replace(run, warnings=[])
    away = replace(memory, noise=GradientNoise())
    for _ in range(2):
        key = Key(run.seed, 0, stream=1)
        found, away.estimator = run.estimator.estimate(run.problem, there.parameters, away.estimator, key)
        there.parameters, away.optimizer = _apply(run.problem, found, away.optimizer, run.optimizer, there.parameters)
        away.noise.update(found.gradient, found.variance)
    return time.perf_counter() - started, snapshot(there, away)


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


def _as_numpy(info: Any) -> Any:
    if isinstance(info, Mapping):
        return {key: _as_numpy(value) for key, value in info.items()}
    return arrays.numpy(info) if arrays.is_drjit(info) else info


def fingerprint_of(run: Run) -> dict[str, str]:
    """The problem's fingerprint, and what works on it, in words."""
    parts = {"estimator": run.estimator, "optimizer": run.optimizer}
    return fingerprint(run.problem) | {name: _ADDRESS.sub("", repr(part)) for name, part in parts.items()}


def describe_run(run: Run, annotations: RunAnnotations) -> dict[str, Any]:
    """Fields of `Result` that are known before the first step."""
    problem = run.problem
    loss = repr(problem.loss) if is_dataclass(problem.loss) else type(problem.loss).__name__
    parts = {"estimator": repr(run.estimator), "optimizer": repr(run.optimizer)}
    return {
        "name": problem.name,
        "method": annotations.method or describe(run.estimator),
        "settings": {**annotations.settings, **parts, "steps": run.steps, "seconds": run.seconds},
        "seed": run.seed,
        "command": annotations.command,
        "problem": {
            "parameters": [p.key for p in problem.parameters],
            "views": len(problem.views),
            "loss": loss,
            "max_depth": problem.max_depth,
        },
        "truth": problem.truth,
    }
