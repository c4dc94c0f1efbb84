"""The parts of the `unrender` command. Importing this imports Dr.Jit."""

from __future__ import annotations

from typing import Annotated

import typer

from unrender.cli.compare import compare
from unrender.cli.doctor import doctor
from unrender.cli.export import export
from unrender.cli.gallery import gallery
from unrender.cli.methods import methods
from unrender.cli.report import report
from unrender.cli.resume import resume
from unrender.cli.run import run
from unrender.cli.watch import watch
from unrender.runs.result import versions

__all__ = ["app"]

app = typer.Typer(
    help="Recover what a scene is made of (textures, materials, light) from images of it.",
    add_completion=False,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
app.command()(run)
app.command()(resume)
app.command()(watch)
app.command()(compare)
app.command()(report)
app.command()(export)
app.command()(gallery)
app.command()(methods)


@app.command("doctor")
def _doctor() -> None:
    """Tell what this machine has, try a gradient, say what to install."""
    raise typer.Exit(doctor())


@app.callback(invoke_without_command=True)
def _unrender(
    context: typer.Context,
    version: Annotated[bool, typer.Option("--version", help="Print the version and leave.")] = False,
) -> None:
    if version:
        typer.echo(versions()["unrender"])
    elif context.invoked_subcommand is None:
        typer.echo(context.get_help())
