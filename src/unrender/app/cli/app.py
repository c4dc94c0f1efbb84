"""Subcommands of the `unrender` command. This module imports quickly: each command imports what it needs when it is called."""

from __future__ import annotations

from importlib import metadata
from typing import Annotated

import typer

from unrender.app.cli.catalogue import gallery, methods
from unrender.app.cli.compare import compare
from unrender.app.cli.import_ import import_
from unrender.app.cli.results import export, judge, report, turntable, watch
from unrender.app.cli.run import resume, run
from unrender.app.cli.sweep import sweep_command

app = typer.Typer(
    help="Recover the parameters of a scene (textures, materials, lights) from images.",
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,  # rich's help takes half a second to import
    context_settings={"help_option_names": ["-h", "--help"]},
)
app.command()(run)
app.command()(resume)
app.command()(watch)
app.command()(compare)
app.command("sweep")(sweep_command)
app.command()(report)
app.command()(export)
app.command()(judge)
app.command()(turntable)
app.command("import")(import_)
app.command()(gallery)
app.command()(methods)


@app.command("doctor")
def _doctor() -> None:
    """Show the properties of this machine, test a gradient, and list missing packages."""
    from unrender.app.cli.doctor import doctor

    raise typer.Exit(doctor())


@app.callback(invoke_without_command=True)
def _unrender(
    context: typer.Context,
    version: Annotated[bool, typer.Option("--version", help="Print the version and exit.")] = False,
) -> None:
    if version:
        typer.echo(metadata.version("unrender"))
    elif context.invoked_subcommand is None:
        typer.echo(context.get_help())
