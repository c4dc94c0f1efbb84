"""Text that others wrote, made fit for a terminal, a page or a message of one line.

A terminal obeys what some characters say: ESC and the C1 controls begin commands that move the cursor, set the window's title or write to
the clipboard, and direction marks (U+202E and the like) show a name in another order than it has.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

LONGEST_LINE = 1000
"""Characters of the longest message."""
_NAMED = 4
"""Names of a list that are given where it has more than twice as many."""


def visible(text: str, keep: str = "") -> str:
    """The text with what does not print as Python writes it in a literal, such as `\\x1b`; what is in `keep` stays as it is."""
    if text.isprintable():
        return text
    return "".join(letter if letter.isprintable() or letter in keep else _escaped(letter) for letter in text)


def shorten(text: str, longest: int) -> str:
    """The text, its middle left out where it has more than `longest` characters (at least 16)."""
    if len(text) <= longest:
        return text
    tail = longest // 3
    return f"{text[: longest - tail - 5]} ... {text[-tail:]}"


def listed(names: Sequence[str]) -> str:
    """Names one after another: "a, b"; of more than eight, the first four, and how many there are besides."""
    if len(names) <= 2 * _NAMED:
        return ", ".join(names)
    return f"{', '.join(names[:_NAMED])} and {len(names) - _NAMED} more"


def grouped(values: Mapping[str, str]) -> str:
    """{name: words} by words: "0.1 (a, b), 0.05 (c)"."""
    names: dict[str, list[str]] = {}
    for name, words in values.items():
        names.setdefault(words, []).append(name)
    return ", ".join(f"{words} ({listed(which)})" for words, which in names.items())


def one_line(text: str) -> str:
    """The text as one printable line of at most `LONGEST_LINE` characters."""
    return shorten(visible(shorten(text, 4 * LONGEST_LINE)), LONGEST_LINE)


def reason_of(error: BaseException, longest: int | None = None) -> str:
    """What an error says, on one line of at most so many characters; its kind where it says nothing."""
    return " ".join(str(error).split())[:longest] or type(error).__name__


def plain(text: str) -> str:
    """Return the text with what is no Unicode escaped: such text can be written to a file and read again."""
    return text.encode("utf-8", "backslashreplace").decode()


def printable(value: Any) -> str:
    """Untrusted text on one line: 60 characters at most, what does not print escaped."""
    text = value if isinstance(value, str) and value.isprintable() else "nothing" if value is None else repr(value)
    text = visible(text[:200])  # a value of another type may write itself as it likes
    return text if len(text) <= 60 else text[:57] + "..."


def _escaped(letter: str) -> str:
    return repr(letter)[1:-1]
