"""Suggestions for parameter keys that a scene does not have, or that cannot be recovered."""

from __future__ import annotations

import difflib
import re
from collections.abc import Mapping

from unrender.core.text import did_you_mean
from unrender.rendering.renderer import ParameterInfo

_NAMELESS = re.compile(r"|object_\d{9,}|__.*|elm__\d+|_unnamed.*")  # ids that Mitsuba generates for objects without one
_OBJECT = re.compile(r"([^.]*(?:\.\d+)*)\.")
_TRANSFORM = "to_world"
_SCALED = "nested_texture", "sigma_t"  # slots that the scale of their owner multiplies: of bump maps and media
_PLACES = (
    _TRANSFORM,
    "translation",
    "rotation",
    "center",
    "centre",
    "origin",
    "target",
    "lookat",
    "translate",
    "rotate",
    "radius",
)
"""Names that users may try for the parameters of a pose."""
_POSE = ("translation", "rotation", "scale")
_ONLY_LIGHTS = "in a scene with participating media only lights have a pose"
_SLOTS = frozenset({"bsdf", "data", "value", ""})  # parts of keys that do not name a quantity
_EQUIVALENTS = (
    {"alpha", "roughness"},
    {"reflectance", "base_color", "diffuse_reflectance", "albedo", "color", "colour"},
    {"radiance", "intensity", "irradiance", "emission"},
)
"""Names of one quantity in different plugins and packages."""


def near_key(key: str, known: Mapping[str, ParameterInfo]) -> str:
    """Return a hint at the intended key, to follow "the scene has no parameter KEY"; "" if there is none.

    An object without an `id` has no usable key. If the scene has such an object with a parameter of that name, the hint asks for an id.
    """
    able = [name for name, info in known.items() if info.differentiable or info.perturbable]
    owner, rest = _split(key)
    owners = {_split(name)[0] for name in known}
    if rest and owner not in owners:
        similar = [name for name in known if name.endswith("." + rest)]
        nameless = [name for name in similar if _is_nameless(name)]
        close = did_you_mean(owner, {_split(name)[0] for name in similar if not _is_nameless(name)})
        if nameless and not close:
            others = "" if len(nameless) == 1 else f" ({len(nameless)} objects have none)"
            return f'; nothing has the id {owner}: give the object that holds {rest} id="{owner}"{others}'
    if rest.partition(".")[0] in _PLACES:
        if not _poses(owner, known) and (why := _no_pose(owner, known)):
            return f"; {why}"
        for near in (owner, *difflib.get_close_matches(owner, owners, n=1)):
            if poses := _poses(near, known):
                return f"; a pose is {poses}"
        if f"{owner}.{_TRANSFORM}" in known:
            return f"; {_ONLY_LIGHTS}"
    # Mitsuba may name the owner after its shape, where a user expects the material: the rest of the key then decides.
    similar = [name for name in able if name.endswith("." + rest) and not _is_nameless(name)] if rest else []
    named = [name for name in able if not _is_nameless(name)]
    equivalent = _same_quantity(key, named)
    own = [name for name in equivalent if name.startswith(f"{owner}.")]
    if (
        near := did_you_mean(key, own or similar or equivalent, 0.0)
        or did_you_mean(key, named)
        or did_you_mean(key, known)
    ):
        return near
    shown = named or able
    return f"; it has {', '.join(shown[:6])}{' and others' if len(shown) > 6 else ''}" if shown else ""


def _split(key: str) -> tuple[str, str]:
    """Return the object's id and the rest of a key. An id may end in numbers, as Blender's Cube.001."""
    owner = _OBJECT.match(key)
    return (key, "") if owner is None else (owner[1], key[owner.end() :])


def _same_quantity(key: str, names: list[str]) -> list[str]:
    """Return the names that contain a quantity of the key or an equivalent of it, of the key's own object if there are some."""
    owner, rest = _split(key)
    wanted = set(rest.split(".")) - _SLOTS
    wanted = wanted.union(*(group for group in _EQUIVALENTS if group & wanted))
    same = [name for name in names if wanted & set(_split(name)[1].split("."))]
    return [name for name in same if _split(name)[0] == owner] or same


def instead_of(key: str, known: Mapping[str, ParameterInfo]) -> str:
    """Return a hint at a recoverable key in place of one that is not, or at what to do; "" if there is none.

    The hint for a transformation is its pose, and for the scale of a bump map or medium its texture or extinction. For other compiled
    numbers it is a run per value.
    """
    owner, _, rest = key.rpartition(".")
    if (info := known.get(key)) is not None and info.compiled:
        slots = tuple(f"{owner}.{slot}." for slot in _SCALED)
        inside = [name for name in known if name.startswith(slots) and known[name].perturbable and rest == "scale"]
        if inside:
            return f"; recover {inside[0]} in its place, which it multiplies"
        return "; set it in the scene file, run once for each of several values, and compare the losses"
    if rest != _TRANSFORM:
        return ""
    if poses := _poses(owner, known):
        return f"; its pose can be: {poses}"
    return "" if _no_pose(owner, known) else f"; {_ONLY_LIGHTS}"


def _no_pose(owner: str, known: Mapping[str, ParameterInfo]) -> str:
    """Return why an object has no pose, if the reason of its transformation states it; else ""."""
    info = known.get(f"{owner}.{_TRANSFORM}")
    return f"{owner}.{_TRANSFORM}: {info.reason}" if info is not None and "pose" in info.reason else ""


def _poses(owner: str, known: Mapping[str, ParameterInfo]) -> str:
    keys = [f"{owner}.{part}" for part in _POSE]
    return ", ".join(key for key in keys if key in known and known[key].rigid)  # an emitter's scale is its brightness


def _is_nameless(key: str) -> bool:
    return bool(_NAMELESS.fullmatch(key.partition(".")[0]))
