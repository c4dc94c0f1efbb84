"""Figure."""

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

from benchmarks.runner.records import Record


def plot(record: Record) -> Figure:
    """Variance of the difference over that of the gradient against the step, both spaces; empty before it is measured."""
    figure, axis = plt.subplots(figsize=(6, 4.5), layout="constrained")
    colours = ("#1f6fb4", "#d1782a", "#1a8f4c", "#8a3fa8")
    measured = record.get("variance", {}).get("problems", {})
    for colour, (name, found) in zip(colours, measured.items(), strict=False):
        for space, style in (("path", "o-"), ("primary", "s:")):
            ratio = np.array(found[space]["difference"]) / found[space]["gradient"]
            label = f"{name}, {space}: slope {found[space]['slope']:.2f}"
            axis.loglog(found["steps"], ratio, style, color=colour, label=label, ms=4)
    axis.set(xlabel="step, share of the way to the truth", ylabel="Var ΔF / Var F")
    if measured:
        axis.legend(fontsize=7)
    return figure
