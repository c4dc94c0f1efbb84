"""Markdown tables, and templates that are filled from records."""

from __future__ import annotations

import re
import string
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np


def table(head: str, rows: Iterable[Sequence[Any]]) -> str:
    """Return a table; columns of `head` are separated by " | ", cells are written by `str`."""
    lines = [f"| {head} |", "|" + "---|" * (head.count(" | ") + 1)]
    return "\n".join([*lines, *("| " + " | ".join(map(str, row)) + " |" for row in rows)])


def records(head: str, row: str, entries: Iterable[Mapping[str, Any]]) -> str:
    """Return a table with a row for each entry, written by a template such as "{method} | {rate:g} | {final!m}"."""
    return table(head, ([fill(row, entry)] for entry in entries))


def fill(template: str, *values: Mapping[str, Any]) -> str:
    """Fill "{runs[0][-1]:.3f}" from dictionaries. "!m" writes (median, least, greatest), "!v" those of values, "!n" their number."""
    return _Template().vformat(template, (), {key: value for each in values for key, value in each.items()})


def named(entries: Mapping[str, Any], name: str, *inner: str) -> Iterator[dict[str, Any]]:
    """Yield the entries of a dictionary, each with its key under `name`.

    Args:
        entries: dictionaries by key.
        name: what their keys are.
        inner: pairs of a field, "" for the entry itself, and of what its keys are, for dictionaries in the entries.
    """
    for key, entry in entries.items():
        if not inner:
            yield {**entry, name: key}
            continue
        field, *rest = inner
        for found in named(entry[field] if field else entry, *rest):
            yield {**(entry if field else {}), **found, name: key}


def median_range(values: Sequence[float]) -> str:
    """Write (median, least, greatest): "0.171 (0.168 to 0.173)"."""
    return "{:.3f} ({:.3f} to {:.3f})".format(*values)


def spread(values: Sequence[float]) -> str:
    """Write the median and the range of values."""
    return median_range((float(np.median(values)), min(values), max(values)))


def blocks(*parts: str) -> str:
    """Paragraphs and tables, one below the other."""
    return "\n\n".join(parts)


class _Template(string.Formatter):
    def get_field(self, field_name: str, args: Sequence[Any], kwargs: Mapping[str, Any]) -> tuple[Any, str]:
        name, *keys = re.findall(r"[^\[\]]+", field_name)
        found = kwargs[name]
        for key in keys:
            found = found[key] if isinstance(found, Mapping) else found[int(key)]
        return found, name

    def convert_field(self, value: Any, conversion: str | None) -> Any:
        written = {"m": median_range, "v": spread, "n": len}.get(conversion or "")
        return written(value) if written else super().convert_field(value, conversion)  # pyright: ignore[reportArgumentType]
