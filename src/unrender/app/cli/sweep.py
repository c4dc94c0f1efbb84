"""`unrender sweep`, and `unrender.app.sweep`: a search over a method's options."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from unrender.app.cli import arguments
from unrender.app.cli.signals import DOUBTFUL, FAILED
from unrender.core import checks, phases, registry
from unrender.core.errors import InputError
from unrender.core.random import check_seed
from unrender.core.text import did_you_mean
from unrender.display.terminal import Console

if TYPE_CHECKING:
    from unrender.app.cli.sweep_driver import Session
    from unrender.app.distributed.cluster import Workers
    from unrender.app.sweeps.record import SweepPlan, SweepRecord
    from unrender.app.sweeps.search import Search

_TRIALS = 16
_SEARCHES = ("grid", "random", "tpe")
MARK = "sweep.json"
_FREE = ("allow_outside", "workers", "insecure", "trials", "threads")  # options that may change when a sweep continues

_What = Annotated[str, typer.Argument(metavar="PROBLEM | DIR", help="A problem; or the folder of a sweep to continue.")]
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
    typer.Option(metavar="grid|random|tpe", help="Search strategy. [default: grid; random if a range has no POINTS]"),
]
_Trials = Annotated[
    int | None, typer.Option(min=1, max=arguments.MOST_TRIALS, help="Number of trials of random and tpe. [default: 16]")
]
_Window = Annotated[
    int | None,
    typer.Option(
        min=1, max=arguments.MOST_TRIALS, help="With tpe: limit of concurrent trials. [default: 4, or two per worker]"
    ),
]
_Steps = Annotated[int | None, typer.Option(help="Steps of each run. [default: 300 without --seconds]")]
_Seconds = Annotated[float | None, typer.Option(help="Time for each run, with compilation and final pictures.")]
_Seeds = Annotated[int, typer.Option(min=1, max=arguments.MOST_SEEDS, help="Number of runs of each trial.")]
_Seed = Annotated[int, typer.Option(min=0, help="Seed of the search, and of the first run of each trial.")]
_Out = Annotated[Path | None, typer.Option(help="Output folder. Default: a new folder in out/.")]


def sweep_command(
    context: typer.Context,
    what: _What,
    method_name: _MethodName = "auto",
    over: _Over = None,
    settings: _Settings = None,
    search: _SearchName = None,
    trials: _Trials = None,
    window: _Window = None,
    steps: _Steps = None,
    seconds: _Seconds = None,
    seeds: _Seeds = 1,
    seed: _Seed = 0,
    workers: arguments.WorkersOption = None,
    insecure: arguments.Insecure = False,
    out: _Out = None,
    problem_settings: arguments.ProblemSettings = None,
    variant: arguments.Variant = "auto",
    final_spp: arguments.FinalSpp = None,
    overwrite: arguments.Overwrite = False,
    threads: arguments.Threads = None,
    no_cache: arguments.NoCache = False,
    allow_outside: arguments.AllowOutside = False,
) -> None:
    """Search a method's options for the smallest error on one problem.

    The error is that of the parameters if the ground truth is known, else that of the final pictures. Each trial is a normal run
    folder, one per seed, in one folder with sweep.json. `unrender sweep DIR` continues an interrupted or killed sweep.
    """
    arguments.budget(steps, seconds)
    if not Path(what).is_dir():
        arguments.check_file(what)
        registry.check_name("method", method_name)  # before the slow imports
    from unrender.app.cli.sweep_driver import Session, run_trials
    from unrender.app.sweeps.record import read_sweep

    console = Console(highlight=False)
    where = arguments.workers(workers, insecure)
    if Path(what).is_dir() and (Path(what, MARK).exists() or not arguments.is_gallery(what)):
        if refused := arguments.typed_options(context, _FREE):
            raise InputError(f"sweep {what}: continues with its original options; leave out {refused[0]}")
        record = _extended(read_sweep(Path(what)), trials)
        run_trials(console, Session(Path(what), where, threads), record, _search_of(record.plan)[1])
        return
    values = {
        "problem": what, "method": method_name, "search": search, "trials": trials, "window": window, "steps": steps,
        "seconds": seconds, "seeds": seeds, "seed": seed, "final_spp": final_spp, "variant": variant, "cached": not no_cache,
        "settings": arguments.settings(settings, "--set"),
        "problem_settings": arguments.settings(problem_settings, "--problem-set"),
    }  # fmt: skip
    with phases.phase("loading"):
        planned = _planned(values, over or [])
    folder = _folder(planned, out, overwrite)
    _begin(console, planned, arguments.command_line(context), Session(folder, where, threads, fresh=True))


def sweep(
    problem: str | Path,
    method: str = "auto",
    over: Mapping[str, str | Sequence[Any]] | None = None,
    *,
    settings: Mapping[str, Any] | None = None,
    search: Literal["grid", "random", "tpe"] | None = None,
    trials: int | None = None,
    window: int | None = None,
    steps: int | None = None,
    seconds: float | None = None,
    seeds: int = 1,
    seed: int = 0,
    workers: int | str | None = None,
    threads: int | None = None,
    out: str | Path | None = None,
    problem_settings: Mapping[str, Any] | None = None,
    variant: str = "auto",
    final_spp: int | None = None,
    overwrite: bool = False,
    insecure: bool = False,
) -> SweepRecord:
    """Search a method's options for the smallest error on one problem: `unrender sweep` as a function, without output.

        record = unrender.app.sweep("room.toml", "rcv", {"learning_rate": "0.001:0.1:log", "spp": [2, 8]}, trials=40, workers="auto")
        best = record.trials[record.best].settings

    Args:
        problem: a problem file, or the name of a gallery problem; workers open it themselves.
        method: name of the method.
        over: options to vary: a list of values, or a range as text, LOW:HIGH[:log][:POINTS].
        settings, problem_settings: fixed options of the method and of a gallery problem.
        search, trials: strategy, None for a grid, or random if a range has no points; number of trials, None for 16.
        window: limit of concurrent trials of tpe, which depend on earlier ones; None for 4 or more.
        steps, seconds, seeds, seed, final_spp, variant: options of each run, as in `unrender sweep`.
        workers, threads: number of processes, "auto", or an address, None for this process; threads of each.
        insecure: whether to join a cluster that other users can enter.
        out, overwrite: output folder, None for a new one in out/; whether to replace an earlier sweep there.

    Returns:
        Contents of sweep.json; `best` is None if every trial failed.

    Raises:
        InputError: an invalid argument (the message names the command's option), or Ray or Optuna is required and missing.
        KeyboardInterrupt: completed trials are in `out`; `unrender sweep DIR` continues.
    """
    values: dict[str, Any] = {
        "problem": str(problem), "method": method, "search": search, "trials": trials, "window": window, "steps": steps,
        "seconds": seconds, "seeds": seeds, "seed": seed, "final_spp": final_spp, "variant": variant, "cached": True,
    }  # fmt: skip
    where = arguments.workers(None if workers is None else str(workers), insecure)
    planned = _planned(
        values | {"settings": _texts(settings), "problem_settings": _texts(problem_settings)},
        {} if over is None else over,
    )
    return _run_silently(planned, where, threads, _folder(planned, None if out is None else Path(out), overwrite))


def _run_silently(
    planned: tuple[SweepPlan, Search], workers: Workers | None, threads: int | None, folder: Path
) -> SweepRecord:
    import io

    from unrender.app.cli.sweep_driver import Session
    from unrender.app.sweeps.record import read_sweep

    try:
        session = Session(folder, workers, threads, fresh=True)
        _begin(Console(file=io.StringIO()), planned, "unrender.app.sweep", session)
    except typer.Exit as end:
        if end.exit_code not in (DOUBTFUL, FAILED):
            raise KeyboardInterrupt from end
    return read_sweep(folder)


def _texts(values: Mapping[str, Any] | None) -> dict[str, str]:
    from unrender.app.sweeps.search import as_text

    checks.optional("sweep: settings", values, Mapping, "values by name")
    return {name: as_text(value) for name, value in (values or {}).items()}


def _planned(
    values: dict[str, Any], over: Sequence[str] | Mapping[str, str | Sequence[Any]]
) -> tuple[SweepPlan, Search]:
    from unrender.app.sweeps.record import SweepPlan
    from unrender.app.sweeps.search import parse_axes
    from unrender.methods import method
    from unrender.runs.folder import schema

    steps, seconds = arguments.budget(values["steps"], values["seconds"])
    arguments.check_problem(values["problem"], values["problem_settings"], values["cached"])
    arguments.check_variant(values["variant"])
    chosen = method(values["method"])
    axes = parse_axes(over, chosen, values["settings"])
    chosen.configure(values["settings"])
    check_seed("--seed", values["seed"], values["seeds"])
    changes = {"steps": steps, "seconds": seconds, "method": chosen.name, "search": _kind(values["search"], axes)}
    changes |= {"problem": arguments.absolute(values["problem"]), "over": [f"{a.name}={a.text}" for a in axes]}
    return _search_of(schema.validate(SweepPlan, {**values, **changes}, "unrender sweep"))


def _folder(planned: tuple[SweepPlan, Search], out: Path | None, overwrite: bool) -> Path:
    return arguments.folder(out, f"{arguments.short_name(planned[0].problem)}-sweep", overwrite, MARK)


def _begin(console: Console, planned: tuple[SweepPlan, Search], command: str, session: Session) -> None:
    from unrender.app.cli.sweep_driver import run_trials
    from unrender.app.sweeps.record import SweepRecord

    try:
        run_trials(console, session, SweepRecord(command=command, plan=planned[0]), planned[1])
    finally:
        arguments.remove_if_empty(session.folder)


def _kind(search: str | None, axes: Any) -> Any:
    if search is None:
        try:
            return "grid" if all(axis.points() for axis in axes) else "random"
        except InputError:
            return "random"
    if search not in _SEARCHES:
        raise InputError(f"--search {search}: expected {', '.join(_SEARCHES)}{did_you_mean(search, _SEARCHES)}")
    return search


def _search_of(plan: SweepPlan) -> tuple[SweepPlan, Search]:
    from unrender.app.sweeps.search import TPE, Grid, Random, parse_axes
    from unrender.methods import method

    axes = parse_axes(plan.over, method(plan.method), plan.settings)
    if plan.search == "grid":
        grid = Grid(axes)
        if plan.trials not in (None, grid.trials):
            raise InputError(f"--trials {plan.trials}: a grid always has its {grid.trials} points; leave it out")
        return plan.model_copy(update={"trials": grid.trials}), grid
    count = plan.trials or _TRIALS
    kind = Random if plan.search == "random" else TPE
    return plan.model_copy(update={"trials": count}), kind(axes, count, plan.seed)


def _extended(record: SweepRecord, trials: int | None) -> SweepRecord:
    """Return the record of a sweep with another number of trials; None leaves it unchanged. Raise `InputError`."""
    if trials is None:
        return record
    if record.plan.search == "grid" or trials < max((trial.number + 1 for trial in record.trials), default=0):
        raise InputError(
            f"--trials {trials}: the sweep already has {len(record.trials)} trials, and a grid always has all its points"
        )
    return record.model_copy(update={"plan": record.plan.model_copy(update={"trials": trials})})
