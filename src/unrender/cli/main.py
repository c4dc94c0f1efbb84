"""The `unrender` command: how it starts and how it ends.

Exit status: 0; 2 where what the user gave is wrong; 3 where this machine cannot; 130 where it was interrupted.
Whatever is wrong is one line on standard error.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from importlib import metadata

from unrender.backend import variant
from unrender.core.errors import UnrenderError, VariantError

__all__ = ["main"]

INPUT, ENVIRONMENT, INTERRUPTED = 2, 3, 130


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line. Returns the exit status."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    if given == ["--version"]:  # at once: nothing else is imported
        print(metadata.version("unrender"))
        return 0
    import typer

    # Typer may bring its own copy of click, so its errors are found from the one that typer exports.
    usage_error: type[Exception] = next(k for k in typer.BadParameter.__mro__ if k.__name__ == "ClickException")
    try:
        if given == ["doctor"]:  # which has something to say where the rest cannot even be imported
            from unrender.cli.doctor import doctor

            return doctor()
        variant.prepare()  # before Dr.Jit is imported, which the rest of the command line does
        from unrender.cli.app import app

        status = app(given, prog_name="unrender", standalone_mode=False, obj=["unrender", *given])
        sys.stdout.flush()
        if status == INTERRUPTED:  # what Typer makes of Ctrl-C, and what a run returns that kept its results
            return _complain("interrupted", INTERRUPTED)
        return status if isinstance(status, int) else 0
    except VariantError as error:
        return _complain(str(error), ENVIRONMENT)
    except UnrenderError as error:
        return _complain(str(error), INPUT)
    except usage_error as error:
        return _complain(error.format_message(), INPUT)  # pyright: ignore[reportAttributeAccessIssue]
    except typer.Exit as end:
        return end.exit_code
    except (KeyboardInterrupt, typer.Abort):
        return _complain("interrupted", INTERRUPTED)
    except BrokenPipeError:
        # Whoever read our output has gone; Python would complain once more when it flushes at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1


def _complain(message: str, status: int) -> int:
    print(f"unrender: {' '.join(message.split())}", file=sys.stderr)
    return status


if __name__ == "__main__":
    sys.exit(main())
