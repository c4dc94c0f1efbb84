"""Which slots of a scene's plugins read a parameter's value, and the physical range that follows."""

from __future__ import annotations

import re
from dataclasses import replace
from typing import Any

import mitsuba as mi

from unrender.rendering.mitsuba.emissive import COEFFICIENT
from unrender.rendering.mitsuba.range_table import CLASSES, KINDS, UNKNOWN, Range
from unrender.rendering.mitsuba.scene_objects import Holders, children, class_name

__all__ = ["SlotReaders", "entry"]

_CARRIED = ("value", "values", "data", "color0", "color1", "volume")
"""Slots of textures and volumes whose values these hand on to the object that holds them."""
_ATTRIBUTE = re.compile(r'name = "(.*)",\s+scale = "(.*)"')
_KINDS = ("BSDF", "Emitter", "Medium", "PhaseFunction", "Sensor", "Shape")


class SlotReaders:
    """The objects of a scene, and for each the slots of other objects that hold it.

    `mitsuba.traverse` visits an object once, under its own id where it has one. A range follows the slot instead, so every way to an object
    counts: a texture that two BSDFs share gets the range that serves both.
    """

    def __init__(self, found: Holders):
        self._holders = found
        self._attributes: dict[str, list[Any]] = {}
        for node in self._holders:
            if isinstance(node, mi.Texture) and (name := _attribute(node)[0]):
                self._attributes.setdefault(name, []).append(node)

    def range_of(self, parameters: mi.SceneParameters, key: str) -> Range:
        """Return the range of the parameter `key`; `UNKNOWN` where no slot that reads it is known."""
        node, leaf = parameters.properties[key][2], key.rpartition(".")[2]
        found = self._of_slot(node, leaf)
        low, high = found.low, found.high
        for other, is_lower in ((found.above, True), (found.below, False)):
            name = f"{key.rpartition('.')[0]}.{other}"
            if other and name in parameters:
                value: Any = parameters[name]
                limit = float(value[0])
                low, high = (limit, high) if is_lower else (low, limit)
        return replace(found, low=low, high=high)

    def _of_slot(self, node: Any, slot: str) -> Range:
        if isinstance(node, (mi.Texture, mi.Volume)) and slot in _CARRIED:
            return self._of_readers(node)
        if (known := entry(node, slot)) is not None:
            return known
        if isinstance(node, mi.Shape):
            return self._of_attribute(node, slot)
        if isinstance(node, mi.Medium) and slot.startswith(COEFFICIENT):
            return Range(unit="radiance")
        return UNKNOWN

    def _of_readers(self, node: Any) -> Range:
        """Return the range that serves all slots that hold a texture or volume."""
        found: Range | None = None
        for holder, slot in self._holders.get(node, []):
            if isinstance(holder, mi.Medium) and slot == "emission" and _has_harmonics(holder):
                each = Range(unit="radiance")
            else:
                each = self._of_slot(holder, slot)
            found = each if found is None else found.both(each)
        return found or UNKNOWN

    def _of_attribute(self, shape: Any, name: str) -> Range:
        """Return the range of a shape's attribute: of the slots whose textures read it from this shape, divided by their scale."""
        found: Range | None = None
        for texture in self._attributes.get(name, []):
            if shape not in self._shapes_of(texture):
                continue
            each = self._of_readers(texture).scaled(_attribute(texture)[1])
            found = each if found is None else found.both(each)
        return found or UNKNOWN

    def _shapes_of(self, node: Any) -> set[Any]:
        """Return the shapes that hold an object, directly or through others."""
        found, seen, pending = set(), {node}, [node]
        while pending:
            for holder, _ in self._holders.get(pending.pop(), []):
                if isinstance(holder, mi.Shape):
                    found.add(holder)
                elif holder not in seen:
                    seen.add(holder)
                    pending.append(holder)
        return found


def _attribute(texture: Any) -> tuple[str, float]:
    """Return the attribute that a texture reads and its scale; "" where it reads none."""
    match = _ATTRIBUTE.search(str(texture)) if class_name(texture) == "MeshAttribute" else None
    return ("", 1.0) if match is None else (match[1], float(match[2]))


def entry(node: Any, slot: str) -> Range | None:
    """Return what the table says of a slot of an object, None where it has no entry."""
    own = CLASSES.get(class_name(node), {})
    if slot in own:
        return own[slot]
    kind = next((KINDS[name] for name in _KINDS if isinstance(node, getattr(mi, name))), {})
    return kind.get(slot)


def _has_harmonics(medium: Any) -> bool:
    return any(name == f"{COEFFICIENT}1" for name, _ in children(medium))
