"""Table."""

from typing import Any

from benchmarks import markdown
from benchmarks.runner.records import Record


def table(record: Record) -> str:
    """Meta, Fig. 2."""
    settings = record["settings"]
    rows = []
    for method, entry in record["methods"].items():
        row: list[Any] = [method]
        for horizon in map(str, settings["steps"]):
            f = entry[horizon]
            row += [f"{f['rmse']:.5f}", f"{f['of_adam']:.2f}", f"{f['rate']:g}"]
        rows.append(row)
    head = ["method"]
    for horizon in settings["steps"]:
        head += [f"RMSE after {horizon} steps", "of Adam's", "rate"]
    return (
        f"{settings['seeds']} runs; each method tuned for each horizon on other seeds.\n\n{markdown.table(head, rows)}"
    )
