"""Signal handling that several modules share. Imports light modules only, because the command imports it first."""

from __future__ import annotations

import os
import signal
import sys

GRACEFUL = "unrender_graceful"
"""Name of an attribute that marks a SIGTERM handler as replaceable: a run may install its own, which ends it after the current step."""
_WORDS = {signal.SIGINT: "interrupted", signal.SIGTERM: "terminated"}


def end_at_once() -> None:
    """Make Ctrl-C and SIGTERM end the command with one line while it imports, if this process is the command.

    The command writes no file while it imports. Without these handlers Python would print the traceback of an import.
    """
    if not _is_command():
        return
    for number in _WORDS:
        if signal.getsignal(number) in (signal.SIG_DFL, signal.default_int_handler):
            signal.signal(number, _end)


def _is_command() -> bool:
    """Return whether this process is `unrender ...` or `python -m unrender ...`, and not a program that imports it."""
    name = os.path.basename(sys.argv[0]) if sys.argv else ""
    if name == "-m":  # while `python -m` looks for the package
        words = sys.orig_argv
        return "-m" in words and words[words.index("-m") + 1 : words.index("-m") + 2] == ["unrender"]
    return name in ("unrender", "unrender.exe", "unrender-script.py")


def _end(number: int, frame: object) -> None:
    os.write(2, f"unrender: {_WORDS[signal.Signals(number)]}\n".encode())
    os._exit(128 + number)
