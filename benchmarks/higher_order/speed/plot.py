"""Figure."""

import matplotlib.pyplot as plt
from matplotlib.figure import Figure

from benchmarks.runner.records import Record


def plot(record: Record) -> Figure:
    """Milliseconds per perturbation over the size of the batch."""
    figure, axis = plt.subplots(figsize=(6, 4), layout="constrained")
    for name, entry in record["meshes"].items():
        sizes = [row["size"] for row in entry["batches"]]
        line = axis.plot(sizes, [row["wall"] for row in entry["batches"]], "o-", label=f"{name}: a batch of poses")[0]
        axis.plot(sizes, [row["kernels"] for row in entry["batches"]], ":", color=line.get_color(), label="its kernels")
        axis.axhline(entry["moved"], ls="--", color=line.get_color(), label="moved vertices, mi.render")
    axis.set(xscale="log", yscale="log", xlabel="perturbations in a batch", ylabel="milliseconds per perturbation")
    axis.legend(fontsize=7)
    return figure
