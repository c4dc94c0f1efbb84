"""Untrusted text made safe for a terminal, a page or a one-line message.

Terminals interpret some characters. ESC and the C1 control codes start commands that move the cursor, set the window's title or write to
the clipboard. Direction marks such as U+202E display a name in a different order.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

LONGEST_LINE = 1000
"""Largest number of characters of a message."""
_NAMED = 4
"""Number of names to list from a list of more than twice that length."""


def visible(text: str, keep: str = "") -> str:
    """Escape the characters that do not print as Python does in a literal, such as `\\x1b`. Characters in `keep` are not escaped."""
    if text.isprintable():
        return text
    return "".join(letter if letter.isprintable() or letter in keep else _escaped(letter) for letter in text)


def shorten(text: str, longest: int) -> str:
    """Return the text with its middle replaced by " ... " if it has more than `longest` characters (at least 16)."""
    if len(text) <= longest:
        return text
    tail = longest // 3
    return f"{text[: longest - tail - 5]} ... {text[-tail:]}"


def listed(names: Sequence[str]) -> str:
    """Join names as "a, b". A list of more than eight names is cut after four, with the number of the others."""
    if len(names) <= 2 * _NAMED:
        return ", ".join(names)
    return f"{', '.join(names[:_NAMED])} and {len(names) - _NAMED} more"


def grouped(values: Mapping[str, str]) -> str:
    """Format {name: value} grouped by value: "0.1 (a, b), 0.05 (c)"."""
    names: dict[str, list[str]] = {}
    for name, words in values.items():
        names.setdefault(words, []).append(name)
    return ", ".join(f"{words} ({listed(which)})" for words, which in names.items())


def one_line(text: str) -> str:
    """Return the text as one printable line of at most `LONGEST_LINE` characters."""
    return shorten(visible(shorten(text, 4 * LONGEST_LINE)), LONGEST_LINE)


def reason_of(error: BaseException, longest: int | None = None) -> str:
    """Return an error's message on one line of at most `longest` characters, or the name of its type if it is empty."""
    return " ".join(str(error).split())[:longest] or type(error).__name__


def plain(text: str) -> str:
    """Return the text with lone surrogates escaped, so that it can be encoded as UTF-8."""
    return text.encode("utf-8", "backslashreplace").decode()


def printable(value: Any) -> str:
    """Format an untrusted value on one line of at most 60 characters, with unprintable characters escaped."""
    text = value if isinstance(value, str) and value.isprintable() else "nothing" if value is None else repr(value)
    text = visible(text[:200])  # repr of an arbitrary type may be long or unprintable
    return text if len(text) <= 60 else text[:57] + "..."


def _escaped(letter: str) -> str:
    return repr(letter)[1:-1]
