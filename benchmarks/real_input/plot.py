"""Figure."""

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

from benchmarks.internals import srgb
from benchmarks.runner.records import Record

TITLES = {
    "reference": "reference",
    "initial": "start",
    "result": "recovered (rcv)",
    "true texture": "true texture",
    "texture": "recovered texture",
}


def plot(record: Record) -> Figure:
    """Per scene: reference, start and result of its first view, true and recovered texture."""
    maps, scenes = record["maps"], record["scenes"]
    figure, axes = plt.subplots(len(scenes), 5, figsize=(13, 2.7 * len(scenes)), squeeze=False, layout="constrained")
    for row, name in zip(axes, scenes, strict=True):
        scale = np.percentile(maps[f"{name}/reference"], 97)
        for axis, (what, title) in zip(row, TITLES.items(), strict=True):
            unit = 1 if "texture" in what else scale
            axis.imshow(srgb(maps[f"{name}/{what}"] / unit))
            axis.set(title=f"{name}: {title}", xticks=[], yticks=[])
    return figure
