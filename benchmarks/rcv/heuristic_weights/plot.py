"""Figure."""

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

from benchmarks.runner.records import Record

STYLES = {
    "one": ("1", "#b03a3a", "-"),
    "analytic": ("n/(n+1)", "#222222", "--"),
    "online": ("Eq. 8, running statistics of F_CV", "#d1782a", "-"),
    "absolute": ("Eq. 8 + recurrence, absolute", "#8a55a8", "-"),
    "relative": ("Eq. 8 + recurrence, relative", "#4a9a6a", "-"),
    "greater": ("Eq. 8 + greater of both (unrender)", "#1f6fb4", "-"),
}


def plot(record: Record) -> Figure:
    """A row per path: weights, and errors over a plain render's."""
    paths = record["paths"]
    figure, axes = plt.subplots(len(paths), 2, figsize=(11, 4 * len(paths)), squeeze=False, layout="constrained")
    for (left, right), (name, found) in zip(axes, paths.items(), strict=True):
        for rule, (label, colour, line) in STYLES.items():
            entry = found["rules"][rule]
            left.plot(entry["weight"], color=colour, ls=line, label=label)
            error, spread = np.array(entry["error"]), np.array(entry["standard_error"])
            right.plot(found["steps"], error, color=colour, ls=line, marker="o", ms=3, label=label)
            right.fill_between(found["steps"], error - spread, error + spread, color=colour, alpha=0.2, lw=0)
        right.axhline(1, color="#999999", lw=0.8)
        left.set(title=f"{name}: mean weight", xlabel="step", ylim=(0, 1.03))
        right.set(title=f"{name}: squared error over a plain render's", xlabel="step", yscale="log")
        right.legend(fontsize=7)
    return figure
