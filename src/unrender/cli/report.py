"""`unrender report`: the page of a run made earlier."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

__all__ = ["report"]


def report(directory: Annotated[Path, typer.Argument(metavar="DIR", help="A run folder.")]) -> None:
    """Write the page of a run folder anew, and print where it is."""
    from unrender import report as pages
    from unrender.display.terminal import echo

    echo(pages.page(directory))
