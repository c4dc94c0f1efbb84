"""`unrender sweep`: a search over a method's options."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from unrender.app.cli import arguments
from unrender.app.cli.arguments import (
    AllowOutside,
    FinalSpp,
    Insecure,
    NoCache,
    Overwrite,
    ProblemSettings,
    Threads,
    Variant,
    WorkersOption,
)
from unrender.core import phases
from unrender.core.errors import InputError
from unrender.core.random import check_seed

if TYPE_CHECKING:
    from unrender.app.sweeps.record import SweepPlan, SweepRecord
    from unrender.app.sweeps.search import Search
    from unrender.methods import Method

__all__ = ["MARK", "plan_of", "search_of", "sweep"]

_TRIALS = 16
_SEARCHES = ("grid", "random", "tpe")
MARK = "sweep.json"
_FREE = ("allow_outside", "what", "workers", "insecure", "trials", "threads")
"""What may be given anew for a sweep that goes on."""

_What = Annotated[
    str, typer.Argument(metavar="PROBLEM | DIR", help="A problem; or the folder of a sweep, which then goes on.")
]
_MethodName = Annotated[str, typer.Option("--method", "-m", metavar="NAME", help="See `unrender methods`.")]
_Over = Annotated[
    list[str] | None,
    typer.Option(
        metavar="NAME=VALUE,VALUE | NAME=LOW:HIGH[:log][:POINTS]",
        help="An option to vary, such as learning_rate=0.003:0.3:log or spp=2,8. Repeatable.",
    ),
]
_Settings = Annotated[
    list[str] | None,
    typer.Option("--set", "-s", metavar="NAME=VALUE", help="An option that stays the same. Repeatable."),
]
_SearchName = Annotated[
    str | None,
    typer.Option(metavar="grid|random|tpe", help="Which settings to try. [default: grid; random with open ranges]"),
]
_Trials = Annotated[int | None, typer.Option(min=1, help="How many settings to try by random or tpe. [default: 16]")]
_Prune = Annotated[
    bool,
    typer.Option("--prune", help="Give up runs whose error is, and would end, above the median of earlier trials'."),
]
_Window = Annotated[
    int | None, typer.Option(min=1, help="Trials under way at most. [default: 4, or two for each worker]")
]
_Steps = Annotated[int | None, typer.Option(help="Of each run. [default: 300, or --seconds]")]
_Seconds = Annotated[float | None, typer.Option(help="Time for each run, without compilation.")]
_Seeds = Annotated[int, typer.Option(min=1, help="How many runs of each trial.")]
_Seed = Annotated[int, typer.Option(min=0, help="Of the search, and of each trial's first run.")]
_Out = Annotated[Path | None, typer.Option(help="Where the results go. Default: a new folder in out/.")]


def sweep(
    context: typer.Context,
    what: _What,
    method_name: _MethodName = "auto",
    over: _Over = None,
    settings: _Settings = None,
    search: _SearchName = None,
    trials: _Trials = None,
    prune: _Prune = False,
    window: _Window = None,
    steps: _Steps = None,
    seconds: _Seconds = None,
    seeds: _Seeds = 1,
    seed: _Seed = 0,
    workers: WorkersOption = None,
    insecure: Insecure = False,
    out: _Out = None,
    problem_settings: ProblemSettings = None,
    variant: Variant = "auto",
    final_spp: FinalSpp = None,
    overwrite: Overwrite = False,
    threads: Threads = None,
    no_cache: NoCache = False,
    allow_outside: AllowOutside = False,
) -> None:
    """Search a method's options for those of the least error, on one problem.

    The error is the parameters' where the truth is known, else that of the final pictures. Each trial is an ordinary run folder, one for
    each seed, in one folder with sweep.json. A sweep that was interrupted or killed goes on with `unrender sweep DIR`.
    """
    from unrender.app.cli.sweep_driver import Session, run_trials
    from unrender.app.sweeps.record import SweepRecord, read_sweep
    from unrender.display.terminal import Console

    console = Console(highlight=False)
    where = arguments.workers(workers, insecure)
    if _is_sweep(what):
        _check_alone(context, what)
        record = _extended(read_sweep(Path(what)), trials)
        run_trials(console, Session(Path(what), where, threads), record, search_of(record.plan)[1])
        return
    names = {"trials": trials, "prune": prune, "window": window, "seeds": seeds, "seed": seed, "steps": steps}
    names |= {"seconds": seconds, "final_spp": final_spp, "variant": variant, "cached": not no_cache}
    names |= {"problem": what, "method": method_name, "over": over or [], "search": search}
    names |= {"settings": arguments.settings(settings, "--set")}
    names |= {"problem_settings": arguments.settings(problem_settings, "--problem-set")}
    with phases.phase("loading"):
        plan, found = search_of(plan_of(names))
    folder = arguments.folder(out, f"{arguments.short_name(what)}-sweep", overwrite, MARK)
    try:
        record = SweepRecord(command=arguments.command_line(context), plan=plan)
        run_trials(console, Session(folder, where, threads, fresh=True), record, found)
    finally:
        arguments.remove_if_empty(folder)


def _is_sweep(what: str) -> bool:
    """Whether a folder is meant, and no problem of the gallery that has its name."""
    from unrender import gallery

    return Path(what).is_dir() and (Path(what, MARK).exists() or what not in gallery.names())


def plan_of(names: dict[str, Any]) -> SweepPlan:
    """The plan of what was typed. Raises `InputError`."""
    from unrender.app.sweeps.record import SweepPlan
    from unrender.runs.folder import schema

    steps, seconds = arguments.budget(names["steps"], names["seconds"])
    arguments.check_problem(names["problem"], names["problem_settings"])
    arguments.check_variant(names["variant"])
    axes, method = _axes(names["method"], names["over"], names["settings"])
    search = _kind(names["search"], axes)
    changes = {"steps": steps, "seconds": seconds, "method": method.name, "search": search}
    check_seed("--seed", names["seed"], names["seeds"])
    return schema.validate(
        SweepPlan, {**names, **changes, "problem": arguments.absolute(names["problem"])}, "unrender sweep"
    )


def _axes(method_name: str, over: list[str], given: dict[str, str]) -> tuple[Any, Method]:
    from unrender.app.sweeps.axes import parse_axes
    from unrender.methods import method

    chosen = method(method_name)
    axes = parse_axes(over, chosen, given)
    chosen.configure(given)
    return axes, chosen


def _kind(search: str | None, axes: Any) -> Any:
    """The search by name. Raises `InputError`."""
    from unrender.core.suggestions import did_you_mean

    if search is None:
        try:
            return "grid" if all(axis.points() for axis in axes) else "random"
        except InputError:
            return "random"
    if search not in _SEARCHES:
        raise InputError(f"--search {search}: expected {', '.join(_SEARCHES)}{did_you_mean(search, _SEARCHES)}")
    return search


def search_of(plan: SweepPlan) -> tuple[SweepPlan, Search]:
    """The search of a plan, and the plan with its number of trials. Raises `InputError`."""
    from unrender.app.sweeps.search import Grid, Random

    axes, _ = _axes(plan.method, plan.over, plan.settings)
    if plan.search == "grid":
        found = Grid(axes)
        if plan.trials not in (None, found.trials):
            raise InputError(f"--trials {plan.trials}: a grid has all of its {found.trials} points; leave it out")
        return plan.model_copy(update={"trials": found.trials}), found
    plan = plan.model_copy(update={"trials": plan.trials or _TRIALS})
    count = plan.trials or _TRIALS
    if plan.search == "random":
        return plan, Random(axes, count, plan.seed)
    from unrender.app.sweeps.search import TPE

    return plan, TPE(axes, count, plan.seed)


def _check_alone(context: typer.Context, folder: str) -> None:
    """Raise `InputError` where options are given that a sweep which goes on has from its beginning."""
    for name in context.params:
        source = context.get_parameter_source(name)
        if name not in _FREE and source is not None and source.name == "COMMANDLINE":
            option = name.replace("_name", "").replace("_", "-")
            raise InputError(f"sweep {folder}: goes on as it was begun, without --{option}")


def _extended(record: SweepRecord, trials: int | None) -> SweepRecord:
    """The record of a sweep that is to have so many trials; None leaves them. Raises `InputError`."""
    if trials is None:
        return record
    if record.plan.search == "grid" or trials < max((trial.number + 1 for trial in record.trials), default=0):
        raise InputError(
            f"--trials {trials}: the sweep has {len(record.trials)} already, and a grid has all its points"
        )
    return record.model_copy(update={"plan": record.plan.model_copy(update={"trials": trials})})
