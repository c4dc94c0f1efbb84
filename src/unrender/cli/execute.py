"""One run of the command line, from a plan to a run folder, and its summary."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rich.markup import escape
from rich.table import Table

from unrender.cli.progress import Progress
from unrender.cli.terminal import Console
from unrender.methods import Method
from unrender.problem.problem import Problem
from unrender.runs.live import Live
from unrender.runs.metadata import RunAnnotations
from unrender.runs.optimize import optimize
from unrender.runs.result import Result

__all__ = ["Plan", "execute", "image_errors", "introduce", "summarise"]


@dataclass(frozen=True)
class Plan:
    """What is to be run.

    Attributes:
        problem, method: of what, by what.
        settings: of the method, where they are not the defaults.
        steps, seconds, seed: see `optimize`.
        final_spp: of the final pictures; None chooses.
        command: what was typed, to be saved with the results.
        problem_settings: of a gallery problem, to be saved with the results.
        checkpoint_every: see `optimize`.
    """

    problem: Problem
    method: Method
    settings: Mapping[str, Any]
    steps: int | None
    seconds: float | None
    seed: int
    final_spp: int | None
    command: str
    problem_settings: Mapping[str, Any]
    checkpoint_every: int | None = None


def execute(plan: Plan, directory: Path, console: Console) -> Result:
    """Run, and leave a run folder. An interrupted run is saved as far as it came."""
    estimator, optimizer = plan.method.start(plan.settings)
    options = plan.method.configure(plan.settings).model_dump()
    settings = {"options": options, "problem_options": dict(plan.problem_settings)}
    settings = {name: value for name, value in settings.items() if value}
    annotations = RunAnnotations(plan.method.name, settings, plan.command, plan.final_spp)
    live = Live(directory, plan.problem.name, plan.method.name, plan.command)
    with Progress(console) as progress:
        result = optimize(
            plan.problem,
            estimator,
            optimizer,
            plan.steps,
            plan.seconds,
            plan.seed,
            [progress, live],
            directory,
            plan.checkpoint_every,
            annotations,
        )
    live.clear()
    return result


def image_errors(result: Result, which: str = "result") -> list[float]:
    """Root mean square error of each view's picture against its reference."""
    errors = []
    for index in range(int(result.problem["views"])):
        difference = result.pictures[f"view{index}/{which}"] - result.pictures[f"view{index}/reference"]
        errors.append(float(np.sqrt(np.mean(np.square(difference, dtype=np.float64)))))
    return errors


def introduce(console: Console, problem: Problem, variant: str) -> None:
    """What is about to be recovered, and what was done to the input."""
    sizes = {np.asarray(view.reference).shape[1::-1] for view in problem.views}
    size = ", ".join(f"{width}x{height}" for width, height in sorted(sizes))
    views = f"{len(problem.views)} view{'s' if len(problem.views) > 1 else ''} of {size}"
    keys = ", ".join(parameter.key for parameter in problem.parameters)
    console.print(f"[bold]{escape(problem.name)}[/]: {escape(keys)} from {views}, on {variant}", soft_wrap=True)
    for notice in problem.notices:
        console.print(f"note: {escape(notice)}", soft_wrap=True)


def summarise(console: Console, problem: Problem, result: Result) -> None:
    """What came out."""
    table = Table(show_header=False, box=None, padding=(0, 2, 0, 0))
    table.add_column(style="bold", no_wrap=True)
    table.add_column(overflow="fold")
    table.add_row("steps", f"{result.steps} in {result.seconds:.1f} s (and {result.warmup_seconds:.1f} s to compile)")
    if result.skipped:
        table.add_row("skipped", f"{result.skipped} steps whose gradient was not finite")
    if result.resumed:
        table.add_row("resumed", f"at step {', '.join(map(str, result.resumed))}")
    if result.pictures:
        before, after = (np.mean(image_errors(result, which)) for which in ("initial", "result"))
        table.add_row("image error", f"{before:.4g} before, {after:.4g} after (root mean square)")
    start = problem.parameter_error(result.initial)
    for key, error in problem.parameter_error(result.parameters).items():
        table.add_row(escape(key), f"error {start[key]:.4g} before, {error:.4g} after")
    console.print(table)
    for warning in result.warnings:
        console.print(f"[yellow]warning[/] {escape(warning)}", soft_wrap=True)
    if result.status == "interrupted":
        console.print(f"{result.stopped}: what was reached is saved")
    if result.status == "failed":
        applied = result.steps - result.skipped
        console.print(
            f"[red]failed[/]: given up after {result.steps} steps; kept are the values of the {applied} that were applied"
        )
