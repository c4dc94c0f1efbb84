"""Equal objects of a description, which `mi.load_file` and `mi.load_dict` merge unless they are told `optimize=False`.

There one key then changes several objects; here each has its own. References that are made by setting such a key show another scene.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import mitsuba as mi
import numpy as np

_MERGED = ("BSDF", "Texture", "Volume", "Medium", "PhaseFunction")
_NUMBERS = ("Float", "Integer", "Bool", "Vector", "Color")


def equal_objects(nodes: Sequence[Any]) -> tuple[tuple[str, ...], ...]:
    """Names of objects that are equal, a tuple for each such set; an object that is held by reference is one.

    Args:
        nodes: of `mitsuba.parser.ParserState`, references resolved.
    """
    contents: dict[int, Any] = {}
    names = {0: ""}
    order = _from_scene(nodes)
    for index, name in order:
        names.setdefault(index, name)
    for index, _ in reversed(order):
        contents[index] = _content(nodes[index], contents, index)
    found: dict[Any, list[str]] = {}
    for index, name in names.items():
        if _kind(nodes[index]) in _MERGED:
            found.setdefault(contents[index], []).append(name)
    return tuple(tuple(sorted(equal)) for equal in found.values() if len(equal) > 1)


def merge_notices(keys: Iterable[str], equal: Iterable[Sequence[str]]) -> list[str]:
    """One line for each parameter of an object that has equals.

    Args:
        keys: of the unknowns.
        equal: of `equal_objects`.
    """
    found = []
    for key in keys:
        for names in equal:
            own = next((name for name in names if key.startswith(f"{name}.")), None)
            if own is None:
                continue
            other = next(name for name in names if name != own)
            more = f" and {len(names) - 2} more" if len(names) > 2 else ""
            found.append(
                f"{key}: {own} equals {other}{more}, and Mitsuba merges equal objects: one key then changes them all, here {key} and "
                f"{other}{key.removeprefix(own)} are two; load the scene of references with optimize=False"
            )
            break
    return found


def _from_scene(nodes: Sequence[Any]) -> list[tuple[int, str]]:
    """(index, name) of all objects below the scene, each behind those that hold it."""
    found: dict[int, str] = {}
    waiting = [(0, "")]
    while waiting:
        index, name = waiting.pop()
        found.pop(index, None)
        found[index] = name
        for number, (prop, child) in enumerate(_children(nodes[index].props)):
            waiting.append((child, _name(nodes[child], name, prop, nodes[index].props.plugin_name(), number)))
    return list(found.items())


def _name(node: Any, holder: str, prop: str, plugin: str, number: int) -> str:
    """As `mi.traverse` names an object: by its id where it has one of its own, else by what holds it, of which it is child `number`."""
    own = node.props.id()
    if not holder or (own and own != prop and not own.startswith("_")):
        return own or prop
    if plugin == "twosided":
        prop = f"brdf_{number}"
    elif prop.startswith("_"):
        prop = _kind(node).lower()
    return f"{holder}.{prop}{'_medium' if _kind(node) == 'Medium' else ''}"


def _children(props: Any) -> list[tuple[str, int]]:
    resolved = mi.Properties.Type.ResolvedReference
    return [(name, props[name].index()) for name in props.keys() if props.type(name) == resolved]  # noqa: SIM118


def _kind(node: Any) -> str:
    return str(node.type).rpartition(".")[2]


def _content(node: Any, contents: dict[int, Any], index: int) -> Any:
    """What decides an object, hashable; of what cannot be compared its index, which no other has."""
    values = []
    props = node.props
    for name in sorted(props.keys()):
        kind = str(props.type(name)).rpartition(".")[2]
        value = props[name]
        if kind == "ResolvedReference":
            values.append((name, contents.get(value.index(), index)))
        elif kind in _NUMBERS:
            values.append((name, np.asarray(value, np.float64).tobytes()))
        elif kind == "Transform":
            values.append((name, np.asarray(value.matrix, np.float64).tobytes()))
        else:
            values.append((name, value if kind == "String" else index))
    return _kind(node), props.plugin_name(), tuple(values)
