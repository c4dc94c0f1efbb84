"""Reading TOML, and in which line of it a field stands. (`tomllib` does not tell.)"""

from __future__ import annotations

import re
import sys
from collections.abc import Mapping
from typing import Any

from unrender.core.checks import encode_text
from unrender.core.errors import InputError

if sys.version_info >= (3, 11):
    import tomllib
else:  # pragma: no cover
    import tomli as tomllib  # pyright: ignore[reportMissingImports]

Place = tuple[str | int, ...]
"""A field's keys and indices from the top of the file."""

LARGEST = 3 << 17
"""Of a TOML file, in bytes: `tomllib` takes half a second for so many."""
_MOST_DOTS = 200, 1 << 15
"""In a line and in all: `tomllib` takes quadratic time for a key of many parts."""


_SYNTAX = re.compile(r"""["'#\[\]{}]""")
_KEY = re.compile(r"""(?:[^"'=#]|"(?:[^"\\]|\\.)*"|'[^']*')*=""")


def check(text: str, where: str) -> None:
    """Raise `InputError` for text that would take long to parse."""
    if len(text) > LARGEST:
        raise InputError(f"{where}: larger than {LARGEST >> 10} KiB, which no such file is")
    line, everywhere = _MOST_DOTS
    if text.count(".") > everywhere:
        raise InputError(f"{where}: more than {everywhere} dots, expected numbers in a file of their own")
    for number, row in enumerate(text.split("\n"), 1):
        if row.count(".") > line:
            raise InputError(f"{where}:{number}: more than {line} dots, expected keys of a few parts")


def parse(text: str, where: str) -> dict[str, Any]:
    """What TOML text says. Raises `InputError`."""
    check(text, where)
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        message = str(error)
        head, _, tail = message.rpartition(" (at ")
        line, _, column = tail.rstrip(")").removeprefix("line ").partition(", ")
        if not line.isdigit():
            raise InputError(f"{where}:{text.rstrip().count(chr(10)) + 1}: not valid TOML: {message}") from error
        raise InputError(f"{where}:{line}: not valid TOML: {head} ({column})") from error
    except RecursionError as error:
        raise InputError(f"{where}: not valid TOML: nested too deeply") from error
    except ValueError as error:  # of numbers without end
        raise InputError(f"{where}: not valid TOML: {str(error)[:200]}") from error


def encode(text: str, where: str) -> bytes:
    """Return the bytes of a TOML file that `parse` takes. Raises `InputError` for text that it would refuse or that is no Unicode."""
    data = encode_text(text, where)
    parse(text, where)
    return data


def array_table(heading: str, fields: Mapping[str, Any]) -> str:
    """One [[heading]] as people write it: tables among its fields stand in one line each."""
    import tomli_w

    def inline(table: Mapping[str, Any]) -> str:
        return "{ " + ", ".join(tomli_w.dumps({key: value}).strip() for key, value in table.items()) + " }"

    plain = {key: value for key, value in fields.items() if not isinstance(value, Mapping)}
    tables = {key: value for key, value in fields.items() if isinstance(value, Mapping)}
    rows = [f"{key} = {inline(value)}\n" for key, value in tables.items()]
    return f"[[{heading}]]\n{tomli_w.dumps(plain)}{''.join(rows)}"


def dotted(place: Place) -> str:
    """("parameters", 0, "bounds") as parameters[0].bounds."""
    text = ""
    for part in place:
        text += f"[{part}]" if isinstance(part, int) else f".{part}" if text else part
    return text


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
    """The header or key of the statement that begins at row `start`, parsed by itself, and the row after the statement.

    A statement ends where its brackets and strings do.
    """
    depth, quote, end = 0, "", start
    while end < len(rows):
        depth, quote = _open_after(rows[end], depth, quote)
        end += 1
        if depth <= 0 and not quote:
            break
    row = rows[start]
    match = None if row.lstrip().startswith("[") else _KEY.match(row)
    try:
        return tomllib.loads(row if match is None else f"{match[0]}0"), end
    except (tomllib.TOMLDecodeError, RecursionError):
        return None, len(rows)


def _open_after(row: str, depth: int, quote: str) -> tuple[int, str]:
    """How many brackets are open after a row, and by what the string ends that is, "" for none."""
    at = 0 if quote or _SYNTAX.search(row) else len(row)
    while at < len(row):
        letter = row[at]
        if quote and letter == "\\" and quote[0] == '"':
            at += 2
        elif quote and row.startswith(quote, at):
            at += len(quote)
            if len(quote) == 3:  # before its end a string may have two more of them
                at += len(row[at : at + 2]) - len(row[at : at + 2].lstrip(letter))
            quote = ""
        elif quote:
            at += 1
        elif letter == "#":
            break
        elif letter in "\"'":
            quote = 3 * letter if row.startswith(3 * letter, at) else letter
            at += len(quote)
        else:
            depth += (letter in "[{") - (letter in "]}")
            at += 1
    return depth, quote if len(quote) == 3 else ""


def _path(statement: dict[str, Any]) -> Place:
    """The key of a statement whose value is a number."""
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
