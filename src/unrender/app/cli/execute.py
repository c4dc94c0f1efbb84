"""One run of the command line, from its options to a run folder, and its summary."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rich.markup import escape

from unrender.core import phases
from unrender.display import formatting
from unrender.display.terminal import Console, columns
from unrender.losses.metrics import rmse
from unrender.methods import Method
from unrender.methods.plan import PlanFile
from unrender.runs import watches
from unrender.runs.callbacks import RUN_PHASES
from unrender.runs.final_checks import image_name
from unrender.runs.image_sensitivity import seen_cells
from unrender.runs.joint_maps import shares_surface
from unrender.runs.live import Live
from unrender.runs.metadata import RunAnnotations
from unrender.runs.progress import Progress
from unrender.runs.refinement import BEGUN_AGAIN
from unrender.runs.result import Result
from unrender.runs.resume import StoredRun, resume_run
from unrender.scene.notebook import describe_views
from unrender.scene.problem import Problem
from unrender.statistics import debiased


@dataclass(frozen=True)
class RunOrder:
    """Specification of a run.

    The settings are those that differ from the defaults. The time limit `seconds`, or None, includes compilation and final pictures.
    Command and problem settings are saved with the results. See `optimize` for the others.
    """

    method: Method | PlanFile
    settings: Mapping[str, Any]
    steps: int | None
    seconds: float | None
    seed: int
    final_spp: int | None
    command: str
    problem_settings: Mapping[str, Any]
    checkpoint_every: int | None = None


@contextmanager
def execution(
    problem: Problem, order: RunOrder, directory: Path, console: Console, progress: Progress
) -> Iterator[dict[str, Any]]:
    """Print the plan and yield the arguments of `optimize`, which writes a run folder. Remove live files if the block succeeds."""
    with phases.phase("planning"):
        plan = order.method.plan(problem, order.settings)
    for line in plan.lines:
        console.say(f"{order.method.name}: {line}")
    options = order.method.options_of(order.settings)
    settings = {"options": options, "problem_options": dict(order.problem_settings)}
    settings = {name: value for name, value in settings.items() if value}
    for line in watches.remarks(problem, plan.optimizer):
        console.say(f"note: {line}")
    times = _earlier(progress), progress.budget_began
    annotations = RunAnnotations(order.method.name, settings, plan.lines, order.command, order.final_spp, *times)
    live = Live(directory, problem.name, order.method.name, order.command)
    yield {
        "problem": problem,
        "estimator": plan,
        "steps": order.steps,
        "seconds": order.seconds,
        "seed": order.seed,
        "callbacks": [progress, live],
        "run_directory": directory,
        "checkpoint_every": order.checkpoint_every,
        "annotations": annotations,
    }
    live.clear()


def resumed(stored: StoredRun, problem: Problem, progress: Progress, force: bool = False) -> Result:
    """Continue a run, and remove the files of its live page at the end. See `resume_run` for the arguments."""
    live = Live(stored.folder, problem.name, stored.record.method, stored.record.command)
    times = {"earlier": _earlier(progress), "began": progress.budget_began}
    result = resume_run(stored, problem, force, [progress, live], **times)
    live.clear()
    return result


def _earlier(progress: Progress) -> dict[str, float]:
    """Return the seconds of the phases before the run, such as loading, without those of other runs of the command."""
    return {name: spent for name, spent in progress.seconds.items() if name not in RUN_PHASES}


def image_error(result: Result, which: str = "result") -> str:
    """Return the mean over views of the root mean square error against the reference as text, with noise removed if it is known."""
    views = [view for view in range(int(result.problem["views"])) if image_name(view, which) in result.pictures]
    known = [result.image_errors[name] for view in views if (name := image_name(view, which)) in result.image_errors]
    if len(known) == len(views):
        return formatting.with_error(*debiased.mean(known))
    named = result.pictures
    errors = [
        rmse(named[image_name(view, which)], named[f"view{view}/reference"], named.get(f"view{view}/mask"))
        for view in views
    ]
    return f"{formatting.number(float(np.mean(errors)))} with noise"


def _error_line(problem: Problem, result: Result, key: str, before: float, after: float) -> str:
    """Return the error of a parameter at the start and at the end, and over the elements that images depend on."""
    measure, sensitivity = problem.unknowns[key].measure, result.sensitivity.get(key)
    line = f"error {measure.text(before)} before, {measure.text(after)} after"
    if measure.unit and key in problem.truth:
        line += f" ({measure.name_with_median(result.parameters[key], problem.truth[key])})"
    where = None if sensitivity is None else seen_cells(sensitivity)
    if where is None or key not in problem.truth or where.all():
        return line
    error = measure.error(result.parameters[key], problem.truth[key], where)
    return (
        line
        if error is None
        else f"{line}, {measure.text(error)} where seen, also by bounced light ({where.mean():.0%} of it)"
    )


def _map_line(error: np.ndarray, share: np.ndarray, alone: bool) -> str:
    """Return the standard error of a texture or grid where the references decided it, and how much of it that is.

    It does not contain errors of other unknown textures of the surface. `alone` says that there are none.
    """
    decided = share >= 0.5
    if not decided.any():
        return "decided by the start, by smoothing or by a prior, not by the references"
    median = formatting.number(float(np.median(error[decided])))
    where = f"where the references decided the values, {decided.mean():.0%} of all"
    others = "" if alone else " if the other textures of its surface are right"
    return f"{median} (median standard error, right to a factor of 1.7{others}, {where})"


def verified(result: Result) -> str:
    """Return the verification by fresh pictures as text: status, losses, and the selected parameters."""
    verification = result.verification
    first, last = (
        formatting.with_standard_error(*verification[name]) if None not in verification[name] else "not finite"
        for name in ("start", "end")
    )
    selected = "" if verification["best"] == "end" else f"; selected: the parameters of {verification['best']}"
    return f"{verification['status']}: loss {first} before, {last} after (fresh pictures, noise removed){selected}"


def introduce(console: Console, problem: Problem, variant: str) -> None:
    """Print the problem's unknowns and views, and its notices."""
    views = describe_views(problem)
    keys = ", ".join(parameter.key for parameter in problem.parameters)
    console.print(f"[bold]{escape(problem.name)}[/]: {escape(keys)} from {views}, on {variant}", soft_wrap=True)
    for notice in problem.notices:
        console.say(f"note: {notice}")


def summarise(console: Console, problem: Problem, result: Result, progress: Progress) -> None:
    longest = max((len(f"= {key}") for key in problem.unknowns), default=0)
    table = columns(width=max(min(longest, console.width * 11 // 20), len("image error")))
    table.add_row("steps", f"{result.steps} in {result.seconds:.1f} s, without compiling")
    if result.skipped:
        table.add_row("skipped", f"{result.skipped} steps whose gradient was not finite")
    if result.resumed:
        table.add_row("resumed", f"after step {', '.join(map(str, result.resumed))}")
    if result.pictures:
        first, last = (image_error(result, which) for which in ("initial", "result"))
        where = " where masks count" if any(view.mask is not None for view in problem.views) else ""
        removed = "" if last.endswith("noise") else ", noise removed"
        table.add_row("image error", f"{first} before, {last} after (root mean square{where}{removed})")
    if result.verification:
        table.add_row("verified", verified(result))
    few = formatting.few_values(
        result.parameters, {key: np.ravel(error).tolist() for key, error in result.standard_error.items()}
    )
    for key, text in few.items():
        table.add_row(f"= {escape(key)}", text)
    start = problem.parameter_error(result.initial)
    last = next((record["parameter_error"] for record in reversed(result.history) if "parameter_error" in record), {})
    for key, error in (last | problem.parameter_error(result.parameters)).items():
        table.add_row(escape(key), _error_line(problem, result, key, start[key], error))
    for key, error in result.standard_error.items():
        if key in result.data_share:
            alone = not shares_surface(problem, key)
            table.add_row(f"± {escape(key)}", _map_line(error, result.data_share[key], alone))
        elif key not in few:
            table.add_row(
                f"± {escape(key)}", f"{', '.join(map(formatting.deviation, np.ravel(error)))} (standard error)"
            )
    after = {name: seconds for name, seconds in progress.seconds.items() if name not in result.phases}
    table.add_row("time", f"{formatting.phases({**result.phases, **after})}; {progress.elapsed:.1f} s in all")
    console.print(table)
    if few:
        errors = ", ± their standard errors" if any("±" in text for text in few.values()) else ""
        console.say(f"Rows with = have the values of the result{errors}.")
    for line in result.adapted:
        if line.startswith(BEGUN_AGAIN):
            console.say(f"note: the run {line}")
    for line in result.undetermined:
        console.print(f"[yellow]not determined[/] {escape(line)}", soft_wrap=True)
    for warning in result.warnings:
        console.print(f"[yellow]warning[/] {escape(warning)}", soft_wrap=True)
    if result.status == "interrupted":
        console.print(f"{result.stopped}: the current state is saved")
    if result.status == "failed":
        applied = result.steps - result.skipped
        console.print(
            f"[red]failed[/]: stopped after {result.steps} steps; the result has the values of the {applied} applied steps"
        )
