"""Figure."""

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

from benchmarks.race_plots import colours, draw
from benchmarks.runner.records import Record
from benchmarks.volumes.fig11_smoke.run import PLAIN, kind

RCV = {"rcv, 1": "#1f6fb4", "rcv, 2": "#7fb2dd"}
SHADES = dict(zip((f"plain, {n}" for n in PLAIN["steps"]), colours(len(PLAIN["steps"])), strict=True)) | RCV


def plot(record: Record) -> Figure:
    """A column per race: final errors by samples, and error along the descents."""
    budgets = record["budgets"]
    figure, axes = plt.subplots(2, len(budgets), figsize=(4.6 * len(budgets), 8), squeeze=False, layout="constrained")
    for (above, below), (budget, entry) in zip(axes.T, budgets.items(), strict=True):
        found, by_samples = entry["methods"], budget not in ("steps", "time")
        title = f"smoke, equal {budget}" if kind(budget) in ("steps", "time") else f"{budget}, equal steps"
        plain = [name for name in found if name.startswith("plain")]
        spp = [int(name.split(", ")[1]) for name in plain]
        middle, low, high = np.array([found[name]["final"]["both"] for name in plain]).T
        above.errorbar(spp, middle, [middle - low, high - middle], marker="o", color="#d1782a", label="plain")
        for name in (name for name in RCV if name in found):
            above.axhline(found[name]["final"]["both"][0], color=RCV[name], label=name)
        above.set(title=f"{title}: error at the end", xlabel="paths per pixel of the image", xscale="log")
        above.set_xticks(spp, [str(n) for n in spp])
        above.set_xticks([], minor=True)
        above.legend(fontsize=8)
        for name, each in found.items():
            label = f"{name}: {each['final']['both'][0]:.3f}"
            draw(below, {"runs": each["runs"]["both"]}, int(by_samples), SHADES[name], label)
        below.set(title=title, xlabel="paths" if by_samples else "seconds", ylabel="error / initial")
        below.legend(fontsize=7)
    return figure
