"""`unrender.app.sweep`: what `unrender sweep` does, as a function."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import typer

from unrender.app.cli import arguments
from unrender.app.cli.signals import FAILED
from unrender.app.cli.sweep import MARK, plan_of, search_of
from unrender.app.cli.sweep_driver import Session, run_trials
from unrender.app.distributed.cluster import Workers
from unrender.app.sweeps.record import SweepRecord, read_sweep
from unrender.display.terminal import Console

__all__ = ["sweep"]


def sweep(
    problem: str | Path,
    method: str = "auto",
    over: Mapping[str, str | Sequence[Any]] | None = None,
    *,
    settings: Mapping[str, Any] | None = None,
    search: Literal["grid", "random", "tpe"] | None = None,
    trials: int | None = None,
    prune: bool = False,
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
    """Search a method's options for those of the least error, on one problem: `unrender sweep` as a function, silent.

        found = unrender.app.sweep("room.toml", "rcv", {"learning_rate": "0.001:0.1:log", "spp": [2, 8]}, trials=40, workers="auto")
        best = found.trials[found.best].settings

    Args:
        problem: a problem file, or the name of a gallery problem: workers open it themselves.
        method: its name.
        over: options to vary: a list of values, or a range as text, LOW:HIGH[:log][:POINTS].
        settings: options that stay the same.
        search: which settings to try; None for a grid, or random ones where a range has no points.
        trials, prune, window: how many by random or tpe, None for 16; see the guide.
        steps, seconds: budget of each run; None of both for 300 steps.
        seeds, seed: how many runs of each trial, and the first one's seed.
        workers: how many processes, "auto", or where, as of `deal`; None for this process.
        threads: of the processor for each run; None chooses.
        out: folder of the results; None for a new one in out/.
        problem_settings: options of a gallery problem.
        variant: Mitsuba's.
        final_spp: samples per pixel of the final pictures.
        overwrite: whether `out` may hold an earlier sweep, which is lost.
        insecure: whether to join a cluster that other users can enter.

    Returns:
        What sweep.json holds; `best` is None where every trial failed.

    Raises:
        InputError: an argument makes no sense (the line names the command's option), or Ray or Optuna is needed and missing.
        KeyboardInterrupt: what was reached is in `out`; `unrender sweep DIR` goes on.
    """
    names: dict[str, Any] = {"trials": trials, "prune": prune, "window": window, "seeds": seeds, "seed": seed}
    names |= {"steps": steps, "seconds": seconds, "final_spp": final_spp, "variant": variant, "cached": True}
    names |= {"problem": str(problem), "method": method, "search": search}
    names |= {"over": [f"{name}={value}" for name, value in _texts(over).items()]}
    names |= {"settings": _texts(settings), "problem_settings": _texts(problem_settings)}
    where = arguments.workers(None if workers is None else str(workers), insecure)
    return _carried_out(names, None if out is None else Path(out), overwrite, where, threads)


def _carried_out(
    names: dict[str, Any], out: Path | None, overwrite: bool, workers: Workers | None, threads: int | None
) -> SweepRecord:
    plan, search = search_of(plan_of(names))
    folder = arguments.folder(out, f"{arguments.short_name(plan.problem)}-sweep", overwrite, MARK)
    session = Session(folder, workers, threads, fresh=True)
    try:
        run_trials(Console(file=io.StringIO()), session, SweepRecord(command="unrender.app.sweep", plan=plan), search)
    except typer.Exit as end:
        if end.exit_code != FAILED:
            raise KeyboardInterrupt from end
    finally:
        arguments.remove_if_empty(folder)
    return read_sweep(folder)


def _texts(given: Mapping[str, Any] | None) -> dict[str, str]:
    return {name: _text(value) for name, value in (given or {}).items()}


def _text(value: Any) -> str:
    """As it is typed."""
    if isinstance(value, (list, tuple)):
        return ",".join(map(_text, value))
    return str(value).lower() if isinstance(value, bool) else str(value)
