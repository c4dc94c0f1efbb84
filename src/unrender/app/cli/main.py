"""The `unrender` command: how it starts and how it ends.

Exit status: 0; 2 where what the user gave is wrong; 3 where this machine cannot; 4 where a run failed; 5 where fresh pictures contradict
it; 130 where it was interrupted, 143 where it was told to terminate, and what a run had reached is saved.
Whatever is wrong is one line on standard error.
"""

from __future__ import annotations

import contextlib
import errno
import os
import sys
from collections.abc import Callable, Sequence
from functools import partial
from importlib import metadata
from typing import Any

from unrender.app.cli import memory
from unrender.app.cli.signals import ENVIRONMENT, INPUT, INTERRUPTED, TERMINATED, WORDS, Signals
from unrender.backend import limits, variant
from unrender.core.checks import encode_text
from unrender.core.errors import UnrenderError, VariantError
from unrender.core.text import one_line


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line. Returns the exit status."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    if given == ["--version"]:  # at once: nothing else is imported
        print(metadata.version("unrender"))
        return 0
    try:
        memory.check()
    except VariantError as error:
        return _complain(str(error), ENVIRONMENT)
    is_process = arguments is None
    if is_process and memory.is_limited() and (ended := memory.supervised()) is not None:
        return ended
    signals = Signals(process=is_process)
    try:
        try:
            with signals:
                command = _command(given)
                found = command()
                sys.stdout.flush()
            status = found if isinstance(found, int) else 0
        except BaseException as error:
            if (ended := _status_of(error, signals)) is None:
                raise
            status = ended
        status = signals.status or status
        if status in WORDS:
            _complain(WORDS[status], status)
        if is_process and status in (INTERRUPTED, TERMINATED):
            # The interpreter's end would wait for kernels that nobody needs.
            with contextlib.suppress(OSError):
                sys.stdout.flush()
            os._exit(status)
        return status
    except Exception as error:
        if not memory.exhausted(error):
            raise
        status = _out_of_memory()
        if is_process:
            os._exit(status)  # what ends an interpreter needs memory, too
        return status


def _command(given: list[str]) -> Callable[[], Any]:
    """Return what carries out a command line."""
    if given == ["doctor"]:  # which has something to say where the rest cannot even be imported
        from unrender.app.cli.doctor import doctor

        return doctor
    for argument in given:
        encode_text(argument, "command line")
    variant.prepare()  # before Dr.Jit is imported, which the rest of the command line does
    from unrender.app.cli.app import app

    return partial(app, given, prog_name="unrender", standalone_mode=False, obj=["unrender", *given])


def _status_of(error: BaseException, signals: Signals) -> int | None:
    """Say in one line why a command failed. Returns its exit status; None for an error of the program itself."""
    import typer

    # Typer may bring its own copy of click, so its errors are found from the one that typer exports.
    usage_error: type[Exception] = next(k for k in typer.BadParameter.__mro__ if k.__name__ == "ClickException")
    match error:
        case VariantError():
            return _complain(str(error), ENVIRONMENT)
        case UnrenderError():
            if limits.address_space() and memory.says_so(error):
                return _out_of_memory(f"{error}: ")
            return _complain(str(error), INPUT)
        case typer.Exit():
            return error.exit_code
        case typer.Abort() | KeyboardInterrupt():  # the former is what Typer makes of the latter
            return signals.status or INTERRUPTED
        case BrokenPipeError():
            # Whoever read our output has gone; Python would complain once more when it flushes at exit.
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            return 1
        case OSError():  # a name that is too long, a folder that may not be entered, a full disk
            if error.errno in (errno.ENOMEM, errno.EAGAIN):
                return _out_of_memory()
            where = f"{error.filename}: " if error.filename else ""
            return _complain(f"{where}{error.strerror or error}", INPUT)
    if isinstance(error, usage_error):
        return _complain(error.format_message(), INPUT)  # pyright: ignore[reportAttributeAccessIssue]
    return signals.status or None  # what the interrupt became on its way out of compiled code


def _out_of_memory(what: str = "") -> int:
    memory.drop_errors()
    return _complain(what + memory.exhaustion(), ENVIRONMENT)


def _complain(message: str, status: int) -> int:
    print(f"unrender: {one_line(' '.join(message.split()))}", file=sys.stderr)
    return status


if __name__ == "__main__":
    sys.exit(main())
