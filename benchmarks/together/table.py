"""Table."""

from typing import Any

from benchmarks import markdown
from benchmarks.runner.records import Record


def table(record: Record) -> str:
    """Errors of all combinations, then the whole over its parts."""
    problems = record["problems"]
    found = sorted({label for entry in problems.values() for label in entry["methods"]})
    labels = sorted(found, key=lambda label: 0 if label == "none" else len(label))
    settings = record["settings"]
    about = (
        "Errors after the budget of processor time, relative to the start: "
        f"median of {settings['seeds']} seeds "
        "[least, greatest]. i: a memory of images, g: of gradients, x: pixels by their variance, p: the pose by perturbed renders."
    )
    rows = [[label, *(_cell(entry["methods"].get(label)) for entry in problems.values())] for label in labels]
    parts = [about, markdown.table(["", *problems], rows)]
    rows = [
        [
            name,
            entry["whole"],
            *(_ratio(entry, which) for which in ("over none", "over part", "over best")),
            entry.get("part", "-"),
            entry["best"],
        ]
        for name, entry in record["summary"].items()
    ]
    head = [
        "problem",
        "whole",
        "over none",
        "over its best single part",
        "over the best of all others",
        "that part",
        "that",
    ]
    return markdown.blocks(*parts, markdown.table(head, rows))


def _cell(entry: dict[str, Any] | None) -> str:
    if entry is None:
        return "-"
    middle, least, greatest = entry["final"]
    return f"{middle:.3f} [{least:.3f}, {greatest:.3f}]"


def _ratio(entry: dict[str, Any], which: str) -> str:
    return f"{entry[which]:.2f}" if which in entry else "-"
