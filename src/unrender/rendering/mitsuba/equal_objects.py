"""Equal objects of a description, which `mi.load_file` and `mi.load_dict` merge unless `optimize=False`.

After a merge, one key changes several objects; here each object has its own key. References that were rendered by setting such a key in
a merged scene show a different scene.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import mitsuba as mi
import numpy as np

_MERGED = ("BSDF", "Texture", "Volume", "Medium", "PhaseFunction")
_NUMBERS = ("Float", "Integer", "Bool", "Vector", "Color")


def equal_objects(nodes: Sequence[Any]) -> tuple[tuple[str, ...], ...]:
    """Return the names of equal objects, one tuple per set. An object that is held by reference counts once.

    Args:
        nodes: nodes of `mitsuba.parser.ParserState`, references resolved.
    """
    contents: dict[int, Any] = {}
    names = {0: ""}
    order = _from_scene(nodes)
    for index, name in order:
        names.setdefault(index, name)
    for index, _ in reversed(order):
        contents[index] = _content(nodes[index], contents, index)
    groups: dict[Any, list[str]] = {}
    for index, name in names.items():
        if _kind(nodes[index]) in _MERGED:
            groups.setdefault(contents[index], []).append(name)
    return tuple(tuple(sorted(equal)) for equal in groups.values() if len(equal) > 1)


def merge_notices(keys: Iterable[str], equal: Iterable[Sequence[str]]) -> list[str]:
    """Return one notice for each parameter whose object has equal objects; parameters that equal one another share it.

    Args:
        keys: keys of the unknowns.
        equal: result of `equal_objects`.
    """
    notices: list[str] = []
    named: set[str] = set()
    for key in keys:
        for names in equal:
            own = next((name for name in names if key.startswith(f"{name}.")), None)
            if own is None or key in named:
                continue
            named.update(f"{name}{key.removeprefix(own)}" for name in names)
            other = next(name for name in names if name != own)
            more = f" and {len(names) - 2} more" if len(names) > 2 else ""
            notices.append(
                f"{key}: {own} equals {other}{more}, and Mitsuba merges equal objects, so that one key changes them all. Here {key} and "
                f"{other}{key.removeprefix(own)} are separate; load the scene of references with optimize=False"
            )
            break
    return notices


def _from_scene(nodes: Sequence[Any]) -> list[tuple[int, str]]:
    """Return (index, name) of all objects of the scene, each after those that hold it."""
    names: dict[int, str] = {}
    pending = [(0, "")]
    while pending:
        index, name = pending.pop()
        names.pop(index, None)
        names[index] = name
        for number, (prop, child) in enumerate(_children(nodes[index].props)):
            pending.append((child, _name(nodes[child], name, prop, nodes[index].props.plugin_name(), number)))
    return list(names.items())


def _name(node: Any, holder: str, prop: str, plugin: str, number: int) -> str:
    """Return the name that `mi.traverse` uses: the object's own id, or else the name of its holder, whose child `number` it is."""
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
    """Return a hashable description of an object. A value that cannot be compared is replaced by the object's unique index."""
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
