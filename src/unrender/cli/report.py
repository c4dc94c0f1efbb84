"""`unrender report`: the page of a run made earlier."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from unrender import report as pages
from unrender.cli.terminal import echo

__all__ = ["report"]


def report(directory: Annotated[Path, typer.Argument(metavar="DIR", help="A run folder.")]) -> None:
    """Write the page of a run folder anew, and print where it is."""
    echo(pages.page(directory))
