"""`unrender report`, the page of an earlier run or sweep, and `unrender watch`, a live page of runs."""

from __future__ import annotations

import contextlib
import os
import webbrowser
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from unrender.app.cli import arguments
from unrender.core.errors import InputError
from unrender.core.text import did_you_mean
from unrender.display.terminal import echo

if TYPE_CHECKING:
    from unrender.app.sweeps.record import SweepRecord
    from unrender.app.watch import server

_MOST = 6


def write_page(folder: Path, record: SweepRecord) -> Path:
    """Write compare.html of the six best finished trials; return its path. Raise `InputError` if none has finished."""
    from unrender.app import report
    from unrender.app.sweeps.record import best_folders

    directories = best_folders(folder, record, _MOST)
    if not directories:
        raise InputError(f"{folder}: no trial of the sweep has finished")
    return report.write_comparison(*report.load_comparison(directories), folder)


def report(
    directory: Annotated[
        Path, typer.Argument(metavar="DIR", help="A run folder, that of a run in stages, or a sweep's.")
    ],
) -> None:
    """Rewrite the page of a run folder, or of a sweep's best trials, and print its path."""
    from unrender.app.sweeps.record import SWEEP, read_sweep

    if (directory / SWEEP).is_file():
        echo(write_page(directory, read_sweep(directory)))
        return
    from unrender.app import report as pages

    echo(pages.page(arguments.finished_run(directory)))


_NICE = 10


def watch(
    directories: Annotated[
        list[Path],
        typer.Argument(
            metavar="DIR...", help="Run folders of running, finished or future runs; or folders of sweeps or stages."
        ),
    ],
    port: Annotated[int, typer.Option(min=0, max=65535, help="Port on 127.0.0.1; 0 selects a free one.")] = 0,
    no_browser: Annotated[
        bool, typer.Option("--no-browser", help="Print the address without opening a browser.")
    ] = False,
) -> None:
    """Serve a page that shows runs as they go, with buttons to pause, resume and stop them.

    It is served to this machine only, under an address that contains a secret. Ctrl-C ends the page, not the runs.
    """
    from unrender.app.watch import server

    directories = [run for directory in directories for run in _runs(directory)]
    for directory in directories:
        if directory.exists() and not directory.is_dir():
            raise InputError(f"{directory}: a file, expected a run folder")
    if len({directory.resolve() for directory in directories}) < len(directories):
        raise InputError("watch: a run folder is listed twice")
    for directory in directories:
        if not directory.is_dir():
            echo(f"{directory}: no such folder yet: waiting for a run to begin there{_similar(directory)}")
    with server.listen(port) as opened:
        address = server.Address(opened.getsockname()[1])
        echo(f"watching at {address.url}")
        echo("Ctrl-C stops this page; the runs continue")
        with contextlib.ExitStack() as stack, contextlib.suppress(KeyboardInterrupt):
            on_admission = (
                None if no_browser else _open(address, stack)
            )  # the socket is listening already, so the browser can connect
            with contextlib.suppress(OSError):
                os.nice(_NICE)  # give the watched runs priority; not earlier, since the browser would inherit it
            server.serve([directory.absolute() for directory in directories], address, opened, on_admission)


def _runs(directory: Path) -> list[Path]:
    """Return the run folders of a folder of stages or of a sweep; for any other folder, itself."""
    from unrender.app.stages import stages_file
    from unrender.app.sweeps.record import watched_folders

    return [run for stage in stages_file.run_folders(directory) for run in watched_folders(stage)]


def _similar(directory: Path) -> str:
    """Return a hint at a sibling run folder with a similar name."""
    siblings: list[str] = []
    with contextlib.suppress(OSError):
        siblings = [path.name for path in directory.parent.iterdir() if path.is_dir()]
    return did_you_mean(directory.name, siblings)


def _open(address: server.Address, stack: contextlib.ExitStack) -> Callable[[], object] | None:
    """Open the page in a browser; return a function to call once the browser has connected."""
    from unrender.app.watch.connections import Redirect

    try:
        redirect = stack.enter_context(Redirect(address.url))
    except OSError as error:
        echo(f"no browser was opened: {error.strerror or error}; open the address by hand", err=True)
        return None
    webbrowser.open(redirect.path.as_uri())
    return redirect.remove
