"""Ready-made Mitsuba objects whose description is not lost.

A scene dictionary may hold ready-made objects, such as a `mitsuba.Mesh` with its BSDF. Mitsuba's objects do not tell what they were made
of, and exporting a scene needs to know: a function that makes its scene's dictionary makes such objects by `load_described`.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any

import mitsuba as mi

Recorded = list[tuple[Any, dict[str, Any]]]

_recorded: ContextVar[Recorded | None] = ContextVar("recorded", default=None)


def load_described(description: dict[str, Any]) -> Any:
    """`mitsuba.load_dict(description)`; inside `recorded_descriptions` the object is remembered with its description."""
    made = mi.load_dict(description)
    recorded = _recorded.get()
    if recorded is not None:
        recorded.append((made, description))
    return made


@contextmanager
def recorded_descriptions() -> Iterator[Recorded]:
    """A list of (object, description) of all that `load_described` makes inside. Objects live as long as the list does, no longer:
    Mitsuba objects outside the scenes of a run keep Dr.Jit from freezing kernels."""
    recorded: Recorded = []
    token = _recorded.set(recorded)
    try:
        yield recorded
    finally:
        _recorded.reset(token)
