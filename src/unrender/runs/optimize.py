"""Functions `unrender.optimize` and `unrender.estimate`."""

from __future__ import annotations

import functools
from collections.abc import Iterator, Mapping, Sequence, Set
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from unrender.core import checks, phases, registry
from unrender.core.errors import InputError
from unrender.core.exclusive import exclusive
from unrender.core.random import Key, check_seed
from unrender.core.text import did_you_mean, in_words
from unrender.display.notebook import in_notebook
from unrender.estimators.base import Estimate, Estimator, as_numpy
from unrender.methods import method, methods
from unrender.methods.plan import Plan
from unrender.optimizers.base import Optimizer
from unrender.runs.budget import Budget, check_budget
from unrender.runs.callbacks import Callback, PhaseTimes, UserCallbacks
from unrender.runs.folder import method_file
from unrender.runs.folder.writer import RunWriter
from unrender.runs.loop import descend, prepare
from unrender.runs.metadata import RunAnnotations, describe, describe_run, fingerprint_of, first_values
from unrender.runs.notebook import NotebookProgress
from unrender.runs.number_means import NumberMeans, numbers_of
from unrender.runs.refinement import MeshRefinement, OtherStart, Refinement
from unrender.runs.result import Result
from unrender.runs.run import Run, raise_termination, to_numpy
from unrender.runs.verify import Verify
from unrender.runs.watches import BoundsWatch, InfluenceWatch, MeshWatch
from unrender.scene import serialization
from unrender.scene.bounds import off_ends
from unrender.scene.problem import Problem
from unrender.scene.render import as_tree, check_problem


@exclusive("optimize", long=True)
def optimize(
    problem: Problem,
    estimator: Estimator | Plan | str = "auto",
    optimizer: Optimizer | None = None,
    steps: int | None = None,
    seconds: float | None = None,
    seed: int = 0,
    callbacks: Sequence[Callback] = (),
    run_directory: str | Path | None = None,
    checkpoint_every: int | None = None,
    annotations: RunAnnotations | None = None,
    progress: bool | None = None,
) -> Result:
    """Recover the problem's parameters by gradient-based optimisation; return the best verified values with status and history.

    Args:
        problem: problem to solve.
        estimator: Gradient estimator; or a `methods.plan.Plan` or a method's name (`unrender methods`), which include an optimizer.
        optimizer: Optimizer; None for the method's.
        steps: maximum number of steps, >= 1.
        seconds: time limit, > 0, without warm-up, callbacks and checkpoints. At least one of the two limits is required.
        seed: seed of all random numbers of the run. Equal arguments give equal results, bit for bit with one thread. With more threads,
            the order of summation varies, and results agree to rounding error.
        callbacks: callbacks that observe the run.
        run_directory: the run folder, which replaces that of an earlier run. History and checkpoints are written during the run, and the
            result with final images of every view at its end. `resume` continues a run that ended early. None for no run folder.
        checkpoint_every: steps between checkpoints, >= 1. None takes about 50, within a hundredth of the run's time. There is one at the
            end, too.
        annotations: additional description of the run for the run folder.
        progress: whether to show a progress bar; None does so in notebooks.

    Ctrl-C ends the run after the current step and returns the result so far; a second Ctrl-C interrupts at once. SIGTERM ends a run with
    a run folder, without final images, and then the process, unless the program handles it. Both work in the main thread only.

    A step is not applied if its loss, gradient or update is not finite, and the estimator ignores it. It is counted in `Result.skipped`,
    and a warning names the cause. After twenty such steps in a row the run stops: `Result.status` is "failed", and the parameters are the
    last finite ones.

    Only one thread may compute at a time: during a run, another thread's `optimize`, `resume` or `render` is refused.

    A failure to write the run folder during the run is a warning (also logged), and the run continues.

    Raises:
        InputError: the optimizer requires what the estimator does not provide, or the budget is invalid; the run folder is in use, cannot
            be created, or cannot be written at the end; another thread has a run in progress.
    """
    _check_kinds(problem, callbacks, annotations, progress)
    plan = resolve(problem, estimator, optimizer)
    check(plan.estimator, plan.optimizer, steps, seconds)
    if checkpoint_every is not None:
        checks.integer("optimize", "checkpoint_every", checkpoint_every, at_least=1)
    annotations = annotations or RunAnnotations()
    if isinstance(estimator, str) and not annotations.method:
        annotations = replace(annotations, method=estimator, choices=plan.lines)
    run = prepare(plan, steps, seconds, seed)
    run.begin_budget(annotations.began)
    run.description, run.initial = describe_run(run, annotations), first_values(run)
    folder = _folder(run, annotations, run_directory, checkpoint_every)
    with _progress(progress) as bar, folder as writers, connected(run, [*bar, *callbacks], writers, annotations.phases):
        return descend(run) if writers else _with_reasons(run, descend(run))


def _check_kinds(problem: Any, callbacks: Any, annotations: Any, progress: Any) -> None:
    check_problem("optimize", problem)
    if not isinstance(callbacks, Sequence) or not all(isinstance(each, Callback) for each in callbacks):
        raise InputError(f"optimize: callbacks: expected a list of Callback objects, got {in_words(callbacks)}")
    checks.optional("optimize: annotations", annotations, RunAnnotations, "a RunAnnotations")
    if progress is not None:
        checks.flag("optimize", "progress", progress)


def _with_reasons(run: Run, result: Result) -> Result:
    """Add a line for each unknown without standard errors to the result of a run without a run folder.

    Nothing has tested the errors of means over steps: they lack the references' noise, and directions in which no gradient moves them.
    """
    untested = numbers_of(run.problem, run.optimizer, run.state.optimizer)
    result = replace(result, standard_error={key: x for key, x in result.standard_error.items() if key not in untested})
    why = "unrender.runs.uncertainty(problem, result) computes them, or says why not, as a run with a run folder does"
    if result.misfit is not None:
        why = "the final picture differs from the references by more than noise"
    lines = (f"{key}: no standard errors: {why}" for key in result.parameters if key not in result.standard_error)
    return replace(result, without_errors=tuple(lines))


@contextmanager
def _progress(show: bool | None) -> Iterator[list[Callback]]:
    """Yield the callback of the progress bar while it is displayed; none if it is not wanted."""
    if show is False or (show is None and not in_notebook()):
        yield []
        return
    from unrender.runs.progress import Progress  # imports rich, which is slow

    with NotebookProgress() if in_notebook() else Progress() as bar:
        yield [bar]


@contextmanager
def _folder(
    run: Run, annotations: RunAnnotations, directory: str | Path | None, checkpoint_every: int | None
) -> Iterator[list[RunWriter]]:
    """Yield the writer of the run folder after its start; an empty list without a folder."""
    if directory is None:
        yield []
        return
    run.folder = checks.path("optimize: run_directory", directory)
    run.description["problem"] |= {"fingerprint": fingerprint_of(run), "origin": serialization.origin(run.problem)}
    with open_writer(run, run.folder, annotations.method, checkpoint_every, annotations.final_spp) as writer:
        writer.start(run.result())
        yield [writer]
    raise_termination(run)


@contextmanager
def connected(
    run: Run, callbacks: Sequence[Callback], folder: Sequence[Callback], earlier: Mapping[str, float] | None
) -> Iterator[None]:
    """Connect a run with the callbacks of every run, those of the run folder, and, last, the user's; `descend` then takes its steps.

    The first ones of the folder restore a run, so that they come before all others. The last one writes.

    Args:
        folder: callbacks of the run folder, the writer last.
        earlier: seconds of phases before the run.
    """
    restoring, writing = folder[:-1], folder[-1:]
    run.callbacks = [
        *restoring,
        PhaseTimes(earlier),
        InfluenceWatch(),
        MeshWatch(),
        BoundsWatch(),
        Budget(),
        Refinement(),
        MeshRefinement(),
        OtherStart(),
        NumberMeans(),
        Verify(),
        *writing,
        UserCallbacks(callbacks),
    ]
    with phases.listening(*callbacks):
        yield


def open_writer(run: Run, folder: Path, method: str, checkpoint_every: int | None, final_spp: int | None) -> RunWriter:
    """Return the writer of a run's folder, a context manager. Failures are added to the run's warnings."""
    table = method_file.serialize(run, method, checkpoint_every, final_spp)
    # A closure, because resuming replaces the list of warnings.
    save_problem = functools.partial(serialization.save, run.plan.problem)
    return RunWriter(folder, save_problem, table, checkpoint_every, final_spp, lambda line: run.warnings.append(line))


@exclusive("estimate")
def estimate(
    problem: Problem, estimator: Estimator | str, parameters: Mapping[str, np.ndarray] | None = None, seed: int = 0
) -> Estimate:
    """Return one estimate from an initial state, with NumPy arrays, for inspection of a gradient.

    Args:
        problem: problem to solve.
        estimator: gradient estimator, or the name of a method.
        parameters: {key: array} of all parameters of the problem; None for the initial ones. Values at a bound of their range are moved
            inside by 1e-4 of the range: no path has a gradient with respect to a black reflectance, or to a lobe of probability 0.
        seed: seed of the random numbers.
    """
    check_problem("estimate", problem)
    seed, estimator = check_seed("estimate: seed", seed), resolve_estimator(problem, estimator, "estimate")
    problem.executor.check(estimator)
    point = off_ends(as_tree(problem, parameters), problem.renderer.parameters())
    state = estimator.init(problem, point)
    result, _ = estimator.estimate(problem, point, state, Key(seed))
    return replace(as_numpy(result), info=to_numpy(result.info))


def check(estimator: Estimator, optimizer: Optimizer, steps: int | None, seconds: float | None) -> None:
    """Raise `InputError` if the optimizer requires what the estimator does not provide, or the budget is invalid."""
    for part, protocol in ((estimator, Estimator), (optimizer, Optimizer)):
        for name in vars(protocol):
            if not name.startswith("_") and getattr(type(part), name, None) is getattr(protocol, name):
                raise InputError(f"optimize: {type(part).__name__} has no {name}, which an {protocol.__name__} needs")
    missing = optimizer.requires - estimator.provides
    if missing:
        raise InputError(
            f"{type(optimizer).__name__} requires {_list(missing)}, which {describe(estimator)} does not provide "
            f"(it provides {_list(estimator.provides)}); choose an estimator that does, or an optimizer that requires "
            "the gradient alone, such as Adam"
        )
    check_budget(steps, seconds)


def _list(names: Set[str]) -> str:
    return ", ".join(f'"{name}"' for name in sorted(names)) or "nothing"


def resolve(problem: Problem, estimator: Any, optimizer: Any) -> Plan:
    """Return the plan of a method's name, of two components, or a plan unchanged.

    Args:
        problem: problem for which a method chooses its parts.
        estimator: an estimator, a `Plan`, or the name of a method, which includes its optimizer.
        optimizer: an optimizer; None for the method's.

    Raises:
        InputError: an argument is missing or of another kind, such as an optimizer of Mitsuba or PyTorch, or a class instead of an object.
    """
    if optimizer is None and isinstance(estimator, Plan):
        return replace(estimator, problem=problem)
    if optimizer is None and isinstance(estimator, str):
        return method(estimator).plan(problem)
    chosen = resolve_estimator(problem, estimator)
    if optimizer is None:
        raise InputError(
            "optimize: give an optimizer, such as unrender.optimizers.Adam(learning_rate=0.01), or a method's name in place of both"
        )
    if not registry.implements(optimizer, "optimizer"):
        raise InputError(f"optimize: optimizer: {_instead_of_optimizer(optimizer)}")
    return Plan(problem, chosen, optimizer)


def resolve_estimator(problem: Problem, estimator: Any, owner: str = "optimize") -> Estimator:
    """Return an estimator, from itself or a method's name. Raises `InputError` for anything else."""
    if isinstance(estimator, str):
        return method(estimator).plan(problem).estimator
    if not registry.implements(estimator, "estimator"):
        names = ", ".join(methods())
        raise InputError(
            f"{owner}: expected an estimator, such as unrender.PathGradient(spp=4), or the name of a method ({names}), "
            f"got {_shown(estimator)}"
        )
    return estimator


def _instead_of_optimizer(value: Any) -> str:
    """Return what is wrong with an invalid optimizer, and what is expected."""
    from unrender import optimizers

    kind = value if isinstance(value, type) else type(value)
    known = {name: getattr(optimizers, name) for name in optimizers.__all__}
    package = kind.__module__.partition(".")[0]
    if isinstance(value, type) and value in known.values():
        return f"expected an object, got the class {value.__name__}; write {value.__name__}()"
    if package in ("mitsuba", "drjit", "torch"):
        owner = {"mitsuba": "Mitsuba", "drjit": "Dr.Jit", "torch": "PyTorch"}[package]
        same = kind.__name__ if kind.__name__ in known else "Adam"
        return f"{owner}'s {kind.__name__} updates parameters of its own; expected unrender.optimizers.{same}(learning_rate=...)"
    expected = "expected one of unrender.optimizers, such as Adam(learning_rate=0.01)"
    hint = did_you_mean(value, known) if isinstance(value, str) else ""
    return f"{expected}, got {_shown(value)}{hint}"


def _shown(value: Any) -> str:
    return f"the class {value.__name__}" if isinstance(value, type) else in_words(value)
