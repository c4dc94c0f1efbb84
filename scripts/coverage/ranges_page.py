"""docs/reference/ranges.md: every key of every plugin of the wheel whose value can be recovered or perturbed, with its range and unit."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import unrender as ur
from benchmarks import markdown
from benchmarks.internals import ObjectGraph, Range, SlotReaders, dr, load_scene, mi
from benchmarks.runner.catalogue import ROOT
from scripts.coverage.plugins import PLUGINS
from scripts.coverage.scenes import Plugin

__all__ = ["NO_VALUES", "PAGE", "Row", "missing", "page", "rows"]

PAGE = ROOT / "docs" / "reference" / "ranges.md"
NO_VALUES = ("film", "filter", "integrator", "sampler")
"""Kinds of plugins that have no parameters of their own."""
_HEAD = """# Physical ranges

Built from a scene of each plugin of Mitsuba {version}.

Bounds that a problem leaves out are these. A range belongs to the slot that reads a value: a texture has the range of the BSDF's slot,
also through nested textures and volumes; a mesh attribute has the range of the slot whose `mesh_attribute` texture names it, over the
texture's `scale`; a texture in two slots has the range that serves both. A value with a *singular* point stays on the side on which it
starts, a hundredth of that point away or half the initial distance, whichever is less. Open ends are
blank; an end that is a key is that parameter's value in the scene."""


@dataclass(frozen=True)
class Row:
    """One key of a plugin."""

    plugin: str
    kind: str
    key: str
    range: Range


def rows(name: str, plugin: Plugin) -> list[Row]:
    """Return the keys of a plugin in its scene; none where Mitsuba refuses it in this variant."""
    with tempfile.TemporaryDirectory() as folder:
        try:
            scene = load_scene(plugin.build(Path(folder)))
        except ur.InputError:
            return []
        graph = ObjectGraph(scene)
        parameters, readers = graph.parameters(), SlotReaders(graph.slots)
        return [
            Row(name, plugin.kind, short, readers.range_of(parameters, key))
            for key, short in _own_keys(parameters, plugin.prefixes)
        ]


def missing(found: list[Row]) -> list[str]:
    """Return the keys without an entry in the table."""
    return [f"{row.plugin}: {row.key}" for row in found if not row.range.unit]


def page() -> str:
    """Return the text of the page."""
    found = [row for name, plugin in PLUGINS.items() if plugin.kind not in NO_VALUES for row in rows(name, plugin)]
    parts = [_HEAD.format(version=mi.__version__)]
    for kind in sorted({row.kind for row in found}, key=str.lower):
        lines = {
            (row.plugin, row.key, *_ends(row.range), row.range.unit, _number(row.range.singular))
            for row in found
            if row.kind == kind
        }
        head = ["plugin", "key", "low", "high", "unit", "singular at"]
        table = markdown.table(
            " | ".join(head), [[f"`{line[0]}`", f"`{line[1]}`", *line[2:]] for line in sorted(lines)]
        )
        parts.append(f"## {kind[0].upper()}{kind[1:]}\n\n{table}")
    return "\n\n".join(parts) + "\n"


def _own_keys(parameters: Any, prefixes: tuple[str, ...]) -> Iterator[tuple[str, str]]:
    for key in parameters.keys():  # noqa: SIM118 (iterating gives pairs)
        prefix = next((p for p in prefixes if key.startswith(f"{p}.")), None)
        if prefix is None or parameters.flags(key) & mi.ParamFlags.ReadOnly or parameters.properties[key][0] is None:
            continue
        value = parameters[key]
        if (
            dr.is_array_v(value)
            and dr.is_float_v(value)
            and not dr.is_special_v(value)
            and not dr.is_matrix_v(value)
            and dr.is_jit_v(value)
        ):
            yield key, key.removeprefix(f"{prefix}.")


def _ends(limits: Range) -> tuple[str, str]:
    return _number(limits.low), _number(limits.high)


def _number(value: float | None) -> str:
    return "" if value is None else f"{value:g}"
