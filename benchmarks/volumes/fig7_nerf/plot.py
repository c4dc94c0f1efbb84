"""Figure."""

import matplotlib.pyplot as plt
from matplotlib.figure import Figure

from benchmarks.race_plots import colours, draw
from benchmarks.runner.records import Record
from benchmarks.volumes.fig7_nerf.run import SCHEDULES, SPP, entrants
from unrender.schedules import Constant

GREENS = ("#8fd3aa", "#1a8f4c", "#7fb2dd", "#5b7f3a", "#1f6fb4")


def plot(record: Record) -> Figure:
    """Errors over time, or over samples where runs are told by the processor's time: a row per schedule; seen and unseen views."""
    kinds = list(record["schedules"])
    figure, axes = plt.subplots(
        len(kinds), 2, figsize=(11, 4.2 * len(kinds)), squeeze=False, sharey=True, layout="constrained"
    )
    names = [entrant.name for entrant in entrants(SCHEDULES[0], Constant())]
    shades = dict(zip(names, [*colours(len(SPP)), *GREENS], strict=True))
    for row, kind in zip(axes, kinds, strict=True):
        found, processor = (record["schedules"][kind][name] for name in ("methods", "processor"))
        for axis, views in zip(row, ("seen", "unseen"), strict=True):
            for name in (name for name in names if name in found):
                curves = {"runs": found[name]["runs"][views]}
                draw(axis, curves, 1 if processor else 0, shades[name], f"{name}: {found[name]['final'][views][0]:.3f}")
            axis.set(
                title=f"{kind}, views {views}",
                xlabel="paths" if processor else "seconds",
                ylabel="error of images / initial",
                yscale="log",
            )
            axis.legend(fontsize=8)
    return figure
