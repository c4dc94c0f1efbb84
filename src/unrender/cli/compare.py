"""`unrender compare`: several methods, or runs made earlier, at equal time."""

from __future__ import annotations

import itertools
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from unrender import report
from unrender.cli import arguments
from unrender.cli.arguments import FinalSpp, Overwrite, ProblemSettings, Variant
from unrender.cli.execute import Plan, execute, image_errors, introduce
from unrender.errors import InputError
from unrender.methods import METHODS, Method, method
from unrender.problem.problem import Problem
from unrender.training.result import Result

INTERRUPTED = 130
DEFAULT_SECONDS = 20.0
_MARKS = ("compare.json", "*-seed*/run.json")


def compare(
    context: typer.Context,
    what: Annotated[
        list[str],
        typer.Argument(metavar="PROBLEM | DIR...", help="A problem to run here, or run folders made earlier."),
    ],
    methods: Annotated[
        str | None, typer.Option(metavar="NAME,NAME", help="Methods to run; the first is the measure of the others.")
    ] = None,
    settings: Annotated[
        list[str] | None,
        typer.Option(
            "--set", "-s", metavar="[METHOD.]NAME=VALUE", help="An option of one method or of all, such as rcv.spp=4."
        ),
    ] = None,
    seconds: Annotated[float | None, typer.Option(help="Time for each run, without compilation. [default: 20]")] = None,
    seeds: Annotated[int, typer.Option(min=1, help="How many runs of each method.")] = 1,
    seed: Annotated[int, typer.Option(min=0, help="The first run's seed.")] = 0,
    out: Annotated[Path | None, typer.Option(help="Where the results go. Default: a new folder in out/.")] = None,
    problem_settings: ProblemSettings = None,
    variant: Variant = "auto",
    final_spp: FinalSpp = None,
    overwrite: Overwrite = False,
) -> None:
    """Compare methods at equal time on one problem, or runs made earlier.

    Every run gets the same seconds of optimization. Compiling kernels before the first step is left out for all alike.
    """
    console = Console(highlight=False)
    if all(Path(name).is_dir() for name in what):
        if methods or settings or problem_settings or seconds is not None:
            raise InputError("compare: run folders are compared as they are, without --methods, --set, --seconds")
        folder = arguments.folder(out, "compare", overwrite, *_MARKS)
        try:
            page = report.compare([Path(name) for name in what], folder)
        finally:
            arguments.remove_if_empty(folder)
        console.print(f"page: {escape(str(page))}", soft_wrap=True)
        return
    if len(what) > 1:
        missing = next(name for name in what if not Path(name).is_dir())
        raise InputError(f"{missing}: no such run folder (give run folders, or one problem)")
    chosen = _chosen(methods)
    given = _settings_by_method(chosen, arguments.settings(settings, "--set"))
    for one in chosen:
        one.start(given[one.name])
    options = arguments.settings(problem_settings, "--problem-set")
    arguments.check_problem(what[0], options)
    _, seconds = arguments.budget(None, DEFAULT_SECONDS if seconds is None else seconds)
    name = Path(what[0]).stem if what[0].endswith(".toml") else what[0]
    folder = arguments.folder(out, f"{name}-compare", overwrite, *_MARKS)
    results: list[Result] = []
    directories: list[Path] = []
    interrupted = False
    try:
        running = arguments.use_variant(variant)
        problem = arguments.open_problem(what[0], options)
        introduce(console, problem, running)
        command = shlex.join(context.find_root().obj or ["unrender"])
        # Methods take turns, so that a machine that slows down slows all of them.
        for number, one in itertools.product(range(seed, seed + seeds), chosen):
            console.print(f"[bold]{one.name}[/], seed {number}, {seconds:g} s")
            plan = Plan(problem, one, given[one.name], None, seconds, number, final_spp, command, options)
            directory = folder / f"{one.name}-seed{number}"
            result = execute(plan, directory, console)
            interrupted = result.stopped == "interrupted"
            if result.steps:
                results.append(result)
                directories.append(directory)
            if interrupted:
                break
    finally:
        arguments.remove_if_empty(folder)
    if directories:
        console.print(_table(problem, results))
        console.print("Time of compilation is left out for every method alike.")
        console.print(f"page: {escape(str(report.compare(directories, folder)))}", soft_wrap=True)
    if interrupted:
        raise typer.Exit(INTERRUPTED)


def _chosen(names: str | None) -> list[Method]:
    if names is None:
        return [METHODS["plain"], METHODS["rcv"]]
    chosen = [method(name.strip()) for name in names.split(",") if name.strip()]
    if not chosen:
        raise InputError("--methods: expected at least one name")
    for one in chosen:
        if chosen.count(one) > 1:
            raise InputError(f"--methods: {one.name} is given twice")
    return chosen


def _settings_by_method(chosen: Sequence[Method], given: Mapping[str, str]) -> dict[str, dict[str, str]]:
    """The settings of each method: those without a method's name go to all, those with one to it, and win."""
    found: dict[str, dict[str, str]] = {one.name: {} for one in chosen}
    for name, value in given.items():
        if "." not in name:
            for settings in found.values():
                settings[name] = value
    for name, value in given.items():
        owner, dot, option = name.partition(".")
        if dot:
            if owner not in found:
                raise InputError(f"--set {name}={value}: {owner} is not one of the methods {', '.join(found)}")
            found[owner][option] = value
    return found


def _table(problem: Problem, results: Sequence[Result]) -> Table:
    """One row per method: the median over its runs, and the range."""
    table = Table(box=None, padding=(0, 2, 0, 0), header_style="bold")
    for heading in ("method", "runs", "steps", "image error", *(f"error of {key}" for key in problem.truth)):
        table.add_column(escape(heading), overflow="fold")
    for name in dict.fromkeys(result.method for result in results):
        runs = [result for result in results if result.method == name]
        errors = [problem.parameter_error(result.parameters) for result in runs]
        table.add_row(
            name,
            str(len(runs)),
            f"{np.median([run.steps for run in runs]):.0f}",
            _spread([float(np.mean(image_errors(run))) for run in runs]),
            *(_spread([error[key] for error in errors]) for key in problem.truth),
        )
    return table


def _spread(values: Sequence[float]) -> str:
    middle = f"{np.median(values):.4g}"
    return f"{middle} ({min(values):.4g} to {max(values):.4g})" if len(values) > 1 else middle
