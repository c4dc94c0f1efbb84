"""Suggestions for misspelt names."""

from __future__ import annotations

import difflib
import itertools
from collections.abc import Iterable

_MOST, _LONGEST = 1000, 200
"""Names that are compared and their characters: comparing takes time, and names may come from a file that anybody made."""
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
"""What other packages call things, and what they are called here. Only names that are known in a place are suggested there."""


def did_you_mean(name: str, known: Iterable[str], likeness: float = 0.6) -> str:
    """The words "; did you mean X?" for the nearest known name, "" where none is similar enough.

    A name that differs by case alone is the nearest, then what other packages call it (lr for learning_rate).

    Args:
        name: as it was given.
        known: the names there are. The first thousand are compared, those of at most 200 characters.
        likeness: the least similarity (`difflib`), from 0 for any name to 1 for an equal one.
    """
    if len(name) > _LONGEST:
        return ""
    names = [each for each in itertools.islice(known, _MOST) if len(each) <= _LONGEST]
    same = [each for each in names if each.lower() == name.lower()]
    meant = [each for each in _SYNONYMS.get(name.lower(), ()) if each in names]
    near = same[:1] or meant[:1] or difflib.get_close_matches(name, names, n=1, cutoff=likeness)
    return f"; did you mean {near[0]}?" if near else ""
