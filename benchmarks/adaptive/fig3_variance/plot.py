"""Figure."""

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

from benchmarks.adaptive.fig3_variance.run import FIVE_LEVELS, SHOWN
from benchmarks.internals import srgb
from benchmarks.pixel_schemes import COLOURS
from benchmarks.runner.records import Record


def plot(record: Record) -> Figure:
    """The image, two maps of pixel probabilities, and the variances of the paper's estimator in all cases."""
    maps, cases = record["maps"], record["cases"]
    first = next(iter(cases))
    figure, axes = plt.subplots(1, 4, figsize=(16, 4), layout="constrained", width_ratios=(1, 1.15, 1.15, 1.5))
    axes[0].imshow(srgb(maps[f"{first}|reference"]))
    axes[0].set_title("reference")
    for axis, name in zip(axes[1:3], SHOWN, strict=True):
        shown = axis.imshow(maps[f"{first}|{name}"], cmap="magma", norm="log", vmin=0.1)
        axis.set_title(f"{name}, over uniform")
        figure.colorbar(shown, ax=axis)
    for axis in axes[:3]:
        axis.axis("off")
    names = ["all", "uniform", *SHOWN, FIVE_LEVELS]
    for number, name in enumerate(names):
        of = [entry["schemes"][name] for entry in cases.values()]
        places = np.arange(len(cases)) + 0.16 * (number - 2)
        values, errors = [e["variance"] for e in of], [e["error"] for e in of]
        axes[3].barh(places, values, height=0.15, xerr=errors, label=name, color=COLOURS[name])
    axes[3].set(xscale="log", xlabel="variance of dL/d(roughness)", yticks=range(len(cases)), yticklabels=list(cases))
    axes[3].invert_yaxis()
    axes[3].legend(fontsize=7, ncols=5, loc="lower center", bbox_to_anchor=(0.25, 1))
    return figure
