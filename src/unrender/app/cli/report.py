"""`unrender report`: the page of a run, or of a sweep, made earlier."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from unrender.app.cli import arguments

__all__ = ["report"]


def report(
    directory: Annotated[
        Path, typer.Argument(metavar="DIR", help="A run folder, that of a run in stages, or a sweep's.")
    ],
) -> None:
    """Write the page of a run folder anew, or that of a sweep's best trials, and print where it is."""
    from unrender.app.cli.sweep_page import write_page
    from unrender.app.sweeps.record import SWEEP, read_sweep
    from unrender.display.terminal import echo

    if (directory / SWEEP).is_file():
        echo(write_page(directory, read_sweep(directory)))
        return
    from unrender.app import report as pages

    echo(pages.page(arguments.finished_run(directory)))
