"""Figure."""

from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

from benchmarks.landscape_plot import plot_landscape
from benchmarks.loss_landscape import LOSSES
from benchmarks.runner.records import Record


def plot(record: Record) -> Figure:
    """Fig. 6 above, Fig. 7 below."""
    whole = plt.figure(figsize=(14.5, 13), layout="constrained")
    halves: Any = whole.subfigures(2, 1, height_ratios=[1.3, 1])
    above, below = halves
    plot_landscape(above.subplots(2, 2), record["fig6"], "the wall's albedo")
    s = record["settings"]
    above.suptitle(f"Fig. 6: indirect-room, {s['resolution']}², mean of {s['runs']} renders (± standard error)")
    plot_derivatives(below.subplots(2, 6), below, record)
    words = "bias and variance relative to the mean of |derivative| and its square"
    below.suptitle(f"Fig. 7: derivative of the loss at step {s['step']} of a descent, {s['runs']} runs; {words}")
    return whole


def plot_derivatives(axes: Any, figure: Any, record: Record) -> None:
    """Two rows (losses) of derivative images."""
    maps = record["maps"]
    for row, name in zip(axes, LOSSES, strict=True):
        top = 1.0 if name == "L1" else float(np.quantile(np.abs(maps[f"{name}/reference"]), 0.98))
        entry = record["fig7"]["losses"][name]
        titles = {
            "reference": f"∂{name}, converged",
            "plain": f"plain, {record['settings']['spp']} spp, one run",
            "rcv": "control variate, one run",
            "plain/bias": f"plain: bias {entry['plain']['signed']:+.1%}, rms {entry['plain']['rms']:.1%}",
            "debiased/bias": f"Eq. 14: bias {entry['debiased']['signed']:+.1%}, rms {entry['debiased']['rms']:.1%}",
            "rcv/bias": f"control v.: bias {entry['rcv']['signed']:+.1%}, rms {entry['rcv']['rms']:.1%}",
        }
        drawn: Any = None
        for axis, (what, title) in zip(row, titles.items(), strict=True):
            drawn = axis.imshow(maps[f"{name}/{what}"], vmin=-top, vmax=top, cmap="RdBu_r")
            variance = f"\nvariance {entry[what]['variance']:.3g}" if what in entry else "\nmean of runs less converged"
            axis.set_title(title + (variance if what != "reference" else ""), fontsize=8)
            axis.axis("off")
        figure.colorbar(drawn, ax=list(row), label=f"∂{name}/∂pixel (per pixel)", shrink=0.9)
