"""What a scene's description asks for and a `MitsubaRenderer` does otherwise: its integrator, emitters hidden, reconstruction filters."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import mitsuba as mi

from unrender.io import bounded_files, scene_files

__all__ = ["notices"]

_SAME = (
    "PathIntegrator",
    "VolumetricPathIntegrator",
    "VolumetricMisPathIntegrator",
    "PRBIntegrator",
    "PRBVolpathIntegrator",
)
"""Integrators of the same light paths."""
_UNLIMITED = 2**31
_LONGEST = 1 << 24


def notices(scene: mi.Scene, source: Path | dict, max_depth: int) -> tuple[str, ...]:
    """One line for each setting of the scene that is not used.

    Args:
        scene: as loaded.
        source: what was loaded.
        max_depth: of the renderer, in segments.
    """
    found = []
    integrator = scene.integrator()
    if integrator is not None and (words := _integrator(integrator, max_depth)):
        found.append(
            f"the scene's integrator ({words}) is not used: paths have up to {max_depth} segments, as max_depth says"
        )
    if any(_is_true(value) for value in _hidden(source)):
        found.append("the scene's hide_emitters is not used: emitters are seen, and references should show them")
    filters = {_filter_name(sensor.film().rfilter()) for sensor in scene.sensors()} - {"box"}
    if filters:
        found.append(
            f"the film's reconstruction filter ({', '.join(sorted(filters))}) is not used: pixels are means over their square, "
            "as with a box filter"
        )
    return tuple(found)


def _integrator(integrator: Any, max_depth: int) -> str:
    """What an integrator is, "" where it is one of the same paths."""
    text = str(integrator)
    name = text.partition("[")[0].strip()
    match = re.search(r"max_depth\s*=\s*(-?\d+)", text)
    depth = int(match[1]) if match else None
    if name in _SAME and depth == max_depth:
        return ""
    if depth is None:
        return name
    return f"{name}, max_depth {'unlimited' if not 0 <= depth < _UNLIMITED else depth}"


def _filter_name(rfilter: Any) -> str:
    """ "box", "gaussian"."""
    return str(rfilter).partition("[")[0].strip().removesuffix("Filter").lower()


def _hidden(source: Path | dict) -> Iterator[Any]:
    """The values of `hide_emitters` in a description. Mitsuba's integrators do not tell theirs."""
    if isinstance(source, Mapping):
        for key, value in source.items():
            if key == "hide_emitters":
                yield value
            elif isinstance(value, Mapping):
                yield from _hidden(dict(value))
        return
    for path in scene_files.of(source):
        if path.suffix.lower() != ".xml":
            continue
        for element in ElementTree.fromstring(bounded_files.read_bytes(path, _LONGEST)).iter("boolean"):
            if element.get("name") == "hide_emitters":
                yield element.get("value")


def _is_true(value: Any) -> bool:
    return value is True or (isinstance(value, str) and value.strip().lower() == "true")
