"""Untrusted text made safe for a terminal, a page or a one-line message; and suggestions for misspelt names.

Terminals interpret some characters. ESC and the C1 control codes start commands that move the cursor, set the window's title or write to
the clipboard. Direction marks such as U+202E display a name in a different order.
"""

from __future__ import annotations

import difflib
import itertools
import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

LONGEST_LINE = 1000
"""Largest number of characters of a message."""
_NAMED = 4  # number of names to list from a list of more than twice that length


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


def in_words(value: Any) -> str:
    """Format a value for a message in at most 60 characters; an integer of more than 128 bits by their number."""
    if isinstance(value, int) and value.bit_length() > 128:
        return f"an integer of {value.bit_length()} bits"
    return shorten(_represent(value), 60)


def _represent(value: Any) -> str:
    try:
        return repr(value)
    except ValueError:  # Python prints no integer of more than 4300 digits
        return f"{type(value).__name__} with an integer of more than 4300 digits"


def listed(names: Sequence[str]) -> str:
    """Join names as "a, b". A list of more than eight names is cut after four, with the number of the others."""
    if len(names) <= 2 * _NAMED:
        return ", ".join(names)
    return f"{', '.join(names[:_NAMED])} and {len(names) - _NAMED} more"


def names_in(text: str, names: Iterable[str]) -> set[str]:
    """Return the names that a text contains in full: "bigball" does not contain "ball"."""
    alternatives = "|".join(map(re.escape, sorted(filter(None, names), key=len, reverse=True)))
    return set(re.findall(rf"(?<![\w.-])(?:{alternatives})(?![\w-]|\.\w)", text)) if alternatives else set()


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
    """Return an error's message on one line, cut after `longest` characters, or the name of its type if it is empty."""
    return " ".join(str(error).split())[:longest] or type(error).__name__


def plain(text: str) -> str:
    """Return the text with lone surrogates escaped, so that it can be encoded as UTF-8."""
    return text.encode("utf-8", "backslashreplace").decode()


def printable(value: Any) -> str:
    """Format an untrusted value on one line of at most 60 characters, with unprintable characters escaped; None as "nothing"."""
    text = (
        value if isinstance(value, str) and value.isprintable() else "nothing" if value is None else _represent(value)
    )
    text = visible(text[:200])  # repr of an arbitrary type may be long or unprintable
    return text if len(text) <= 60 else text[:57] + "..."


def _escaped(letter: str) -> str:
    return repr(letter)[1:-1]


_MOST, _LONGEST = 1000, 200
"""Largest number of names to compare, and their largest length. Comparison is slow, and the names may come from an untrusted file."""
_SYNONYMS = {
    "lr": ("learning_rate",),
    "step_size": ("learning_rate",),
    "rate": ("learning_rate",),
    "eps": ("epsilon",),
    "betas": ("beta_1", "beta_2"),
    "iterations": ("steps",),
    "iters": ("steps",),
    "epochs": ("steps",),
    "samples_per_pixel": ("spp",),
    "sample_count": ("spp",),
    "batch_size": ("count", "pixels"),
    "depth": ("max_depth",),
    "res": ("resolution",),
    "mse": ("L2",),
    "l2_loss": ("L2",),
    "mae": ("L1",),
    "l1_loss": ("L1",),
    "relmse": ("RelativeL2",),
    "size": ("resolution",),
}
"""Terms of other packages and their equivalents here. A suggestion needs the equivalent to be among the known names."""


def did_you_mean(name: Any, known: Iterable[str], likeness: float = 0.6) -> str:
    """Return "; did you mean X?" with the nearest known name, or "" if none has the `difflib` similarity `likeness`, or `name` is no text.

    A name that differs in case only is preferred, then the equivalent of another package's term (lr for learning_rate), then one with two
    neighbouring letters exchanged (wiht for with). Only the first 1000 names of at most 200 characters are compared.
    """
    if not isinstance(name, str) or len(name) > _LONGEST:
        return ""
    names = [each for each in itertools.islice(known, _MOST) if isinstance(each, str) and len(each) <= _LONGEST]
    same = [each for each in names if each.lower() == name.lower()]
    synonyms = [each for each in _SYNONYMS.get(name.lower(), ()) if each in names]
    swaps = {name[:i] + name[i + 1] + name[i] + name[i + 2 :] for i in range(len(name) - 1)}
    swapped = [each for each in names if each in swaps]
    near = same[:1] or synonyms[:1] or swapped[:1] or difflib.get_close_matches(name, names, n=1, cutoff=likeness)
    return f"; did you mean {near[0]}?" if near else ""
