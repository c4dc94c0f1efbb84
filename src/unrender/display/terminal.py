"""Terminal output, in which control characters of untrusted text are escaped."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

import typer
from rich import console
from rich.markup import escape
from rich.segment import Segment
from rich.text import Text

from unrender.core.text import visible

if TYPE_CHECKING:
    from rich.table import Table

__all__ = ["Console", "columns", "echo", "plain"]

_UNESCAPED = "\n\t"


class Console(console.Console):
    """Rich's console with control characters in texts escaped.

    Names of files, scenes and parameters, notices and warnings may contain any character, and rich passes ESC and the C1 controls
    through. Rich's own control sequences, which redraw a progress bar for example, are separate from text and not affected.
    """

    def render(
        self, renderable: console.RenderableType, options: console.ConsoleOptions | None = None
    ) -> Iterable[Segment]:
        """Escape control characters in the segments that rich renders."""
        for segment in super().render(renderable, options):
            if segment.control or segment.text.isprintable():
                yield segment
            else:
                yield Segment(visible(segment.text, _UNESCAPED), segment.style)

    def say(self, text: str, style: str | None = None) -> None:
        """Print plain text, without markup and without line breaks at the console's width."""
        self.print(text, style=style, markup=False, highlight=False, soft_wrap=True)


def columns(*headings: str, width: int | None = None) -> Table:
    """Return a table without lines: with these headings, or of two columns of names and values, the former of this width in characters."""
    from rich.table import Table

    table = Table(box=None, padding=(0, 2, 0, 0), header_style="bold", show_header=bool(headings))
    for heading in headings:
        table.add_column(Text(visible(heading)), overflow="fold")
    if not headings:
        table.add_column(style="bold", overflow="fold", width=width)
        table.add_column(overflow="fold")
    return table


def plain(text: str) -> str:
    """Return untrusted text without rich markup, with its printed width."""
    return escape(visible(text))


def echo(text: Any, err: bool = False) -> None:
    """Print text to standard output, or to standard error, without markup and with control characters escaped."""
    typer.echo(visible(str(text), _UNESCAPED), err=err)
