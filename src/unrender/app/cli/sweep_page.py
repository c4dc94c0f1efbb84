"""The page of a sweep: its best trials, compared."""

from __future__ import annotations

from pathlib import Path

from unrender.app.sweeps import folders
from unrender.app.sweeps.record import SweepRecord
from unrender.core.errors import InputError

__all__ = ["write_page"]

_MOST = 6


def write_page(folder: Path, record: SweepRecord) -> Path:
    """Write compare.html of the six best finished trials; returns its path. Raises `InputError` where none has finished."""
    directories = folders.best(folder, record, _MOST)
    if not directories:
        raise InputError(f"{folder}: no trial of the sweep has finished")
    from unrender.app import report

    return report.write_comparison(*report.load_comparison(directories), folder)
