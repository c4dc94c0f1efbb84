"""`unrender watch`: a live page of runs."""

from __future__ import annotations

import contextlib
import os
import webbrowser
from pathlib import Path
from typing import Annotated

import typer

from unrender.core.errors import InputError
from unrender.core.suggestions import did_you_mean

__all__ = ["watch"]

_NICE = 10


def watch(
    directories: Annotated[list[Path], typer.Argument(metavar="DIR...", help="Run folders, under way or finished.")],
    port: Annotated[int, typer.Option(min=0, max=65535, help="Of 127.0.0.1; 0 takes a free one.")] = 0,
    no_browser: Annotated[bool, typer.Option("--no-browser", help="Print the address, and open nothing.")] = False,
) -> None:
    """Serve a page that shows runs as they go, with buttons to pause, resume and stop them.

    It is served to this machine alone, under an address that holds a secret. Ctrl-C ends the page, not the runs.
    """
    from unrender.watch import server

    for directory in directories:
        if not directory.is_dir():
            siblings = [p.name for p in directory.parent.iterdir() if p.is_dir()] if directory.parent.is_dir() else []
            what = "a file, expected a run folder" if directory.exists() else "no such folder"
            raise InputError(f"{directory}: {what}{did_you_mean(directory.name, siblings)}")
    if len({directory.resolve() for directory in directories}) < len(directories):
        raise InputError("watch: a run folder is given twice")
    with server.listen(port) as opened:
        address = server.Address(opened.getsockname()[1])
        typer.echo(f"watching at {address.url}\nCtrl-C ends this page; the runs go on")
        if not no_browser:
            webbrowser.open(address.url)  # the socket listens already, and a browser waits
        with contextlib.suppress(OSError):
            os.nice(_NICE)  # what is watched goes first; only now, since the browser would inherit it
        with contextlib.suppress(KeyboardInterrupt):
            server.serve([directory.absolute() for directory in directories], address, opened)
