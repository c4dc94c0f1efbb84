"""Table and figure."""

import math

from matplotlib.figure import Figure

from benchmarks import figures, markdown
from benchmarks.runner.records import Record


def table(record: Record) -> str:
    """Errors of the networks' answers, and when they had fallen by 90 and 99 %."""
    rows = []
    for name, task in record["tasks"].items():
        for method, entry in task["methods"].items():
            finals = sorted(run["final"] for run in entry["runs"])
            steps = sorted(run["steps"] for run in entry["runs"])
            middle = finals[len(finals) // 2]
            spread = f"{middle:.3f} ({finals[0]:.3f} to {finals[-1]:.3f})"
            times = [sorted(run["reached"][goal] for run in entry["runs"])[len(finals) // 2] for goal in range(2)]
            rows.append(
                [
                    f"{name}, {task['weights']} weights",
                    method,
                    f"{len(finals)} of {task['seconds']:g} s",
                    f"{entry['rate']:g}",
                    spread,
                    *[f"{t:.3g}" if math.isfinite(t) else "—" for t in times],
                    steps[len(steps) // 2],
                ]
            )
    head = ["task", "method", "runs", "rate or radius", "final error: median (range)", "s to 90 %", "99 %", "steps"]
    return markdown.table(head, rows)


def plot(record: Record) -> Figure:
    """Error over seconds."""
    panels = {
        name: {method: [run["curve"] for run in entry["runs"]] for method, entry in task["methods"].items()}
        for name, task in record["tasks"].items()
    }
    return figures.curves(panels, "seconds", "error of the poses / at the start")
