"""Table and figure."""

import numpy as np
from matplotlib.figure import Figure

from benchmarks import figures, markdown
from benchmarks.runner.records import Record


def table(record: Record) -> str:
    """What was left of the errors, and the gradient's variance."""
    rows = []
    for problem, of_problem in record["problems"].items():
        methods = of_problem["methods"]
        for name, of in methods.items():
            finals = [
                markdown.median_range((float(np.median(values)), min(values), max(values))) if values else "–"
                for values in ([run[what] for run in of["runs"] if what in run] for what in ("surface", "pictures"))
            ]
            uniform = methods["uniform"]["variance"] if "uniform" in methods else 0.0
            noise = f"{of['variance'] / uniform:.3g}" if uniform else "–"
            rows.append([problem, name, f"{of['rate']:g}", *finals, noise])
    settings = record["settings"]
    said = (
        f"Of the start's, after {settings['seconds']:g} s of the processor, {settings['seeds']} seeds: median (least to greatest). "
        f"Views of {settings['resolution']}², mini-batches of {settings['pixels']} pixels, {settings['spp']} spp. "
        "Variance of the gradient at the start, over that of uniform mini-batches."
    )
    return (
        said
        + "\n\n"
        + markdown.table(["problem", "pixels", "rate", "surface error", "picture error", "variance"], rows)
    )


def plot(record: Record) -> Figure:
    """Error of the surface over seconds, of the problems where it is known."""
    panels = {
        name: {method: [run["curve"] for run in entry["runs"]] for method, entry in found["methods"].items()}
        for name, found in record["problems"].items()
        if found["judged by"] == "surface"
    }
    return figures.curves(panels, "processor seconds", "surface error / at the start")
