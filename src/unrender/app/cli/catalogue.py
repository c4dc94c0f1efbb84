"""`unrender gallery` and `unrender methods`: the built-in problems, and the available methods with their options."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from unrender.app.cli import arguments
from unrender.app.cli.arguments import MOST_SAMPLES, NoCache, Overwrite, ProblemSettings, Variant
from unrender.core.errors import InputError
from unrender.display.terminal import Console

if TYPE_CHECKING:
    from rich.table import Table

    from unrender.methods import Method
    from unrender.scene.problem import Problem


def gallery(
    context: typer.Context,
    name: Annotated[str | None, typer.Argument(metavar="[NAME]", help="Describe this problem.")] = None,
    out: Annotated[
        Path | None,
        typer.Option(help="With NAME: render its references, start and ground truth to PNG files in this folder."),
    ] = None,
    problem_settings: ProblemSettings = None,
    variant: Variant = "auto",
    spp: Annotated[
        int, typer.Option(min=1, max=MOST_SAMPLES, help="With --out: samples per pixel of start and ground truth.")
    ] = 64,
    overwrite: Overwrite = False,
    no_cache: NoCache = False,
) -> None:
    """List the gallery's problems, or describe one."""
    from rich.markup import escape

    from unrender import gallery as problems

    _refuse_unused(arguments.typed_options(context), name)
    console = Console(highlight=False)
    if name is None:
        table = _table()
        for known in problems.names():
            table.add_row(known, escape(problems.summary(known)))
        console.print(table)
        return
    console.print(f"[bold]{escape(name)}[/]  {escape(problems.summary(name))}", soft_wrap=True)
    options = arguments.settings(problem_settings, "--problem-set")
    table = _table()
    for option in problems.options(name):
        default = option.default if isinstance(option.default, (int, float, str)) else type(option.default).__name__
        table.add_row(f"  {option.name}", str(default), escape(option.about))
    console.print(table)
    if out is None and not options:
        return
    folder = None if out is None else arguments.folder(out, name, overwrite, "view0-reference.png")
    try:
        from unrender.app.cli.execute import introduce
        from unrender.runs.progress import Progress

        with Progress(console):
            running = arguments.use_variant(variant)
            problem = arguments.open_problem(name, options, not no_cache)
        introduce(console, problem, running)
        console.print(_parameters(problem))
        if folder is not None:
            for path in _draw(problem, folder, spp):
                console.say(str(path))
    finally:
        if folder is not None:
            arguments.remove_if_empty(folder)


def _refuse_unused(typed: Sequence[str], name: str | None) -> None:
    opens = ("--out", "--problem-set")
    needs = {"--spp": ("--out",), "--overwrite": ("--out",), "--variant": opens, "--no-cache": opens}
    for option in typed:
        if name is None:
            raise InputError(f"gallery: {option} needs the NAME of a problem")
        if not set(needs.get(option, typed)) & set(typed):
            raise InputError(f"gallery: {option} needs {' or '.join(needs[option])}")


def _table() -> Table:
    from rich.table import Table

    return Table(box=None, show_header=False, padding=(0, 2, 0, 0), pad_edge=False)


def _parameters(problem: Problem) -> Table:
    import numpy as np
    from rich.markup import escape

    table = _table()
    initial = {key: np.asarray(value) for key, value in problem.initial().items()}
    for key, error in problem.parameter_error(problem.initial()).items():
        low, high = (("open" if side is None else f"{side:g}") for side in problem.unknowns[key].bounds)
        unit = problem.unknowns[key].measure.unit
        about = f"shape {initial[key].shape}, bounds {low} to {high}, error of the start {error:.3g}{unit}"
        table.add_row(escape(key), about)
    return table


def _draw(problem: Problem, folder: Path, spp: int) -> list[Path]:
    """Write PNG files of each view's reference, start and ground truth, with the exposure of the reference."""
    import numpy as np

    from unrender.display.pictures import png
    from unrender.io.files import write
    from unrender.losses.metrics import exposure, srgb
    from unrender.scene.render import render

    written: list[Path] = []
    for index, view in enumerate(problem.views):
        reference = np.asarray(view.reference, np.float32)
        requests = {"reference": reference, "start": render(problem, None, index, spp)}
        if set(problem.truth) == {parameter.key for parameter in problem.parameters}:
            requests["truth"] = render(problem, problem.truth, index, spp)
        for what, picture in requests.items():
            path = folder / f"view{index}-{what}.png"
            written.append(write(path, png(srgb(picture * exposure(reference)))))
    return written


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
    for one in [method(name)] if name else registered().values():
        console.print(f"[bold]{one.name}[/]  {escape(one.summary)}", soft_wrap=True)
        console.print(_method_options(one))
        console.print()


def _print_plan(
    problem: str, name: str, settings: dict[str, str], problem_settings: list[str] | None, variant: str
) -> None:
    from unrender.methods import method
    from unrender.methods.plan import plan_text

    chosen, options = method(name), arguments.settings(problem_settings, "--problem-set")
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
