"""Figure."""

import matplotlib.pyplot as plt
from matplotlib.figure import Figure

from benchmarks.adaptive.fig7_failure.run import FEW
from benchmarks.internals import srgb
from benchmarks.runner.records import Record


def plot(record: Record) -> Figure:
    """Reference, map from few paths, map from many."""
    stored, problems = record["maps"], record["variance"]
    figure, axes = plt.subplots(len(problems), 3, figsize=(9, 3.2 * len(problems)), squeeze=False, layout="constrained")
    for row, name in zip(axes, problems, strict=True):
        row[0].imshow(srgb(stored[f"{name}|reference"]))
        row[0].set_title(name)
        for axis, which in zip(row[1:], ("few", "many"), strict=True):
            axis.imshow(stored[f"{name}|{which}"], cmap="magma", norm="log")
            spp = FEW if which == "few" else record["settings"]["many"]
            ratio = record["variance"][name][which]["mean"]
            axis.set_title(f"{spp} paths per pixel: variance × {ratio:.2f}")
        for axis in row:
            axis.axis("off")
    return figure
