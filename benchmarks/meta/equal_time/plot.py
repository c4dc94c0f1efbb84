"""Figure."""

import matplotlib.pyplot as plt
from matplotlib.figure import Figure

from benchmarks.race_plots import colours, draw
from benchmarks.runner.records import Record


def plot(record: Record) -> Figure:
    """Per problem: error over seconds and over samples."""
    entries = record["entries"]
    figure, axes = plt.subplots(len(entries), 2, figsize=(12, 4.2 * len(entries)), squeeze=False, layout="constrained")
    for row, (name, entry) in zip(axes, entries.items(), strict=True):
        adam = [n for n, e in entry["methods"].items() if e["group"] == "adam"]
        shade = dict(zip(adam, colours(len(adam)), strict=True))
        other = {
            "rcv": "#555555",
            "meta": "#1f6fb4",
            "meta, naive": "#7fb2dd",
            "coupled": "#1a8f4c",
            "coupled, rcv": "#8a3fa8",
        }
        for column, (axis, unit) in enumerate(zip(row, ("seconds", "paths"), strict=True)):
            for method, found in entry["methods"].items():
                colour = shade.get(method, other.get(found["group"]))
                label = f"{method}, rate {found['rate']:g}: {found['final'][0]:.3f}"
                draw(
                    axis,
                    found,
                    column,
                    colour,
                    label,
                    "--" if method.endswith("8 spp") and method not in shade else "-",
                )
            axis.set(title=name, xlabel=unit, ylabel="parameter error / initial", yscale="log")
            if column:
                axis.set_xscale("log")
            else:
                axis.legend(fontsize=6)
    return figure
