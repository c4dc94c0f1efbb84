"""Suggestions for misspelt names."""

from __future__ import annotations

import difflib
from collections.abc import Iterable

__all__ = ["did_you_mean"]


def did_you_mean(name: str, known: Iterable[str], likeness: float = 0.6) -> str:
    """The words "; did you mean X?" for the nearest known name, "" where none is similar enough.

    A name that differs by case alone is the nearest.

    Args:
        name: as it was given.
        known: the names there are.
        likeness: the least similarity (`difflib`), from 0 for any name to 1 for an equal one.
    """
    names = list(known)
    same = [each for each in names if each.lower() == name.lower()]
    near = same[:1] or difflib.get_close_matches(name, names, n=1, cutoff=likeness)
    return f"; did you mean {near[0]}?" if near else ""
