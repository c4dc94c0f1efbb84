"""Entry point and exit of the `unrender` command.

Exit status: 0 for success; 2 for invalid input; 3 if this machine lacks something; 4 if a run failed; 5 if fresh pictures contradict
it; 130 after an interrupt and 143 after SIGTERM, with the state of a run saved. Every error is one line on standard error.
"""

from __future__ import annotations

import contextlib
import errno
import io
import os
import sys
import time
from collections.abc import Callable, Sequence
from functools import partial
from importlib import metadata
from typing import Any

from unrender.app.cli import memory
from unrender.app.cli.signals import ENVIRONMENT, INPUT, INTERRUPTED, TERMINATED, WORDS, Signals
from unrender.backend import limits, variant
from unrender.core import timing
from unrender.core.checks import encode_text
from unrender.core.errors import InputError, UnknownOptionError, UnrenderError, VariantError
from unrender.core.text import one_line


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return the exit status."""
    words, is_process = list(sys.argv[1:] if arguments is None else arguments), arguments is None
    if is_process:
        _prepare_process()
    if words == ["--version"]:  # without further imports
        print(metadata.version("unrender"))
        return 0
    try:
        memory.check()
    except VariantError as error:
        return _complain(str(error), ENVIRONMENT)
    if is_process and memory.is_limited() and (ended := memory.supervised()) is not None:
        return ended
    signals = Signals(process=is_process)
    try:
        try:
            with signals:
                command = _command(words, time.perf_counter() - (sum(timing.scheduled()) if is_process else 0.0))
                value = command()
                sys.stdout.flush()
            status = value if isinstance(value, int) else 0
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
            os._exit(status)  # a regular interpreter exit needs memory
        return status


def _prepare_process() -> None:
    """Use one thread of BLAS unless told otherwise, discard what is written to closed streams, as after `>&-`, and print `?` for characters
    that the output's encoding lacks."""
    # Threads of BLAS wait for one another: beside busy processes, systems of 40 numbers took a hundred times as long with two.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, "w", encoding="utf-8"))  # noqa: SIM115
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="replace")


def _command(words: list[str], began: float) -> Callable[[], Any]:
    if words == ["doctor"]:  # works even if other modules cannot be imported
        from unrender.app.cli.doctor import doctor

        return doctor
    for argument in words:
        encode_text(argument, "command line")
        # A folder of that name would look like the home folder in every message.
        if (path := argument.rpartition("=")[2]) == "~" or path.startswith("~/"):
            raise InputError(f"{argument}: the shell has not replaced ~ by the home folder; write $HOME{path[1:]}")
    if not _has_folder():  # Mitsuba would end the process
        raise InputError("the current folder no longer exists; change to another one")
    variant.prepare()  # must run before Dr.Jit is imported
    from unrender.app.cli.app import app

    return partial(app, words, prog_name="unrender", standalone_mode=False, obj=(began, ["unrender", *words]))


def _has_folder() -> bool:
    try:
        return bool(os.getcwd())
    except FileNotFoundError:
        return False


def _status_of(error: BaseException, signals: Signals) -> int | None:
    """Print in one line why a command failed and return its exit status; None for an error of the program itself."""
    import typer

    # Typer may vendor its own copy of click, so take the error classes from the one that it exports.
    usage_error: type[Exception] = next(k for k in typer.BadParameter.__mro__ if k.__name__ == "ClickException")
    match error:
        case UnrenderError():
            if limits.address_space() and memory.says_so(error):
                return _out_of_memory(f"{error}: ")
            if isinstance(error, UnknownOptionError):
                return _complain(f"{error} (-p sets options of a gallery problem)", INPUT)
            return _complain(str(error), ENVIRONMENT if isinstance(error, VariantError) else INPUT)
        case typer.Exit():
            return error.exit_code
        case typer.Abort() | KeyboardInterrupt():  # Typer converts the latter to the former
            return signals.status or INTERRUPTED
        case BrokenPipeError():
            # The reader of the output has closed it. Python would report this again when it flushes at exit.
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            return 1
        case OSError():  # a name that is too long, a folder that may not be entered, a full disk
            if error.errno in (errno.ENOMEM, errno.EAGAIN):
                return _out_of_memory()
            where = f"{error.filename}: " if error.filename else ""
            return _complain(f"{where}{error.strerror or error}", INPUT)
    if isinstance(error, usage_error):
        return _complain(error.format_message(), INPUT)  # pyright: ignore[reportAttributeAccessIssue]
    return signals.status or None  # compiled code may have converted the interrupt


def _out_of_memory(what: str = "") -> int:
    memory.drop_errors()
    return _complain(what + memory.exhaustion(), ENVIRONMENT)


def _complain(message: str, status: int) -> int:
    print(f"unrender: {one_line(' '.join(message.split()))}", file=sys.stderr)
    return status


if __name__ == "__main__":
    sys.exit(main())
