"""`unrender methods`: what there is, and which options they have."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from rich.table import Table

    from unrender.methods import Method

__all__ = ["methods"]


def methods(name: Annotated[str | None, typer.Argument(metavar="[NAME]", help="Only this one.")] = None) -> None:
    """List the methods, their options and defaults."""
    from rich.markup import escape

    from unrender.display.terminal import Console
    from unrender.methods import method
    from unrender.methods import methods as registered

    console = Console(highlight=False)
    for one in [method(name)] if name else registered().values():
        console.print(f"[bold]{one.name}[/]  {escape(one.summary)}", soft_wrap=True)
        console.print(_options(one))
        console.print()


def _options(one: Method) -> Table:
    from rich.markup import escape
    from rich.table import Table

    table = Table(box=None, show_header=False, padding=(0, 2, 0, 0), pad_edge=False)
    table.add_column(no_wrap=True)
    table.add_column(no_wrap=True)
    table.add_column(overflow="fold")
    for name, field in one.options.model_fields.items():
        default = "none" if field.default is None else str(field.default)
        about = f"{field.description} ({one.expected(name)})"
        table.add_row(f"  {name}", escape(default), escape(about))
    return table
