"""Suggestions for misspelt names."""

from __future__ import annotations

import difflib
import itertools
from collections.abc import Iterable

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


def did_you_mean(name: str, known: Iterable[str], likeness: float = 0.6) -> str:
    """Return "; did you mean X?" with the nearest known name, or "" if none is similar.

    A name that differs in case only is preferred, then the equivalent of another package's term (lr for learning_rate).

    Args:
        name: the misspelt name.
        known: the valid names. Only the first 1000 are compared, and only those of at most 200 characters.
        likeness: smallest similarity (`difflib`), from 0 for any name to 1 for an equal name.
    """
    if len(name) > _LONGEST:
        return ""
    names = [each for each in itertools.islice(known, _MOST) if len(each) <= _LONGEST]
    same = [each for each in names if each.lower() == name.lower()]
    synonyms = [each for each in _SYNONYMS.get(name.lower(), ()) if each in names]
    near = same[:1] or synonyms[:1] or difflib.get_close_matches(name, names, n=1, cutoff=likeness)
    return f"; did you mean {near[0]}?" if near else ""
