"""What is printed: text of others reaches the terminal without the characters that a terminal obeys."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import typer
from rich import console
from rich.console import Group
from rich.console import RenderableType as Renderable
from rich.segment import Segment

from unrender.core.text import visible

__all__ = ["Console", "Group", "Renderable", "echo"]

_KEPT = "\n\t"


class Console(console.Console):
    """Rich's console, with every control character of a text written as an escape.

    Names of files, scenes and parameters, notices and warnings may hold any character; rich lets ESC and the C1 controls through. Its own
    commands, such as those that redraw a progress bar, are apart from text and stay.
    """

    def render(
        self, renderable: console.RenderableType, options: console.ConsoleOptions | None = None
    ) -> Iterable[Segment]:
        """See `rich.console.Console.render`, through which all goes that is printed."""
        for segment in super().render(renderable, options):
            if segment.control or segment.text.isprintable():
                yield segment
            else:
                yield Segment(visible(segment.text, _KEPT), segment.style)


def echo(text: Any) -> None:
    """Print text, without markup."""
    typer.echo(visible(str(text), _KEPT))
