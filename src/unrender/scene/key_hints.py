"""What to write in place of a parameter's key that a scene does not have, or that cannot be recovered."""

from __future__ import annotations

import difflib
import re
from collections.abc import Mapping

from unrender.core.suggestions import did_you_mean
from unrender.rendering.renderer import ParameterInfo

_NAMELESS = re.compile(r"|object_\d{9,}|__.*|elm__\d+|_unnamed.*")
"""Ids that Mitsuba makes up for objects that were given none."""
_TRANSFORM = "to_world"
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
"""What people call that which a pose changes."""
_POSE = ("translation", "rotation", "scale")


def near_key(key: str, known: Mapping[str, ParameterInfo]) -> str:
    """A hint at the key that may have been meant, to be put after "the scene has no parameter KEY"; "" where there is none.

    An object without an `id` cannot be named: where the scene has one with a parameter of that name, the hint says so.
    """
    able = [name for name, info in known.items() if info.differentiable or info.perturbable]
    owner, _, rest = key.partition(".")
    if rest and owner not in {name.partition(".")[0] for name in known}:
        alike = [name for name in known if name.endswith("." + rest)]
        nameless = [name for name in alike if _is_nameless(name)]
        close = did_you_mean(owner, {name.partition(".")[0] for name in alike if not _is_nameless(name)})
        if nameless and not close:
            others = "" if len(nameless) == 1 else f" ({len(nameless)} objects have none)"
            return f'; nothing has the id {owner}: give the object that holds {rest} id="{owner}"{others}'
    if rest.partition(".")[0] in _PLACES:
        if not _poses(owner, known) and (why := _no_pose(owner, known)):
            return f"; {why}"
        for near in (owner, *difflib.get_close_matches(owner, {name.partition(".")[0] for name in known}, n=1)):
            if poses := _poses(near, known):
                return f"; a pose is {poses} (--method smoothed)"
    # Mitsuba may call an owner by its shape where people think of its material: the rest of the key tells as much.
    alike = [name for name in able if name.endswith("." + rest) and not _is_nameless(name)] if rest else []
    named = [name for name in able if not _is_nameless(name)]
    if near := did_you_mean(key, alike, 0.0) or did_you_mean(key, named) or did_you_mean(key, known):
        return near
    shown = named or able
    return f"; it has {', '.join(shown[:6])}{' and others' if len(shown) > 6 else ''}" if shown else ""


def instead_of(key: str, known: Mapping[str, ParameterInfo]) -> str:
    """A hint at what may be recovered in place of a key that cannot, "" where there is none: poses in place of transformations."""
    owner, _, rest = key.rpartition(".")
    if rest != _TRANSFORM:
        return ""
    if poses := _poses(owner, known):
        return f"; its pose can be: {poses} (--method smoothed)"
    return "" if _no_pose(owner, known) else "; beside participating media, a shape has no pose"


def _no_pose(owner: str, known: Mapping[str, ParameterInfo]) -> str:
    """Return why an object has no pose, as far as the reason given for its transformation tells; else ""."""
    info = known.get(f"{owner}.{_TRANSFORM}")
    return f"{owner}.{_TRANSFORM}: {info.reason}" if info is not None and "pose" in info.reason else ""


def _poses(owner: str, known: Mapping[str, ParameterInfo]) -> str:
    found = [f"{owner}.{part}" for part in _POSE]
    return ", ".join(key for key in found if key in known and known[key].rigid)  # an emitter's scale is its brightness


def _is_nameless(key: str) -> bool:
    return bool(_NAMELESS.fullmatch(key.partition(".")[0]))
