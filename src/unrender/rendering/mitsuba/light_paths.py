"""Length, roulette and first segment of the light paths that a scene's integrator asks for."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import mitsuba as mi

from unrender.core.errors import InputError
from unrender.io import bounded_files, scene_files

DEFAULT_DEPTH = 6
"""Segments of the longest path where neither the user nor the scene gives a number."""
LONGEST_DEPTH = 64
"""Segments of the longest path where the scene's integrator has no limit."""
_ROULETTE = 5

_OF_SURFACES = ("PathIntegrator", "DirectIntegrator", "PRBIntegrator", "BasicPRBIntegrator")
"""Integrators that ignore media."""
_SAME = (
    *_OF_SURFACES,
    "PathProjectiveIntegrator",
    "DirectProjectiveIntegrator",
    "VolumetricSimplePathIntegrator",
    "VolumetricPathIntegrator",
    "VolumetricMisPathIntegrator",
    "PRBVolpathIntegrator",
)
"""Integrators of the same light paths."""
_DIRECT = ("DirectIntegrator", "DirectProjectiveIntegrator")
_NESTING = ("AOVIntegrator", "MomentIntegrator")
_UNLIMITED = 2**31
_LONGEST = 1 << 24


@dataclass(frozen=True)
class LightPaths:
    """Settings of the light paths.

    Attributes:
        max_depth: longest path in segments, >= 1.
        rr_depth: the depth from which roulette may end a path, >= 1.
        hide_emitters: whether emitters are left out where the camera sees them.
        notices: one line for each setting of the scene that is not used.
    """

    max_depth: int = DEFAULT_DEPTH
    rr_depth: int = _ROULETTE
    hide_emitters: bool = False
    notices: tuple[str, ...] = ()

    @classmethod
    def of(cls, scene: mi.Scene, source: Path | dict, volumetric: bool, max_depth: int | None) -> LightPaths:
        """The settings of a scene.

        Args:
            scene: as loaded.
            source: what was loaded.
            volumetric: whether it has participating media.
            max_depth: in segments; None for the number of the scene's integrator.

        Raises `InputError` where emitters are hidden beside media.
        """
        integrator = scene.integrator()
        if integrator is None:
            return cls(max_depth or DEFAULT_DEPTH)
        kind, text = _light_transport(integrator)
        given, own = max_depth, _depth(kind, text)
        if max_depth is None:
            max_depth = min(own or DEFAULT_DEPTH, LONGEST_DEPTH if own == _UNLIMITED else _UNLIMITED)
        hidden = bool(getattr(integrator, "hide_emitters", False)) or any(map(_is_true, _hidden(source)))
        if hidden and volumetric:
            raise InputError("the scene's hide_emitters does not go with participating media here: leave it out")
        notices = _notices(kind, own, given, max_depth, volumetric)
        return cls(max_depth, max(1, _number("rr_depth", text) or _ROULETTE), hidden, notices)


def _notices(kind: str, own: int | None, given: int | None, max_depth: int, volumetric: bool) -> tuple[str, ...]:
    depth = "" if own is None else f", max_depth {'unlimited' if own == _UNLIMITED else own}"
    if kind not in _SAME:
        reason = "as max_depth says" if given is not None else "give max_depth for another number"
        return (f"the scene's integrator ({kind}{depth}) is not used: paths have up to {max_depth} segments, {reason}",)
    found = []
    if given is not None and own != given:
        found.append(
            f"the scene's integrator ({kind}{depth}) is not used: paths have up to {max_depth} segments, as max_depth says"
        )
    if given is None and own == _UNLIMITED:
        found.append(
            f"the scene's integrator ({kind}) has no limit of depth: paths have up to {max_depth} segments; "
            "give max_depth for another number"
        )
    if volumetric and kind in _OF_SURFACES:
        found.append(f"the scene's integrator ({kind}) ignores participating media, which are rendered here")
    return tuple(found)


def _light_transport(integrator: Any) -> tuple[str, str]:
    """The class and the description of what traces paths, in what is wrapped around it where that is so."""
    text = str(integrator)
    if type(integrator).__name__ in _NESTING or integrator.class_name() in _NESTING:
        _, _, inner = text.partition("integrators = [")
        text = inner.strip() or text
    return text.partition("[")[0].strip(), text


def _depth(kind: str, text: str) -> int | None:
    """Segments of the longest path; `_UNLIMITED` where there is no limit, None where it is not told."""
    if kind in _DIRECT:
        return 2
    depth = _number("max_depth", text)
    return _UNLIMITED if depth is not None and not 0 <= depth < _UNLIMITED else depth


def _number(name: str, text: str) -> int | None:
    match = re.search(rf"\b{name}\s*=\s*(-?\d+)", text)
    return int(match[1]) if match else None


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
