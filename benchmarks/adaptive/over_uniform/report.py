"""Table."""

from collections.abc import Callable
from typing import Any

from benchmarks import markdown
from benchmarks.runner.records import Record


def table(record: Record) -> str:
    """Per problem, then the summary."""
    settings = record["settings"]
    parts = [
        f"{settings['count']} pixels a step; plain / relative, by paths; ± is of the relative one. Steps are those done before; λ, the "
        "share of uniform draws, at each."
    ]
    for label in record["summary"]:
        found = {name: entry[label] for name, entry in record["problems"].items() if label in entry}
        parts += [f"**{label}**, variance over uniform's after so many steps", _by_steps(found, _cell)]
    direct = {
        name: [point for point in entry["adaptive"] if point["gradients"]]
        for name, entry in record["problems"].items()
        if "adaptive" in entry
    }
    parts += [
        f"**adaptive**, by {settings['runs']} gradients of each sampler, plain / relative",
        _by_steps(direct, _direct),
    ]
    head = "sampler | problems | geometric mean at the end, plain | relative | worst of all steps, plain | relative"
    row = "{label} | {problems} | {mean[0]:.2f} | {mean[1]:.2f} | {worst[0][0]:.2f} ± {worst[0][1]:.1g}"
    row += " | {worst[1][0]:.2f} ± {worst[1][1]:.1g}"
    return markdown.blocks(*parts, markdown.records(head, row, markdown.named(record["summary"], "label")))


def _by_steps(found: dict[str, Any], cell: Callable[[dict[str, Any]], str]) -> str:
    head = " | ".join(["problem", *(str(point["step"]) for point in next(iter(found.values())))])
    return markdown.table(head, [[name, *map(cell, points)] for name, points in found.items()])


def _cell(point: dict[str, Any]) -> str:
    plain, relative = point["ratio"]
    return f"{plain:.2f} / {relative:.2f} ± {point['error'][1]:.1g}, λ {point['uniform']:.2g}"


def _direct(point: dict[str, Any]) -> str:
    return " / ".join(f"{ratio:.2f} ± {error:.1g}" for ratio, error in point["gradients"])
