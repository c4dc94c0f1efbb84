"""Table and figure."""

import math

from benchmarks import figures, markdown
from benchmarks.runner.records import Record


def table(record: Record) -> str:
    """Errors of the networks' answers, and when they had fallen by 90 and 99 %."""
    rows = []
    for entry in markdown.named(record["tasks"], "task", "methods", "method"):
        runs = entry["runs"]
        middle = len(runs) // 2
        finals, steps = (sorted(run[key] for run in runs) for key in ("final", "steps"))
        times = [sorted(run["reached"][goal] for run in runs)[middle] for goal in range(2)]
        row = "{task}, {weights} weights | {method} | {count} of {seconds:g} s | {rate:g}"
        rows.append(
            [
                markdown.fill(row, entry, {"count": len(runs)}),
                markdown.median_range((finals[middle], finals[0], finals[-1])),
                *(f"{t:.3g}" if math.isfinite(t) else "—" for t in times),
                steps[middle],
            ]
        )
    head = "task | method | runs | rate or radius | final error: median (range) | s to 90 % | 99 % | steps"
    return markdown.table(head, rows)


def plot(record: Record) -> figures.Figure:
    """Error over seconds."""
    panels = {
        name: {method: [run["curve"] for run in entry["runs"]] for method, entry in task["methods"].items()}
        for name, task in record["tasks"].items()
    }
    return figures.curves(panels, "seconds", "error of the poses / at the start")
