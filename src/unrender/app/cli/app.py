"""Subcommands of the `unrender` command. This module imports quickly: each command imports what it needs when it is called."""

from __future__ import annotations

from importlib import metadata
from typing import TYPE_CHECKING, Annotated

import typer

from unrender.app.cli import arguments
from unrender.app.cli.arguments import ProblemSettings, Variant
from unrender.app.cli.compare import compare
from unrender.app.cli.import_ import import_
from unrender.app.cli.results import export, judge, report, turntable, watch
from unrender.app.cli.run import resume, run
from unrender.app.cli.sweep import sweep_command
from unrender.core import registry
from unrender.core.errors import InputError
from unrender.display.terminal import Console

if TYPE_CHECKING:
    from rich.table import Table

    from unrender.methods import Method

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


@app.command()
def gallery(
    name: Annotated[str | None, typer.Argument(metavar="[NAME]", help="Describe this problem.")] = None,
) -> None:
    """List the gallery's problems, or the options of one."""
    if name is not None:
        registry.check_name("gallery problem", name)  # before the slow imports
    from rich.markup import escape

    from unrender import gallery as problems

    console, table = Console(highlight=False), _table()
    if name is None:
        for known in problems.names():
            table.add_row(known, escape(problems.summary(known)))
    else:
        console.print(f"[bold]{escape(name)}[/]  {escape(problems.summary(name))}", soft_wrap=True)
        for option in problems.options(name):
            default = option.default if isinstance(option.default, (int, float, str)) else type(option.default).__name__
            table.add_row(f"  {option.name}", str(default), escape(option.about))
    console.print(table)


def _table() -> Table:
    from rich.table import Table

    return Table(box=None, show_header=False, padding=(0, 2, 0, 0), pad_edge=False)


@app.command()
def methods(
    context: typer.Context,
    name: Annotated[str | None, typer.Argument(metavar="[NAME]", help="Show this method only.")] = None,
    plan: Annotated[
        str | None,
        typer.Option(metavar="PROBLEM", help="Print the plan of NAME, or of auto, for this problem, as a plan file."),
    ] = None,
    settings: Annotated[
        list[str] | None,
        typer.Option("--set", "-s", metavar="NAME=VALUE", help="With --plan: an option of the method. Repeatable."),
    ] = None,
    problem_settings: ProblemSettings = None,
    variant: Variant = "auto",
) -> None:
    """List the methods, their options and defaults.

    With --plan, print all that a method decides for a problem. `unrender run PROBLEM --method FILE.toml` runs such a file.
    """
    from rich.markup import escape

    if plan is not None:
        _print_plan(plan, name or "auto", arguments.settings(settings, "--set"), problem_settings, variant)
        return
    if unused := arguments.typed_options(context):
        raise InputError(f"methods: {unused[0]} needs --plan PROBLEM")
    from unrender.methods import method
    from unrender.methods import methods as registered

    console = Console(highlight=False)
    for one in [method(name)] if name is not None else registered().values():
        console.print(f"[bold]{one.name}[/]  {escape(one.summary)}", soft_wrap=True)
        console.print(_method_options(one))
        console.print()


def _print_plan(
    problem: str, name: str, settings: dict[str, str], problem_settings: list[str] | None, variant: str
) -> None:
    options = arguments.settings(problem_settings, "--problem-set")
    arguments.check_file(problem)
    from unrender.methods import method
    from unrender.methods.plan import plan_text

    chosen = method(name)
    chosen.start(settings)
    arguments.check_problem(problem, options)
    arguments.use_variant(variant)
    print(plan_text(chosen.plan(arguments.open_problem(problem, options), settings)), end="")


def _method_options(one: Method) -> Table:
    from rich.markup import escape

    table = _table()
    table.add_column(overflow="fold")
    table.add_column(overflow="fold")
    table.add_column(overflow="fold")
    for name, field in one.options.model_fields.items():
        default = "none" if field.default is None else str(field.default)
        about = f"{field.description} ({one.expected(name)})"
        table.add_row(f"  {name}", escape(default), escape(about))
    return table


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
