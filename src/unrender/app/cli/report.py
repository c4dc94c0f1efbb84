"""`unrender report`: the page of an earlier run or sweep."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from unrender.app.cli import arguments
from unrender.core.errors import InputError

if TYPE_CHECKING:
    from unrender.app.sweeps.record import SweepRecord

_MOST = 6


def write_page(folder: Path, record: SweepRecord) -> Path:
    """Write compare.html of the six best finished trials; return its path. Raise `InputError` if none has finished."""
    from unrender.app import report
    from unrender.app.sweeps import folders

    directories = folders.best(folder, record, _MOST)
    if not directories:
        raise InputError(f"{folder}: no trial of the sweep has finished")
    return report.write_comparison(*report.load_comparison(directories), folder)


def report(
    directory: Annotated[
        Path, typer.Argument(metavar="DIR", help="A run folder, that of a run in stages, or a sweep's.")
    ],
) -> None:
    """Rewrite the page of a run folder, or of a sweep's best trials, and print its path."""
    from unrender.app.sweeps.record import SWEEP, read_sweep
    from unrender.display.terminal import echo

    if (directory / SWEEP).is_file():
        echo(write_page(directory, read_sweep(directory)))
        return
    from unrender.app import report as pages

    echo(pages.page(arguments.finished_run(directory)))
