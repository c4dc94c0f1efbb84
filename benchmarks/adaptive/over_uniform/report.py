"""Table."""

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
        steps = [str(point["step"]) for point in next(iter(found.values()))]
        rows = [[name, *(_cell(point) for point in points)] for name, points in found.items()]
        parts += [
            f"**{label}**, variance over uniform's after so many steps",
            markdown.table(["problem", *steps], rows),
        ]
    direct = {
        name: [point for point in entry["adaptive"] if point["gradients"]]
        for name, entry in record["problems"].items()
        if "adaptive" in entry
    }
    rows = [[name, *(_direct(point) for point in points)] for name, points in direct.items()]
    steps = [str(point["step"]) for point in next(iter(direct.values()))]
    parts += [
        f"**adaptive**, by {settings['runs']} gradients of each sampler, plain / relative",
        markdown.table(["problem", *steps], rows),
    ]
    rows = []
    for label, summary in record["summary"].items():
        worst = [f"{ratio:.2f} ± {error:.1g}" for ratio, error in summary["worst"]]
        rows.append([label, summary["problems"], *(f"{mean:.2f}" for mean in summary["mean"]), *worst])
    head = [
        "sampler",
        "problems",
        "geometric mean at the end, plain",
        "relative",
        "worst of all steps, plain",
        "relative",
    ]
    return markdown.blocks(*parts, markdown.table(head, rows))


def _cell(point: dict[str, Any]) -> str:
    plain, relative = point["ratio"]
    return f"{plain:.2f} / {relative:.2f} ± {point['error'][1]:.1g}, λ {point['uniform']:.2g}"


def _direct(point: dict[str, Any]) -> str:
    return " / ".join(f"{ratio:.2f} ± {error:.1g}" for ratio, error in point["gradients"])
