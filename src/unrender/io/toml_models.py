"""TOML files as pydantic models, with one-line errors: the file, its line, the field, the expected value."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

import pydantic
from pydantic import BaseModel, ConfigDict

from unrender.core.errors import InputError
from unrender.core.text import did_you_mean
from unrender.io import bounded_files, toml_lines
from unrender.io.toml_lines import Place, dotted


class Table(BaseModel):
    """Fields of one table. Each field's description states the expected value."""

    model_config = ConfigDict(extra="forbid")


_M = TypeVar("_M", bound=Table)


def read(file: Path, model: type[_M], tables: Mapping[str, type[Table]]) -> tuple[_M, str]:
    """Return a file's content, and its text with Unix line ends for `error_at`.

    Args:
        file: file of at most `toml_lines.LARGEST` bytes.
        model: model of the top level.
        tables: models of the fields that are a table or a list of tables.

    Raises:
        InputError: the file is missing, or "problem.toml:12: parameters[0].bounds: expected ..., got ...".
    """
    text = bounded_files.read_text(file, toml_lines.LARGEST).replace("\r\n", "\n")
    try:
        return model.model_validate(toml_lines.parse(text, str(file))), text
    except pydantic.ValidationError as error:
        # Report an unknown field first: if a name is misspelt, the correct one is missing too.
        details = sorted(error.errors(), key=lambda detail: detail["type"] != "extra_forbidden")
        raise error_at(file, text, *_explain(details[0], model, tables)) from error


def error_at(file: Path, text: str, place: Place, what: str) -> InputError:
    """Return the error for one field of a file."""
    return InputError(f"{file}:{toml_lines.find(text, place)}: {dotted(place)}: {what}")


def _explain(detail: Any, model: type[Table], tables: Mapping[str, type[Table]]) -> tuple[Place, str]:
    """Return the place and message of one of pydantic's errors, without pydantic's additions for unions and tuples."""
    location = detail["loc"]
    place: Place = location[:1]
    if len(location) >= 2 and location[0] in tables:
        model, place = tables[location[0]], location[: 3 if isinstance(location[1], int) else 2]
    name = str(place[-1]) if place else ""
    fields = {field.alias or own: field for own, field in model.model_fields.items()}
    if detail["type"] == "extra_forbidden" and name not in fields:
        names = ", ".join(fields)
        return place, f"no such field{did_you_mean(name, fields) or f'; there are {names}'}"
    expected = fields[name].description if name in fields else "a table"
    if detail["type"] == "missing" and len(location) == len(place):
        return place, f"missing, expected {expected}"
    got = repr(detail["input"])
    return place, f"expected {expected}, got {got if len(got) <= 80 else got[:77] + '...'}"
