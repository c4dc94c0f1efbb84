"""Table and figure."""

import numpy as np

from benchmarks import figures, markdown
from benchmarks.runner.records import Record


def table(record: Record) -> str:
    """Distances from the truth."""
    entry = record["descents"]["three-bodies"]
    keys = list(next(iter(entry["methods"].values()))["distance"])
    rows = [
        [name, *(f"{100 * mean:+.1f} ± {100 * error:.1f} %" for mean, error in found["distance"].values())]
        for name, found in entry["methods"].items()
    ]
    text = "`three-bodies`, {resolution}², {steps} steps, learning rate {rate:g}, {seeds} seeds.".format(**entry)
    return markdown.blocks(text, markdown.table(" | ".join(["loss, method", *keys]), rows))


def plot(record: Record) -> figures.Figure:
    """Distance over steps, a panel per loss and parameter."""
    entry = record["descents"]["three-bodies"]
    panels: dict[str, dict[str, figures.Curves]] = {}
    for name, found in entry["methods"].items():
        loss, _, method = name.partition(", ")
        for key, curve in zip(found["distance"], np.array(found["curve"]).T, strict=True):
            along = np.linspace(0, entry["steps"], len(curve))
            panels.setdefault(f"{loss}: {key}", {})[method] = [(along, curve)]
    return figures.curves(panels, "step", "relative distance from the truth", columns=3, log="", level=0.0)
