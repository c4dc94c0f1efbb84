"""Figure."""

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

from benchmarks.runner.records import Record

COLOURS = {"plain": "#bbbbbb", "adam": "#d1782a", "meta": "#1f6fb4", "coupled": "#1a8f4c"}


def plot(record: Record) -> Figure:
    """Rows: the two paths. Columns: three texels, then the error over all texels, then predicted over actual deviation."""
    figure, axes = plt.subplots(2, 5, figsize=(20, 7.5), layout="constrained")
    for row, (name, found) in zip(axes, record["paths"].items(), strict=True):
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
