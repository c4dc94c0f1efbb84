"""Measurements in a process of their own, which Mitsuba may end or keep waiting."""

from __future__ import annotations

import multiprocessing
import traceback
from collections.abc import Callable
from typing import Any

_LONGEST = 400
"""Characters of a reason that are kept. The traceback is printed."""


def call(function: Callable[..., dict[str, Any]], *arguments: Any, seconds: float) -> dict[str, Any]:
    """Return what a function returns in a forked process; {"failed": reason} where it raises, ends the process, or takes longer."""
    context = multiprocessing.get_context("fork")
    ours, theirs = context.Pipe(duplex=False)
    process = context.Process(target=_send, args=(theirs, function, arguments))
    process.start()
    theirs.close()
    try:
        found = ours.recv() if ours.poll(seconds) else {"failed": f"no answer within {seconds:g} s"}
    except EOFError:
        found = {"failed": "the process ended"}
    process.kill()
    process.join()
    return found


def _send(connection: Any, function: Callable[..., dict[str, Any]], arguments: tuple[Any, ...]) -> None:
    try:
        connection.send(function(*arguments))
    except BaseException as error:  # any traceback is a finding
        traceback.print_exc()
        connection.send({"failed": f"{type(error).__name__}: {error}"[:_LONGEST]})
