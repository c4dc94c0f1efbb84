"""Figure."""

import matplotlib.pyplot as plt
from matplotlib.figure import Figure

from benchmarks.runner.records import Record

COLOURS = {"first kept": "#d1782a", "corrected": "#1f6fb4"}


def plot(record: Record) -> Figure:
    """A column per decay: the sequence with the largest first value; mean squares beside their closed forms."""
    decays = record["decays"]
    figure, axes = plt.subplots(2, len(decays), figsize=(4.2 * len(decays), 6), squeeze=False, layout="constrained")
    for (above, below), (alpha, entry) in zip(axes.T, decays.items(), strict=True):
        for name, found in entry.items():
            above.plot(found["example"], color=COLOURS[name], label=name)
            below.plot(found["mean_square"], color=COLOURS[name], label=name)
            below.plot(found["closed_form"], color="black", ls=":", lw=0.8)
        above.axhline(0, color="#999999", lw=0.5)
        above.set(
            title=f"α = {alpha}, first value {record['largest_first']:.1f}", xlabel="n", ylabel="mean of one sequence"
        )
        below.set(xlabel="n", ylabel="mean square (dotted: closed form)", yscale="log")
    axes[0][0].legend(fontsize=8)
    return figure
