"""Figure."""

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

from benchmarks.race_plots import colours, draw
from benchmarks.runner.records import Record
from benchmarks.volumes.fig11_smoke.run import PLAIN


def plot(record: Record) -> Figure:
    """Final errors by samples, and error along the descents."""
    budgets = list(record["budgets"])
    figure, axes = plt.subplots(1, 1 + len(budgets), figsize=(5 * (1 + len(budgets)), 4.3), layout="constrained")
    found = record["budgets"][budgets[0]]["methods"]
    plain = [name for name in found if name.startswith("plain")]
    spp = [int(name.split(", ")[1]) for name in plain]
    middle, low, high = np.array([found[name]["final"]["both"] for name in plain]).T
    axes[0].errorbar(spp, middle, [middle - low, high - middle], marker="o", color="#d1782a", label="plain")
    blues = {"rcv, 1": "#1f6fb4", "rcv, 2": "#7fb2dd"}
    for name, blue in blues.items():
        axes[0].axhline(found[name]["final"]["both"][0], color=blue, label=name)
    axes[0].set(title=f"equal {budgets[0]}: error at the end", xlabel="paths per pixel of the image", xscale="log")
    axes[0].set_xticks(spp, [str(n) for n in spp])
    axes[0].legend(fontsize=8)
    shades = dict(zip((f"plain, {n}" for n in PLAIN["steps"]), colours(len(PLAIN["steps"])), strict=True)) | blues
    for axis, budget in zip(axes[1:], budgets, strict=True):
        for name, entry in record["budgets"][budget]["methods"].items():
            if name in shades:
                curves = {"runs": entry["runs"]["both"]}
                draw(axis, curves, 0, shades[name], f"{name}: {entry['final']['both'][0]:.3f}")
        axis.set(title=f"equal {budget}", xlabel="seconds", ylabel="error / initial")
        axis.legend(fontsize=7)
    return figure
