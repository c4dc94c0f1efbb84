"""--workers of one run: its views, dealt to processes by Ray."""

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
        help="With --workers: parameters go as 16-bit differences, gradients in single precision: half the bytes.",
        show_default=False,
    ),
]


def check(workers: str | None, compress: bool, insecure: bool = False) -> Workers | None:
    """See `arguments.workers`; raises `InputError` for --compress without workers, too."""
    if compress and workers is None:
        raise InputError("--compress: is of what is sent to workers; give --workers, too")
    found = arguments.workers(workers, insecure)
    if compress and found is None:
        raise InputError(
            "--compress: is of what is sent to workers; --workers 1 is this process alone, which is sent nothing"
        )
    return found


def variant_again(typed: str | None, record: RunRecord) -> str:
    """Mitsuba's variant for the workers of a run that goes on: what was typed, else theirs so far, else `auto` as for a new run."""
    from unrender.backend.variant import CUDA, LLVM

    before = record.problem.description.get("workers")
    return typed or (before if before in (CUDA, LLVM) else "auto")


@contextlib.contextmanager
def dealt(
    problem: Problem, workers: Workers | None, compress: bool, variant: str, threads: int | None, console: Console
) -> Iterator[Problem]:
    """The problem, its views dealt to workers; itself for None. See `unrender.deal`."""
    if workers is None:
        yield problem
        return
    from rich.markup import escape

    from unrender.app.distributed.distribute import distribute

    def tell(line: str) -> None:
        console.print(f"[yellow]workers[/] {escape(line)}", soft_wrap=True)

    with contextlib.ExitStack() as stack:
        with phases.phase("workers"):
            found = stack.enter_context(distribute(problem, workers, compress, variant, threads, tell))
        yield found
