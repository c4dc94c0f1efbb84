"""Figure."""

import matplotlib.pyplot as plt
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter

from benchmarks.pixel_schemes import COLOURS
from benchmarks.runner.records import Record


def plot(record: Record) -> Figure:
    """The ratios of variances by alpha, and the errors along the descents."""
    descents = record["descents"]
    figure, axes = plt.subplots(1, 2 + len(descents), figsize=(4 * (2 + len(descents)), 3.6), layout="constrained")
    for axis, of, title in zip(axes, ("derivative", "loss"), ("image's derivative", "loss's gradient"), strict=False):
        for name, points in record["variance"].items():
            ratios = [point[of]["ratio"] for point in points]
            errors = [point[of]["error"] for point in points]
            axis.errorbar([point["alpha"] for point in points], ratios, errors, label=name, marker="o", capsize=2)
        ticks = [point["alpha"] for point in next(iter(record["variance"].values()))]
        axis.axhline(1, color="black", linewidth=0.8)
        axis.set(
            xscale="log",
            yscale="log",
            xlabel="alpha",
            title=f"variance of the {title}",
            ylabel="differential / ordinary",
        )
        axis.set_xticks(ticks, [f"{alpha:g}" for alpha in ticks])
        axis.xaxis.set_minor_formatter(NullFormatter())
    axes[0].legend()
    for axis, (name, entries) in zip(axes[2:], descents.items(), strict=True):
        for label, entry in entries.items():
            style = "-" if label.endswith("differential") else ":"
            axis.plot(entry["along"], style, color=COLOURS[label.partition(",")[0]], label=label)
        axis.set(title=name, xlabel="step", ylabel="error of alpha over the start's", yscale="log")
    axes[-1].legend()
    return figure
