"""Figure."""

from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

from benchmarks.runner.records import Record

RULES = {
    "analytic": ("analytic n/(n+1)", "#222222"),
    "online": ("Eq. 8, running statistics of F_CV", "#d1782a"),
    "absolute": ("Eq. 8 + recurrence, absolute", "#8a55a8"),
    "relative": ("Eq. 8 + recurrence, relative", "#4a9a6a"),
    "greater": ("Eq. 8 + greater of both recurrences (unrender)", "#1f6fb4"),
}


def plot(record: Record) -> Figure:
    """Weights and variance over steps; the last weights of one run as maps."""
    maps = record["maps"]
    mosaic: Any = [["weight"] * 3 + ["variance"] * 3, ["online"] * 2 + ["absolute"] * 2 + ["greater"] * 2]
    figure, axes = plt.subplot_mosaic(mosaic, figsize=(11, 7.4), layout="constrained", height_ratios=[1.25, 1])
    steps = np.arange(record["settings"]["steps"])
    for rule, (label, colour) in RULES.items():
        found = record["rules"][rule]
        style: dict[str, Any] = {"color": colour, "ls": "--" if rule == "analytic" else "-", "label": label}
        axes["weight"].plot(steps, found["weight"], **style)
        if rule != "analytic":
            low, high = np.array(found["weight_10_90"])
            axes["weight"].fill_between(steps, low, high, color=colour, alpha=0.12, lw=0)
        mean, error = np.array(found["variance"]), np.array(found["variance_error"])
        axes["variance"].plot(steps + 1, mean, **style)
        axes["variance"].fill_between(steps + 1, mean - error, mean + error, color=colour, alpha=0.2, lw=0)
    axes["variance"].plot(steps + 1, 1 / (steps + 1), color="#999999", lw=4, alpha=0.5, zorder=0, label="1/(n+1)")
    axes["variance"].plot(
        steps[3:] + 1, 1 / (steps[3:] - 1), color="#999999", ls=":", label="1/(n-1): weight 0 at steps 1 and 2"
    )
    axes["weight"].set(
        xlabel="step n", ylabel="control weight (mean; 10th to 90th percentile)", title="Weights", ylim=(0, 1.02)
    )
    axes["weight"].legend(loc="lower right", fontsize=8)
    title = f"Variance over {record['settings']['runs']} runs (band: standard error)"
    axes["variance"].set(xlabel="renders so far, n + 1", ylabel="variance / variance of one render", title=title)
    axes["variance"].set(xscale="log", yscale="log")
    axes["variance"].legend(loc="lower left", fontsize=8)
    drawn: Any = None
    for rule in ("online", "absolute", "greater"):
        drawn = axes[rule].imshow(maps[rule], vmin=0, vmax=1, cmap="viridis")
        mean = record["rules"][rule]["weight"][-1]
        best = record["rules"]["analytic"]["weight"][-1]
        words = f"{RULES[rule][0]}\nlast weights of one run (mean {mean:.3f}; n/(n+1) = {best:.3f})"
        axes[rule].set_title(words, fontsize=8)
        axes[rule].axis("off")
    figure.colorbar(drawn, ax=[axes[r] for r in ("online", "absolute", "greater")], label="control weight", shrink=0.9)
    figure.suptitle(
        f"indirect-room, unchanging, {record['settings']['resolution']}², {record['settings']['spp']} spp a step"
    )
    return figure
