"""What `unrender sweep` prints of its trials."""

from __future__ import annotations

import shlex

from rich.table import Table
from rich.text import Text

from unrender.app.sweeps.record import SweepRecord, TrialRecord
from unrender.app.sweeps.trials import Trials
from unrender.core.text import visible
from unrender.display import formatting
from unrender.display.terminal import Console
from unrender.runs.folder.schema import DOUBTFUL

__all__ = ["best_so_far", "line", "run_command", "show"]

_SHOWN, _SHOWN_LIVE = 10, 5


def line(trial: TrialRecord) -> str:
    """One trial in words."""
    what = f"trial {trial.number}: {_settings(trial)}: "
    if trial.status == "failed":
        return f"{what}failed: {trial.message}"
    share = max((float(share) for share in trial.runs[0].rungs), default=0.0)
    where = f" (pruned at {share:.0%})" if trial.status == "pruned" else ""
    where += "".join(f" ({status})" for status in sorted({run.status for run in trial.runs} & DOUBTFUL))
    return f"{what}error {_error(trial)}{where}"


def best_so_far(trials: Trials) -> Table:
    """The best trials that have ended."""
    return _table(list(trials.ended.values()), _SHOWN_LIVE)


def show(console: Console, record: SweepRecord) -> None:
    """The outcome: the best trials, how many there were, and what to type for the best one."""
    if record.trials:
        console.print(_table(record.trials, _SHOWN))
    counts = {status: sum(t.status == status for t in record.trials) for status in ("finished", "pruned", "failed")}
    told = ", ".join(f"{count} {status}" for status, count in counts.items() if count)
    console.print(f"{told or 'no trial has ended'}; {formatting.duration(record.wall_seconds)} in all", highlight=False)
    reasons: dict[str, list[int]] = {}
    for trial in record.trials:
        if trial.status == "failed":
            reasons.setdefault(trial.message, []).append(trial.number)
    for message, numbers in reasons.items():
        which = ", ".join(map(str, numbers[:_SHOWN])) + (", …" if len(numbers) > _SHOWN else "")
        console.print(
            f"failed (trial {which}): {visible(message)}", markup=False, highlight=False, soft_wrap=True, style="red"
        )
    if record.best_line:
        console.print(f"best: {record.best_line}", markup=False, highlight=False, soft_wrap=True)
        console.print(f"to run it: {run_command(record)}", markup=False, highlight=False, soft_wrap=True)


def run_command(record: SweepRecord) -> str:
    """What to type for a run with the best settings."""
    plan = record.plan
    words = ["unrender", "run", plan.problem, "--method", plan.method]
    words += [w for name, value in plan.problem_settings.items() for w in ("-p", f"{name}={value}")]
    words += [w for name, value in plan.settings.items() for w in ("-s", f"{name}={value}")]
    words += ["--steps", str(plan.steps)] if plan.steps is not None else []
    words += ["--seconds", f"{plan.seconds:g}"] if plan.seconds is not None else []
    return f"{shlex.join(words)} {record.best_line}"


def _table(trials: list[TrialRecord], most: int) -> Table:
    ranks = {"finished": 0, "pruned": 1}
    known = [(ranks[t.status], t.error, t) for t in trials if t.error is not None and t.status in ranks]
    ordered = [t for _, _, t in sorted(known, key=lambda entry: (entry[0], entry[1], entry[2].number))]
    names = list(ordered[0].settings) if ordered else []
    table = Table(box=None, padding=(0, 2, 0, 0), header_style="bold")
    for heading in ("trial", *names, "error", "steps", "seconds", ""):
        table.add_column(Text(visible(heading)), overflow="fold")
    for trial in ordered[:most]:
        steps = "+".join(str(run.steps) for run in trial.runs)
        seconds = f"{sum(run.seconds for run in trial.runs):.1f}"
        values = [Text(visible(trial.settings.get(name, ""))) for name in names]
        doubts = sorted({run.status for run in trial.runs} & DOUBTFUL)
        note = "; ".join(doubts) if trial.status == "finished" else trial.status
        table.add_row(str(trial.number), *values, _error(trial), steps, seconds, note)
    return table


def _error(trial: TrialRecord) -> str:
    if trial.error is None:
        return "–"
    if trial.standard_error is None:
        return formatting.number(trial.error)
    return formatting.with_error(trial.error, trial.standard_error)


def _settings(trial: TrialRecord) -> str:
    return ", ".join(f"{name}={value}" for name, value in trial.settings.items())
