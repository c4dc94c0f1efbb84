"""Terminal output, in which control characters of untrusted text are escaped."""

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


def echo(text: Any) -> None:
    """Print text to standard output, without markup and with control characters escaped."""
    typer.echo(visible(str(text), _UNESCAPED))
