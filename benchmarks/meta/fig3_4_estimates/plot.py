"""Figure."""

from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

from benchmarks.runner.records import Record

COLOURS = {"plain": "#bbbbbb", "adam": "#d1782a", "meta": "#1f6fb4", "coupled": "#1a8f4c"}


def plot(record: Record) -> Figure:
    """Rows: the two paths, of texels, then of pixels.

    Columns: three texels, then the error over all texels, then predicted over actual deviation."""
    rows = 4 if "pixels" in record else 2
    figure, axes = plt.subplots(rows, 5, figsize=(20, 3.75 * rows), layout="constrained")
    for row, (name, found) in zip(axes[2:], record.get("pixels", {}).get("paths", {}).items(), strict=True):
        of_pixels(row, name, found)
    for row, (name, found) in zip(axes[:2], record["paths"].items(), strict=True):
        truth = np.array(found["truth"])
        steps = np.arange(len(truth))
        for column, axis in enumerate(row[:3]):
            for method in ("adam", "meta", "coupled"):
                entry, colour = found["methods"][method], COLOURS[method]
                one, known = (np.array(entry[k])[:, column] for k in ("run", "run_predicted"))
                axis.plot(steps, one, color=colour, lw=1.2, label=method)
                axis.fill_between(steps, one - known, one + known, color=colour, alpha=0.15, lw=0)
                at = steps[5::10]
                axis.errorbar(at, np.array(entry["mean"])[at, column], np.array(entry["deviation"])[at, column],
                              fmt="none", ecolor=colour, capsize=2)  # fmt: skip
            axis.plot(steps, truth[:, column], "k--", lw=1, label="true")
            axis.plot(steps, np.array(found["methods"]["plain"]["run"])[:, column], ".", color="#999999", ms=2)
            axis.set(
                title=f"{name}: {('noisiest', '75th percentile', 'median')[column]} texel",
                xlabel="step",
                ylabel="gradient",
            )
            low, high = np.quantile(found["methods"]["plain"]["run"], [0.01, 0.99], axis=0)[:, column]
            axis.set_ylim(low, high)
        row[0].legend(fontsize=7)
        for method, colour in COLOURS.items():
            entry = found["methods"][method]
            row[3].semilogy(entry["error"], color=colour, label=method)
            if method != "plain":
                q = entry["predicted_over_actual"]
                place = list(COLOURS).index(method)
                row[4].plot([place, place], [q[0], q[4]], color=colour)
                row[4].plot([place, place], [q[1], q[3]], color=colour, lw=6, label=method)
                row[4].plot(place, q[2], "k_", ms=12)
        row[3].set(title="error, all texels", xlabel="step", ylabel="RMSE of the gradient")
        row[3].legend(fontsize=7)
        row[4].axhline(1, color="k", ls=":", lw=1)
        row[4].set(title="predicted / actual deviation", yscale="log", xticks=[])
        row[4].legend(fontsize=7)
    return figure


def of_pixels(row: Any, name: str, found: Record) -> None:
    """Estimates of three pixels; variances of F and ΔF of the median one, as single runs see them; its α."""
    truth = np.array(found["truth"])
    steps = np.arange(len(truth))
    for column, axis in enumerate(row[:3]):
        for method in ("adam", "meta"):
            entry, colour = found["methods"][method], COLOURS[method]
            one, known, mean, spread = (
                np.array(entry[k])[:, column] for k in ("run", "run_predicted", "mean", "deviation")
            )
            axis.plot(steps, one, color=colour, lw=1.2, label=method)
            axis.fill_between(steps, one - known, one + known, color=colour, alpha=0.15, lw=0)
            at = steps[5::10]
            axis.errorbar(at, mean[at], spread[at], fmt="none", ecolor=colour, capsize=2)
        axis.plot(steps, truth[:, column], "k--", lw=1, label="true")
        spread = np.array(found["methods"]["adam"]["deviation"])[:, column]
        axis.set_ylim(truth[:, column].min() - 4 * spread.max(), truth[:, column].max() + 4 * spread.max())
        which = ("noisiest", "75th percentile", "median")[column]
        axis.set(title=f"{name}: {which} pixel", xlabel="step", ylabel="derivative by blue")
    for key, colour, label in (("var_f", "#555555", "Var F"), ("var_d", "#1a8f4c", "Var ΔF")):
        seen = np.array(found[key]["single runs"])[:, :, 2]
        row[3].fill_between(steps[2:], seen[2:, 0], seen[2:, 4], color=colour, alpha=0.2, lw=0)
        row[3].plot(steps[2:], np.array(found[key]["actual"])[2:, 2], "--", color=colour, label=f"{label}, actual")
    row[3].set(title="variances, and 5 to 95 % of what runs estimate", yscale="log", xlabel="step")
    row[3].legend(fontsize=7)
    seen = np.array(found["alpha"]["single runs"])[:, :, 2]
    row[4].fill_between(steps, seen[:, 0], seen[:, 4], color=COLOURS["meta"], alpha=0.2, lw=0)
    row[4].plot(steps, seen[:, 2], color=COLOURS["meta"], label="α of runs, 5 to 95 %")
    row[4].plot(steps, np.array(found["alpha"]["best"])[:, 2], "k--", label="best α")
    row[4].set(title="weight of the past, median pixel", xlabel="step")
    row[4].legend(fontsize=7)
