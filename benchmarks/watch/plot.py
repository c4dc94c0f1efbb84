"""Figure."""

import matplotlib.pyplot as plt
from matplotlib.figure import Figure

from benchmarks.runner.records import Record
from benchmarks.watch.run import MODES


def plot(record: Record) -> Figure:
    """Each round's ratios."""
    figure, axis = plt.subplots(figsize=(5, 3.2), layout="constrained")
    for mode, colour in zip(MODES[1:], ("#1f6fb4", "#d1782a"), strict=True):
        ratios = [of[mode] / of["alone"] for of in record["rounds_ms"]]
        axis.plot(ratios, "o-", color=colour, label=f"{mode}: {record['ratios'][mode]['median']:.3f}")
    axis.axhline(1.03, color="#888888", ls="--", lw=1)
    axis.set(xlabel="round", ylabel="time per step, relative to alone")
    axis.legend(frameon=False)
    return figure
