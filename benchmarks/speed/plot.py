"""Figure."""

import matplotlib.pyplot as plt
from matplotlib.figure import Figure

from benchmarks.runner.records import Record


def plot(record: Record) -> Figure:
    """Two bar charts: primal and step."""
    figure, axes = plt.subplots(1, 2, figsize=(9, 3.2), layout="constrained")
    primal = {k: record["primal_ms"][k][0] for k in ("mitsuba_prb", "plain", "pair")}
    steps = {
        "stock loop": record["step_ms"]["stock"],
        "leave-one-out groups": record["step_ms"]["leave-one-out"][0],
        "control variate": record["step_ms"]["rcv"][0],
    }
    for axis, bars, title in zip(axes, (primal, steps), ("primal render", "whole step"), strict=True):
        axis.bar(list(bars), list(bars.values()), color=["#888888", "#d1782a", "#1f6fb4"])
        axis.set(
            title=f"{title}, {record['settings']['resolution']}², {record['settings']['spp']} spp",
            ylabel="milliseconds",
        )
    return figure
