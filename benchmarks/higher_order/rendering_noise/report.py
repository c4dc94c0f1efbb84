"""Table and figure."""

import math
import statistics

from matplotlib.figure import Figure

from benchmarks import figures, markdown
from benchmarks.runner.records import Record


def table(record: Record) -> str:
    """Final errors by samples per pixel, and renders to a tenth of the error."""
    settings = record["settings"]
    counts = [str(count) for count in settings["spp"]]
    rows = []
    for name, methods in record["tasks"].items():
        for method, entry in methods.items():
            finals = [sorted(run["final"] for run in entry[count]) for count in counts]
            times = [statistics.median(run["renders"] for run in entry[count]) for count in counts]
            rows.append(
                [
                    name,
                    method,
                    *[f"{statistics.median(f):.4f} (to {f[-1]:.3f})" for f in finals],
                    *[f"{t:.0f}" if math.isfinite(t) else "—" for t in times],
                ]
            )
    head = ["task", "method", *[f"final, {c} spp" for c in counts], *[f"to 90 %, {c} spp" for c in counts]]
    size = f"{settings['renders']} renders, {settings['runs']} runs"
    lead = f"{size}: median final error of the parameters (worst), and median renders to a tenth."
    return f"{lead}\n\n{markdown.table(head, rows)}"


def plot(record: Record) -> Figure:
    """Final errors by samples per pixel."""
    panels = {
        name: {
            method: [
                ([float(count) for count in entry], [run["final"] for run in runs])
                for runs in zip(*entry.values(), strict=True)
            ]
            for method, entry in methods.items()
        }
        for name, methods in record["tasks"].items()
    }
    return figures.curves(panels, "samples per pixel", "final error of the parameters", log="xy")
