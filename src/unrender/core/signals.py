"""What those who handle signals agree upon. The standard library's lightest modules alone: the command imports this first of all."""

from __future__ import annotations

import os
import signal
import sys

GRACEFUL = "unrender_graceful"
"""Attribute of a handler of SIGTERM in whose place a run may put its own, which ends the run after the present step."""
_WORDS = {signal.SIGINT: "interrupted", signal.SIGTERM: "terminated"}


def end_at_once() -> None:
    """Let Ctrl-C and SIGTERM end the command with one line while it is loaded, if this process is the command.

    Nothing is written until then. Without this, Python would show a traceback of whatever it was importing.
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
    del frame
    os.write(2, f"unrender: {_WORDS[signal.Signals(number)]}\n".encode())
    os._exit(128 + number)
