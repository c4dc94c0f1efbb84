"""The `unrender` command: how it starts and how it ends.

Exit status: 0; 2 where what the user gave is wrong; 3 where this machine cannot; 4 where a run failed; 5 where fresh pictures contradict
it; 130 where it was interrupted, 143 where it was told to terminate, and what a run had reached is saved.
Whatever is wrong is one line on standard error.
"""

from __future__ import annotations

import errno
import os
import sys
from collections.abc import Sequence
from importlib import metadata

from unrender.app.cli import memory
from unrender.app.cli.signals import ENVIRONMENT, INPUT, INTERRUPTED, WORDS, Signals
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
        return _run(given, signals)
    except Exception as error:
        if not memory.exhausted(error):
            raise
        status = _out_of_memory()
        if is_process:
            os._exit(status)  # what ends an interpreter needs memory, too
        return status


def _run(given: list[str], signals: Signals) -> int:
    import typer

    try:
        with signals:
            status = _execute(given)
        status = signals.status or status
    except (KeyboardInterrupt, typer.Abort):  # the latter is what Typer makes of the former
        status = signals.status or INTERRUPTED
    except BaseException:
        if not signals.status:
            raise
        status = signals.status  # what the interrupt became on its way out of compiled code
    return _complain(WORDS[status], status) if status in WORDS else status


def _execute(given: list[str]) -> int:
    import typer

    # Typer may bring its own copy of click, so its errors are found from the one that typer exports.
    usage_error: type[Exception] = next(k for k in typer.BadParameter.__mro__ if k.__name__ == "ClickException")
    try:
        if given == ["doctor"]:  # which has something to say where the rest cannot even be imported
            from unrender.app.cli.doctor import doctor

            return doctor()
        for argument in given:
            encode_text(argument, "command line")
        variant.prepare()  # before Dr.Jit is imported, which the rest of the command line does
        from unrender.app.cli.app import app

        status = app(given, prog_name="unrender", standalone_mode=False, obj=["unrender", *given])
        sys.stdout.flush()
        return status if isinstance(status, int) else 0
    except VariantError as error:
        return _complain(str(error), ENVIRONMENT)
    except UnrenderError as error:
        if limits.address_space() and memory.says_so(error):
            return _out_of_memory(f"{error}: ")
        return _complain(str(error), INPUT)
    except usage_error as error:
        return _complain(error.format_message(), INPUT)  # pyright: ignore[reportAttributeAccessIssue]
    except typer.Exit as end:
        return end.exit_code
    except BrokenPipeError:
        # Whoever read our output has gone; Python would complain once more when it flushes at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except OSError as error:  # a name that is too long, a folder that may not be entered, a full disk
        if error.errno in (errno.ENOMEM, errno.EAGAIN):
            return _out_of_memory()
        where = f"{error.filename}: " if error.filename else ""
        return _complain(f"{where}{error.strerror or error}", INPUT)


def _out_of_memory(what: str = "") -> int:
    memory.drop_errors()
    return _complain(what + memory.exhaustion(), ENVIRONMENT)


def _complain(message: str, status: int) -> int:
    print(f"unrender: {one_line(' '.join(message.split()))}", file=sys.stderr)
    return status


if __name__ == "__main__":
    sys.exit(main())
