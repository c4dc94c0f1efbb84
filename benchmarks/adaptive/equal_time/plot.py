"""Figure."""

import matplotlib.pyplot as plt
from matplotlib.figure import Figure

from benchmarks.adaptive.equal_time.run import timed
from benchmarks.pixel_schemes import COLOURS
from benchmarks.race_plots import draw
from benchmarks.runner.records import Record


def plot(record: Record) -> Figure:
    """Error over time, one axis per task."""
    entries = record["entries"]
    figure, axes = plt.subplots(1, len(entries), figsize=(5 * len(entries), 4), squeeze=False, layout="constrained")
    for axis, (name, entry) in zip(axes[0], entries.items(), strict=True):
        for method, runs in timed(entry["methods"], record["seconds_per_path"][name]).items():
            draw(axis, {"runs": runs}, 0, COLOURS[method], f"{method}: {entry['errors'][method][-1]:.3f}")
        axis.set(title=name, xlabel="seconds", ylabel="parameter error / initial", yscale="log")
        axis.legend(fontsize=7)
    return figure
