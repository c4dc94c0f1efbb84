"""Table and figure."""

import math
import statistics

from benchmarks import figures, markdown
from benchmarks.runner.records import Record


def table(record: Record) -> str:
    """Final errors by samples per pixel, and renders to a tenth of the error."""
    counts, rows = [str(count) for count in record["settings"]["spp"]], []
    for name, methods in record["tasks"].items():
        for method, entry in methods.items():
            finals = [[run["final"] for run in entry[count]] for count in counts]
            times = [statistics.median(run["renders"] for run in entry[count]) for count in counts]
            cells = [f"{statistics.median(f):.4f} (to {max(f):.3f})" for f in finals]
            rows.append([name, method, *cells, *(f"{t:.0f}" if math.isfinite(t) else "—" for t in times)])
    head = ["task | method", *(f"final, {c} spp" for c in counts), *(f"to 90 %, {c} spp" for c in counts)]
    text = (
        "{renders} renders, {runs} runs: median final error of the parameters (worst), and median renders to a tenth."
    )
    return markdown.blocks(text.format(**record["settings"]), markdown.table(" | ".join(head), rows))


def plot(record: Record) -> figures.Figure:
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
