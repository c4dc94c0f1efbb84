"""Table and figure."""

import numpy as np

from benchmarks import figures, markdown
from benchmarks.runner.records import Record


def table(record: Record) -> str:
    """What was left, and the share of runs that arrived."""
    rows = []
    for entry in markdown.named(record["problems"], "problem", "", "start", "methods", "method"):
        errors = [run["error"] for run in entry["runs"]]
        start = float(np.median([run["start"] for run in entry["runs"]]))
        arrived = f"{sum(error < entry['converged'] for error in errors)} of {len(errors)}"
        config = ", ".join(f"{key} {value:g}" for key, value in entry["config"].items())
        row = markdown.fill("{problem} | {start} | {method}", entry)
        rows.append([row, f"{start:.3f}", markdown.spread(errors), arrived, config])
    text = (
        "After {seconds:g} s of the processor, {seeds} starts, pictures of {resolution}²: root mean "
        "square over elements, median (least to greatest); converged are errors below 0.02 (`box10`, `shadow`) and 0.03 (`mug`)."
    )
    head = "problem | start | method | error at the start | at the end | converged | configuration"
    return markdown.blocks(text.format(**record["settings"]), markdown.table(head, rows))


def plot(record: Record) -> figures.Figure:
    """Error over seconds, a panel per problem and distance of the start."""
    panels = {
        f"{name}, {kind}": {
            method: [run["curve"] for run in entry["runs"]] for method, entry in found["methods"].items()
        }
        for name, kinds in record["problems"].items()
        for kind, found in kinds.items()
    }
    return figures.curves(panels, "processor seconds", "error")
