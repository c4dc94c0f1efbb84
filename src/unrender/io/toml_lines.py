"""Reading TOML, and in which line of it a field stands. (`tomllib` does not tell.)"""

from __future__ import annotations

import sys
from typing import Any

from unrender.core.errors import InputError

__all__ = ["Place", "find", "parse"]

if sys.version_info >= (3, 11):
    import tomllib
else:  # pragma: no cover
    import tomli as tomllib  # pyright: ignore[reportMissingImports]

Place = tuple[str | int, ...]
"""A field's keys and indices from the top of the file."""

_LONGEST_STATEMENT = 2000


def parse(text: str, where: str) -> dict[str, Any]:
    """What TOML text says. Raises `InputError`."""
    try:
        return tomllib.loads(text)
    except RecursionError as error:
        raise InputError(f"{where}: not valid TOML: nested too deeply") from error
    except ValueError as error:  # tomllib's own among them, and those of numbers without end
        raise InputError(f"{where}: not valid TOML: {str(error)[:200]}") from error


def find(text: str, place: Place) -> int:
    """The line, from 1, where the field at `place` or else the nearest thing around it is given, in valid TOML.

    A field inside an inline table or array is found by the statement that holds it. A place that is not in the file at
    all (something is missing) is found by the table it should be in, and by line 1 at the top level.
    """
    known = _lines(text)
    for length in range(len(place), 0, -1):
        if place[:length] in known:
            return known[place[:length]]
    return 1


def _lines(text: str) -> dict[Place, int]:
    """{place: line} of every table header and every assignment."""
    # Split as TOML does: by line feeds alone (str.splitlines would also split at form feeds and the like).
    rows = text.split("\n")
    found: dict[Place, int] = {}
    counts: dict[Place, int] = {}
    table: Place = ()
    at = 0
    while at < len(rows):
        row = rows[at].strip()
        if not row or row.startswith("#"):
            at += 1
            continue
        statement, end = _statement(rows, at)
        if statement is None:
            return found
        path = _path(statement)
        if row.startswith("["):
            table = _through_arrays(path, counts)
            if row.startswith("[["):
                counts[table] = counts.get(table, -1) + 1
                table = (*table, counts[table])
            found.setdefault(table, at + 1)
        else:
            for length in range(1, len(path) + 1):
                found.setdefault((*table, *path[:length]), at + 1)
        at = end
    return found


def _statement(rows: list[str], start: int) -> tuple[dict[str, Any] | None, int]:
    """The statement that begins at row `start`, parsed by itself, and the row after it.

    In a valid file no true prefix of a statement of several rows is valid: its bracket or string is open until its end.
    """
    for end in range(start + 1, min(len(rows), start + _LONGEST_STATEMENT) + 1):
        try:
            return tomllib.loads("\n".join(rows[start:end])), end
        except tomllib.TOMLDecodeError:
            continue
    return None, len(rows)


def _path(statement: dict[str, Any]) -> Place:
    """The key of a statement: down while there is one key only, which may lead on into an inline table, at no harm."""
    path: list[str | int] = []
    value: Any = statement
    while True:
        if isinstance(value, list) and len(value) == 1 and isinstance(value[0], dict) and not value[0]:
            return tuple(path)  # [[header]]
        if not isinstance(value, dict) or len(value) != 1:
            return tuple(path)
        key, value = next(iter(value.items()))
        path.append(key)


def _through_arrays(path: Place, counts: dict[Place, int]) -> Place:
    """A header's path with the index of the latest element after each array of tables on the way."""
    through: Place = ()
    for number, part in enumerate(path):
        through = (*through, part)
        if through in counts and number < len(path) - 1:
            through = (*through, counts[through])
    return through
