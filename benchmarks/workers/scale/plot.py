"""Figure."""

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

from benchmarks.runner.records import Record
from benchmarks.workers.scale.cost import Costs, compute
from benchmarks.workers.scale.summary import JOBS, NETWORKS, network

_COLOURS = {"fitted": "#1f6fb4", "held out": "#d1782a", "rendering": "#2a8f5b"}
_OF_JOBS = ("#8a5fb0", "#1f6fb4", "#d1782a", "#2a8f5b")


def plot(record: Record) -> Figure:
    """Predicted against measured steps; and what is predicted for more workers."""
    figure, axes = plt.subplots(1, 1 + len(NETWORKS), figsize=(11, 3.6), layout="constrained")
    rows = record.get("rows", [])
    for use, colour in _COLOURS.items():
        of = [row for row in rows if row["use"] == use]
        axes[0].loglog([r["seconds"] for r in of], [r["predicted"] for r in of], "o", color=colour, ms=4, label=use)
    if rows:
        ends = [min(r["seconds"] for r in rows) / 1.3, max(r["seconds"] for r in rows) * 1.3]
        axes[0].plot(ends, ends, color="#888888", lw=1)
    axes[0].set(xlabel="measured step (s)", ylabel="predicted (s)", title="seconds of a step")
    axes[0].legend(frameon=False)
    if "costs" not in record:
        return figure
    costs, counts = Costs(**record["costs"]), 2 ** np.arange(10)
    for axis, (where, limits) in zip(axes[1:], NETWORKS.items(), strict=True):
        for (name, job), colour in zip(JOBS.items(), _OF_JOBS, strict=True):
            times = [costs.step(job, network(int(n), *limits)) for n in counts]
            axis.loglog(counts, times, "o-", ms=3, color=colour, label=f"{name}, {job.parameters:,} numbers")
        axis.loglog(
            counts,
            [compute(job, network(int(n), *limits)) for n in counts],
            "--",
            color="#888888",
            label="rendering alone",
        )
        axis.set(xlabel="GPUs, eight a machine", title=where)
        axis.legend(frameon=False, fontsize=8)
    return figure
