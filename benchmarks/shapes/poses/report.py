"""Table and figure."""

import numpy as np
from matplotlib.figure import Figure

from benchmarks import figures, markdown
from benchmarks.runner.records import Record


def table(record: Record) -> str:
    """What was left, and the share of runs that arrived."""
    rows = []
    for name, kinds in record["problems"].items():
        for kind, found in kinds.items():
            for method, entry in found["methods"].items():
                errors = np.array([run["error"] for run in entry["runs"]])
                start = float(np.median([run["start"] for run in entry["runs"]]))
                median = markdown.median_range((float(np.median(errors)), float(errors.min()), float(errors.max())))
                arrived = f"{int((errors < found['converged']).sum())} of {len(errors)}"
                config = ", ".join(f"{key} {value:g}" for key, value in entry["config"].items())
                rows.append([name, kind, method, f"{start:.3f}", median, arrived, config])
    settings = record["settings"]
    said = (
        f"After {settings['seconds']:g} s of the processor, {settings['seeds']} starts, pictures of {settings['resolution']}²: root mean "
        "square over elements, median (least to greatest); converged are errors below 0.02 (`box10`, `shadow`) and 0.03 (`mug`)."
    )
    head = ["problem", "start", "method", "error at the start", "at the end", "converged", "configuration"]
    return said + "\n\n" + markdown.table(head, rows)


def plot(record: Record) -> Figure:
    """Error over seconds, a panel per problem and distance of the start."""
    panels = {
        f"{name}, {kind}": {
            method: [run["curve"] for run in entry["runs"]] for method, entry in found["methods"].items()
        }
        for name, kinds in record["problems"].items()
        for kind, found in kinds.items()
    }
    return figures.curves(panels, "processor seconds", "error")
