"""TOML parsing, the line of each field, which `tomllib` does not report, and tables as pydantic models with one-line errors."""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

import pydantic
from pydantic import BaseModel, ConfigDict
from pydantic.fields import FieldInfo

from unrender.core.checks import encode_text
from unrender.core.errors import InputError
from unrender.core.text import did_you_mean, in_words
from unrender.io import bounded_files

if sys.version_info >= (3, 11):
    import tomllib
else:  # pragma: no cover
    import tomli as tomllib  # pyright: ignore[reportMissingImports]

Place = tuple[str | int, ...]
"""Path of a field: keys and indices from the top of the file."""

_UNKNOWN = "extra_forbidden", "unexpected_keyword_argument"  # pydantic's errors about fields that a model lacks
LARGEST = 3 << 17
"""Largest TOML file in bytes: `tomllib` takes half a second for this size."""
_MOST_DOTS = 200, 1 << 15
"""Largest number of dots in a line and in the file: `tomllib` takes quadratic time for a key of many parts."""

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
    """Parse TOML text. Raises `InputError`."""
    check(text, where)
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        message = str(error)
        head, _, tail = message.rpartition(" (at ")
        line, _, column = tail.rstrip(")").removeprefix("line ").partition(", ")
        if not line.isdigit():
            raise InputError(f"{where}:{text.rstrip().count(chr(10)) + 1}: not valid TOML: {message}") from error
        hint = ": the name is given above already; each table of a list begins with [[NAME]]" * ("Cannot" in head)
        raise InputError(f"{where}:{line}: not valid TOML: {head}{hint} ({column})") from error
    except RecursionError as error:
        raise InputError(f"{where}: not valid TOML: nested too deeply") from error
    except ValueError as error:  # excessively long numbers
        raise InputError(f"{where}: not valid TOML: {str(error)[:200]}") from error


def encode(text: str, where: str) -> bytes:
    """Return the bytes of a TOML file. Raises `InputError` for text that `parse` rejects or that is not valid Unicode."""
    data = encode_text(text, where)
    parse(text, where)
    return data


def array_table(heading: str, fields: Mapping[str, Any]) -> str:
    """Return one [[heading]] table with each nested table on one line."""
    import tomli_w

    def inline(table: Mapping[str, Any]) -> str:
        return "{ " + ", ".join(tomli_w.dumps({key: value}).strip() for key, value in table.items()) + " }"

    plain = {key: value for key, value in fields.items() if not isinstance(value, Mapping)}
    tables = {key: value for key, value in fields.items() if isinstance(value, Mapping)}
    rows = [f"{key} = {inline(value)}\n" for key, value in tables.items()]
    return f"[[{heading}]]\n{tomli_w.dumps(plain)}{''.join(rows)}"


def dotted(place: Place) -> str:
    """Format a path: ("parameters", 0, "bounds") as parameters[0].bounds."""
    text = ""
    for part in place:
        text += f"[{part}]" if isinstance(part, int) else f".{part}" if text else part
    return text


def find(text: str, place: Place) -> int:
    """Return the line, from 1, of the field at `place`, or of the nearest enclosing item, in valid TOML.

    A field inside an inline table or array has the line of its statement. A missing field has the line of its table, or line 1 at the top
    level.
    """
    known = _lines(text)
    for length in range(len(place), 0, -1):
        if place[:length] in known:
            return known[place[:length]]
    return 1


def _lines(text: str) -> dict[Place, int]:
    """Return {place: line} of every table header, every list of tables (that of its first) and every assignment."""
    # TOML separates lines by line feeds only; str.splitlines would also split at form feeds and other characters.
    rows = text.split("\n")
    line_of: dict[Place, int] = {}
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
            return line_of
        path = _path(statement)
        if row.startswith("["):
            table = _through_arrays(path, counts)
            if row.startswith("[["):
                line_of.setdefault(table, at + 1)
                counts[table] = counts.get(table, -1) + 1
                table = (*table, counts[table])
            line_of.setdefault(table, at + 1)
        else:
            for length in range(1, len(path) + 1):
                line_of.setdefault((*table, *path[:length]), at + 1)
        at = end
    return line_of


def _statement(rows: list[str], start: int) -> tuple[dict[str, Any] | None, int]:
    """Return the parsed header or key at row `start`, and the row after its statement, where brackets and strings are closed."""
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
    """Return the number of open brackets after a row, and the delimiter of an open multi-line string, "" for none."""
    at = 0 if quote or _SYNTAX.search(row) else len(row)
    while at < len(row):
        letter = row[at]
        if quote and letter == "\\" and quote[0] == '"':
            at += 2
        elif quote and row.startswith(quote, at):
            at += len(quote)
            if len(quote) == 3:  # up to two more quotes may precede the end of the string
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
    """Return the key of a statement whose value is a number."""
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
    """Return a header's path with the index of the latest element after each array of tables."""
    through: Place = ()
    for number, part in enumerate(path):
        through = (*through, part)
        if through in counts and number < len(path) - 1:
            through = (*through, counts[through])
    return through


class Table(BaseModel):
    """Fields of one table. Each field's description states the expected value."""

    model_config = ConfigDict(extra="forbid")


_M = TypeVar("_M")


def fields_of(model: Any) -> Mapping[str, FieldInfo]:
    """Return the fields of a table's model, a `Table` or a pydantic dataclass."""
    return model.model_fields if issubclass(model, Table) else model.__pydantic_fields__


def read(file: Path, model: type[_M], tables: Mapping[str, type]) -> tuple[_M, str]:
    """Return a file's content, and its text with Unix line ends for `error_at`.

    Args:
        file: file of at most `toml_lines.LARGEST` bytes.
        tables: models of the fields that are a table or a list of tables.

    Raises:
        InputError: the file is missing, or "problem.toml:12: parameters[0].bounds: expected ..., got ...".
    """
    text = bounded_files.read_text(file, LARGEST).replace("\r\n", "\n")
    content = parse(text, str(file))
    try:
        return pydantic.TypeAdapter(model).validate_python(content), text
    except pydantic.ValidationError as error:
        # Report an unknown field first: if a name is misspelt, the correct one is missing too.
        details = sorted(error.errors(), key=lambda detail: detail["type"] not in _UNKNOWN)
        raise error_at(file, text, *_explain(details[0], content, model, tables)) from error


def error_at(file: Path, text: str, place: Place, what: str) -> InputError:
    return InputError(f"{file}:{find(text, place)}: {dotted(place)}: {what}")


def _explain(detail: Any, content: Any, model: type, tables: Mapping[str, type]) -> tuple[Place, str]:
    """Return the place and message of one of pydantic's errors about the content of a file, without pydantic's additions for unions and
    tuples."""
    location = detail["loc"]
    place: Place = location[:1]
    if len(location) >= 2 and location[0] in tables:
        model, place = tables[location[0]], location[: 3 if isinstance(location[1], int) else 2]
    name = str(place[-1]) if place else ""
    fields = {field.alias or own: field for own, field in fields_of(model).items()}
    if detail["type"] in _UNKNOWN and name not in fields:
        names = ", ".join(fields)
        return place, f"no such field{did_you_mean(name, fields) or f'; there are {names}'}"
    expected = fields[name].description if name in fields else "a table"
    if detail["type"] == "missing" and len(location) == len(place):
        return place, f"missing, expected {expected}"
    for part in place:
        content = content[part]
    entry = location[len(place)] if len(location) > len(place) and isinstance(content, dict) else None
    got = str(detail["input"]).lower() if isinstance(detail["input"], bool) else in_words(detail["input"])
    got = f"{entry} = {got}" if isinstance(content, dict) and entry in content else got
    return place, f"expected {expected}, got {got if len(got) <= 80 else got[:77] + '...'}"


class FieldError(InputError):
    """An invalid field of a problem at `place`, such as ("parameters", 0, "bounds"). `owner` replaces the dotted path in the message."""

    def __init__(self, place: Place, what: str, owner: str | None = None):
        super().__init__(f"{owner or dotted(place)}: {what}")
        self.place = place
        self.what = what

    @classmethod
    @contextmanager
    def at(cls, place: Place, owner: str | None = None) -> Iterator[None]:
        """Raise the `InputError` of a block as the error of a field. A message that begins with the field's name, or that of its class,
        has it once."""
        try:
            yield
        except InputError as error:
            first, colon, rest = str(error).partition(": ")
            repeated = colon and first.lower() == str(place[-1]).replace("_", "").lower()
            raise cls(place, rest if repeated else str(error), owner) from error
