"""Table and figure."""

from typing import Any

from matplotlib.figure import Figure

from benchmarks import figures, markdown
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


def plot(record: Record) -> Figure:
    """The rate over the steps, with the range of 20 runs, and its RMSE."""
    horizon = str(record["settings"]["steps"][0])
    methods = {f"{name}, rate {entry[horizon]['rate']:g}": entry[horizon] for name, entry in record["methods"].items()}
    panels = {
        "rate, 20 runs": {name: figures.over_steps(*entry["runs"]) for name, entry in methods.items()},
        f"RMSE, tuned for {horizon} steps": {
            name: figures.over_steps(entry["curve"]) for name, entry in methods.items()
        },
    }
    return figures.curves(panels, "step", "")
