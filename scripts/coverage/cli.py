"""`python -m scripts.coverage`: measure Mitsuba's plugins. The site makes pages of the record."""

from __future__ import annotations

import argparse
import json
import multiprocessing
import traceback
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import unrender as ur

__all__ = ["RECORD", "main"]

RECORD = Path(__file__).parent / "record.json"
_SECONDS = 600.0
_LONGEST = 400
"""Characters of a reason that are kept. The traceback is printed."""


def main(arguments: Sequence[str]) -> int:
    """Do what the command line says; the exit status."""
    parser = argparse.ArgumentParser("python -m scripts.coverage", description=__doc__)
    parser.add_argument("plugins", nargs="*", help="measure these alone; the record keeps the others")
    parser.add_argument("--descents", action="store_true", help="measure the descents alone; the record keeps the rest")
    parser.add_argument("--record", type=Path, default=RECORD, help="the record's file")
    given = parser.parse_args(arguments)
    ur.use()
    from scripts.coverage.plugins import IN_INSTANCES, PLUGINS

    scenes = {**PLUGINS, **IN_INSTANCES}
    record = json.loads(given.record.read_text()) if given.record.is_file() else {}
    for name in given.plugins or scenes:
        known = record.get(name) if given.descents else None
        if known is not None and "parameters" not in known:
            continue  # refused as a whole
        record[name] = apart(_measure, name, known, seconds=_SECONDS)
        print(name, json.dumps(record[name]), flush=True)
        given.record.write_text(json.dumps({key: record[key] for key in scenes if key in record}, indent=1) + "\n")
    return 0


def _measure(name: str, known: dict[str, Any] | None) -> dict[str, Any]:
    from scripts.coverage.measure import measure  # imports Mitsuba, in the process of its own

    return measure(name, known)


def apart(function: Callable[..., dict[str, Any]], *arguments: Any, seconds: float) -> dict[str, Any]:
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
