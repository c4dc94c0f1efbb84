"""Descriptions of ready-made Mitsuba objects, recorded for export.

A scene dictionary may hold ready-made objects, such as a `mitsuba.Mesh` with its BSDF. Mitsuba's objects do not expose the description
that they were made from, which the export of a scene requires. A function that builds a scene dictionary therefore makes such objects
by `load_described`.
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
    """Return `mitsuba.load_dict(description)`. Inside `recorded_descriptions`, record the object with its description."""
    result = mi.load_dict(description)
    recorded = _recorded.get()
    if recorded is not None:
        recorded.append((result, description))
    return result


@contextmanager
def recorded_descriptions() -> Iterator[Recorded]:
    """Yield a list of (object, description), which collects every object that `load_described` makes inside the context.

    The list keeps the objects alive; discard it early. Mitsuba objects outside the scenes of a run prevent Dr.Jit from freezing kernels.
    """
    recorded: Recorded = []
    token = _recorded.set(recorded)
    try:
        yield recorded
    finally:
        _recorded.reset(token)
