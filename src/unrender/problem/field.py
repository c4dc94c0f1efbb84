"""An error that knows which field of a problem it is about, so that a file's reader can name the line."""

from __future__ import annotations

import difflib
from collections.abc import Iterable

from unrender.errors import InputError

Place = tuple[str | int, ...]
"""The way to a field, e.g. ("parameters", 0, "bounds")."""


class FieldError(InputError):
    """What is wrong with one field of a problem.

    Args:
        place: the way to the field.
        owner: what people call its owner, e.g. "parameter wall.data" or "view 0".
        what: one line: what is wrong and what would be right.
    """

    def __init__(self, place: Place, owner: str, what: str):
        super().__init__(f"{owner}: {what}")
        self.place = place
        self.owner = owner
        self.what = what


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """"; did you mean X?" for the nearest known name, "" where none is near."""
    near = difflib.get_close_matches(name, list(known), n=1, cutoff=0.6)
    return f"; did you mean {near[0]}?" if near else ""
