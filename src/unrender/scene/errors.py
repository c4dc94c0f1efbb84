"""An error that knows which field of a problem it is about, so that a file's reader can name the line."""

from __future__ import annotations

from unrender.core.errors import InputError
from unrender.io.toml_lines import Place, dotted


class FieldError(InputError):
    """What is wrong with one field of a problem.

    Args:
        place: the way to the field, e.g. ("parameters", 0, "bounds").
        what: one line: what is wrong and what would be right.
        owner: what people call the field, e.g. "parameter wall.data: bounds"; None writes the place.
    """

    def __init__(self, place: Place, what: str, owner: str | None = None):
        super().__init__(f"{owner or dotted(place)}: {what}")
        self.place = place
        self.what = what
