"""The run folders of a sweep."""

from __future__ import annotations

from pathlib import Path

from unrender.app.sweeps.record import SWEEP, SweepRecord, read_sweep
from unrender.core.errors import InputError

PATTERN = "trial-*-seed*"
_MOST_WATCHED = 64


def name(trial: int, seed: int) -> str:
    """Return the name of a run folder within the folder of its sweep."""
    return f"trial-{trial:03d}-seed{seed}"


def best(folder: Path, record: SweepRecord, most: int = 1) -> list[Path]:
    """Return the run folders of the `most` finished trials with the least error, the best trial first."""
    known = [(trial.error, trial) for trial in record.trials if trial.status == "finished" and trial.error is not None]
    ordered = sorted(known, key=lambda entry: (entry[0], entry[1].number))[:most]
    return [folder / run.folder for _, trial in ordered for run in trial.runs]


def watched(folder: Path) -> list[Path]:
    """Return the run folders to watch: those of a sweep, or the folder itself if it is no sweep.

    Folders of trials that have not started yet are included, up to `_MOST_WATCHED` folders.
    """
    if not (folder / SWEEP).is_file():
        return [folder]
    try:
        record = read_sweep(folder)
    except InputError:
        return [folder]
    plan = record.plan
    numbers = range(min(plan.trials or len(record.trials) or 1, _MOST_WATCHED))
    run_folders = [
        folder / name(number, plan.seed + i) for number in numbers for i in range(min(plan.seeds, _MOST_WATCHED))
    ]
    return run_folders[:_MOST_WATCHED]
