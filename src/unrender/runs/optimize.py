"""`unrender.optimize` and `unrender.estimate`."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence, Set
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np

from unrender.core import checks
from unrender.core.errors import InputError
from unrender.core.exclusive import exclusive
from unrender.core.random import Key
from unrender.display.notebook_bar import in_notebook
from unrender.estimators.base import Estimate, Estimator, as_numpy
from unrender.methods.plan import Plan
from unrender.optimizers.base import Optimizer
from unrender.runs import advice, components
from unrender.runs.budget import Budget, check_budget
from unrender.runs.callbacks import Callback
from unrender.runs.folder import method_file
from unrender.runs.folder.writer import RunWriter
from unrender.runs.hooks import CallbackHook, Hook
from unrender.runs.loop import Descent, descend, prepare
from unrender.runs.metadata import (
    RunAnnotations,
    RunMetadata,
    describe,
    describe_run,
    fingerprint_of,
    first_values,
    to_numpy,
)
from unrender.runs.notebook import NotebookProgress
from unrender.runs.phase_times import PhaseTimes
from unrender.runs.refinement import Refinement
from unrender.runs.remeshing import MeshRefinement
from unrender.runs.result import Result
from unrender.runs.run import Run, terminate_if_told
from unrender.runs.verify import Verify
from unrender.runs.watches import BoundsWatch, InfluenceWatch, MeshWatch
from unrender.scene.bounds import off_ends
from unrender.scene.problem import Problem
from unrender.scene.render import as_tree
from unrender.scene.serialization import origin

__all__ = ["RunAnnotations", "assemble_hooks", "check", "estimate", "open_writer", "optimize"]


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
    """Recover the problem's parameters by descent.

    Args:
        problem: what to recover, from which images.
        estimator: Computes gradients; or a `methods.plan.Plan` or a method's name (`unrender methods`), which bring an optimizer along.
        optimizer: Computes steps from gradients; None for the method's.
        steps: how many steps at most, >= 1.
        seconds: how much time at most, > 0, without warm-up, callbacks and checkpoints. One of the two must be given.
        seed: of every random number of the run. Equal arguments give equal results: bit for bit with one thread; with more, the
            threads add to a gradient in the order they finish, and results agree to rounding.
        callbacks: listeners.
        run_directory: the run folder: history and checkpoints as the run goes, the result with final pictures of every view at its end; in
            place of an earlier run's. `resume` continues a run that ended early. None for no run folder.
        checkpoint_every: steps between checkpoints, >= 1; None for 50 or so, as far as they take no more than a hundredth of the time.
            There is one at the end, too.
        annotations: what else the run folder should say.
        progress: whether to show a bar; None does so in notebooks.

    Ctrl-C ends the run after the present step and returns what was reached; a second one interrupts at once. SIGTERM ends a run with a
    run folder, without final pictures, and then the process, unless the program handles it. Both work in the main thread alone.

    A step whose loss or gradient is not finite is not applied, nor remembered by the estimator, and neither is one that the optimizer
    makes not finite; it is counted in `Result.skipped`, and a warning says what was not finite. After twenty in a row the run is given
    up: `Result.status` is "failed", and the parameters are the last that were finite.

    Threads take turns: while a run goes on, another thread's `optimize`, `resume` or `render` is refused.

    What goes wrong with the run folder while the run goes is a line among the warnings (and in the log), and the run goes on.

    Raises:
        InputError: the optimizer requires what the estimator does not provide, or the budget makes no sense; the run folder is in use,
            cannot be begun, or cannot be written in the end; another thread has a run in progress.
    """
    plan = components.resolve(problem, estimator, optimizer)
    check(plan.estimator, plan.optimizer, steps, seconds)
    if checkpoint_every is not None:
        checks.integer("optimize", "checkpoint_every", checkpoint_every, at_least=1)
    annotations = annotations or RunAnnotations()
    if isinstance(estimator, str) and not annotations.method:
        annotations = replace(annotations, method=estimator, choices=plan.lines)
    run, state = prepare(plan, steps, seconds, seed)
    run.deadline = annotations.deadline(seconds)
    run.warnings += advice.remarks(problem, plan.optimizer)
    log = RunMetadata(describe_run(run, annotations), first_values(run))
    with _progress(progress) as shown, _folder(run, log, annotations, run_directory, checkpoint_every) as writers:
        hooks = assemble_hooks([*shown, *callbacks], *writers, earlier=annotations.phases)
        return descend(Descent(run, state, log, hooks))


@contextmanager
def _progress(wanted: bool | None) -> Iterator[list[Callback]]:
    """The callback that shows a bar, while it is up; none where none is wanted."""
    if wanted is False or (wanted is None and not in_notebook()):
        yield []
        return
    from unrender.runs.progress import Progress  # rich takes long to import

    with NotebookProgress() if in_notebook() else Progress() as bar:
        yield [bar]


@contextmanager
def _folder(
    run: Run, log: RunMetadata, annotations: RunAnnotations, directory: str | Path | None, checkpoint_every: int | None
) -> Iterator[list[RunWriter]]:
    """The writer of the run folder, which is begun; none where no folder is wanted."""
    if directory is None:
        yield []
        return
    run.folder = Path(directory)
    log.description["problem"] |= {"fingerprint": fingerprint_of(run), "origin": origin(run.problem)}
    with open_writer(run, run.folder, annotations.method, checkpoint_every, annotations.final_spp) as writer:
        writer.start(log.result(run))
        yield [writer]
    terminate_if_told(run)


def assemble_hooks(
    callbacks: Sequence[Callback], *folder: Hook, earlier: Mapping[str, float] | None = None
) -> list[Hook]:
    """What takes part in every run, then what keeps its run folder, then the user's callbacks.

    `earlier` is the seconds of phases before the run.
    """
    return [
        PhaseTimes(earlier),
        InfluenceWatch(),
        MeshWatch(),
        BoundsWatch(),
        Budget(),
        Refinement(),
        MeshRefinement(),
        Verify(),
        *folder,
        CallbackHook(callbacks),
    ]


def open_writer(run: Run, folder: Path, method: str, checkpoint_every: int | None, final_spp: int | None) -> RunWriter:
    """The writer of a run's folder, to be used as a context manager. What goes wrong with the folder goes to the run's warnings."""
    table = method_file.serialize(run, method, checkpoint_every, final_spp)
    # By a closure: resuming replaces the list of warnings.
    return RunWriter(
        folder, run.plan.problem, table, checkpoint_every, final_spp, lambda line: run.warnings.append(line)
    )


@exclusive("estimate")
def estimate(
    problem: Problem, estimator: Estimator | str, parameters: Mapping[str, np.ndarray] | None = None, seed: int = 0
) -> Estimate:
    """One estimate from a fresh state, its arrays as NumPy: to look at a gradient.

    Args:
        problem: what to recover.
        estimator: where gradients come from, or the name of a method.
        parameters: {key: array} for all parameters of the problem, or None for the initial ones. Values at an end of their range count
            as 1e-4 of the range inside: no path shows the gradient by a black reflectance, or by a lobe of probability 0.
        seed: of its random numbers.
    """
    estimator = components.resolve_estimator(problem, estimator, "estimate")
    problem.executor.check(estimator)
    point = off_ends(as_tree(problem, parameters), problem.renderer.parameters())
    state = estimator.init(problem, point)
    found, _ = estimator.estimate(problem, point, state, Key(seed))
    return replace(as_numpy(found), info=to_numpy(found.info))


def check(estimator: Estimator, optimizer: Optimizer, steps: int | None, seconds: float | None) -> None:
    """Raise `InputError` where the optimizer requires what the estimator does not provide, or the budget makes no sense."""
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
