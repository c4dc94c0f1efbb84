"""The option --workers of a single run: distribution of its views to Ray processes."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import TYPE_CHECKING, Annotated

import typer

from unrender.app.cli import arguments
from unrender.core import phases
from unrender.core.errors import InputError

if TYPE_CHECKING:
    from unrender.app.distributed.cluster import Workers
    from unrender.display.terminal import Console
    from unrender.runs.folder.schema import RunRecord
    from unrender.scene.problem import Problem

Compress = Annotated[
    bool,
    typer.Option(
        "--compress",
        help="With --workers: send parameters as 16-bit differences and gradients in single precision, half the bytes.",
        show_default=False,
    ),
]


def check(workers: str | None, compress: bool, insecure: bool = False) -> Workers | None:
    """Return `arguments.workers`. Raise `InputError` also for --compress without other processes."""
    if compress and workers is None:
        raise InputError("--compress: requires --workers")
    parsed = arguments.workers(workers, insecure)
    if compress and parsed is None:
        raise InputError("--compress: requires other processes, but --workers 1 is this process; use more workers")
    return parsed


def variant_again(typed: str | None, record: RunRecord) -> str:
    """Return the Mitsuba variant of the workers of a resumed run: the typed one, else the run's, else `auto`."""
    from unrender.backend.variant import VARIANTS

    before = record.problem.description.get("workers")
    return typed or (before if before in VARIANTS else "auto")


@contextlib.contextmanager
def distributed(
    problem: Problem, workers: Workers | None, compress: bool, variant: str, threads: int | None, console: Console
) -> Iterator[Problem]:
    """Yield the problem with its views distributed to workers; the problem itself for None. See `unrender.app.distribute`."""
    if workers is None:
        yield problem
        return
    from rich.markup import escape

    from unrender.app.distributed.distribute import distribute

    def tell(line: str) -> None:
        console.print(f"[yellow]workers[/] {escape(line)}", soft_wrap=True)

    with contextlib.ExitStack() as stack:
        with phases.phase("workers"):
            inner = stack.enter_context(distribute(problem, workers, compress, variant, threads, tell))
        yield inner
