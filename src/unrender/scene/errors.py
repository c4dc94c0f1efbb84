"""An error with the path of a field of a problem, so that the reader of a file can name its line."""

from __future__ import annotations

from unrender.core.errors import InputError
from unrender.io.toml_lines import Place, dotted


class FieldError(InputError):
    """An invalid field of a problem.

    Args:
        place: path of the field, e.g. ("parameters", 0, "bounds").
        what: what is wrong and what was expected, in one line.
        owner: name of the field in the message, e.g. "parameter wall.data: bounds"; None for the dotted path.
    """

    def __init__(self, place: Place, what: str, owner: str | None = None):
        super().__init__(f"{owner or dotted(place)}: {what}")
        self.place = place
        self.what = what
