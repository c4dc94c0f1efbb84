"""Where the runs of a sweep lie."""

from __future__ import annotations

from pathlib import Path

from unrender.app.sweeps.record import SWEEP, SweepRecord, read_sweep
from unrender.core.errors import InputError

PATTERN = "trial-*-seed*"
_MOST_WATCHED = 64


def name(trial: int, seed: int) -> str:
    """Of a run folder within the sweep's."""
    return f"trial-{trial:03d}-seed{seed}"


def best(folder: Path, record: SweepRecord, most: int = 1) -> list[Path]:
    """The run folders of the finished trials of the least error, the best one first."""
    known = [(trial.error, trial) for trial in record.trials if trial.status == "finished" and trial.error is not None]
    ordered = sorted(known, key=lambda entry: (entry[0], entry[1].number))[:most]
    return [folder / run.folder for _, trial in ordered for run in trial.runs]


def watched(folder: Path) -> list[Path]:
    """The folder itself; of a sweep's, those of its runs, also of trials yet to begin: the first ones, where there are many."""
    if not (folder / SWEEP).is_file():
        return [folder]
    try:
        record = read_sweep(folder)
    except InputError:
        return [folder]
    plan = record.plan
    numbers = range(min(plan.trials or len(record.trials) or 1, _MOST_WATCHED))
    found = [folder / name(number, plan.seed + i) for number in numbers for i in range(min(plan.seeds, _MOST_WATCHED))]
    return found[:_MOST_WATCHED]
