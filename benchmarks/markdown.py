"""Markdown tables."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any


def table(head: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    """A table of so many columns; cells are written by `str`."""
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    return "\n".join([*lines, *("| " + " | ".join(map(str, row)) + " |" for row in rows)])


def median_range(values: Sequence[float]) -> str:
    """Of (median, least, greatest): "0.171 (0.168 to 0.173)"."""
    return "{:.3f} ({:.3f} to {:.3f})".format(*values)


def blocks(*parts: str) -> str:
    """Paragraphs and tables, one below the other."""
    return "\n\n".join(parts)
