"""Figure."""

from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

from benchmarks.internals import srgb
from benchmarks.runner.records import Record

METHODS = {"plain": ("plain", "#888888"), "primary": ("primary space", "#d1782a"), "path": ("path space", "#1f6fb4")}


def plot(record: Record) -> Figure:
    """A row per scene: weight and variance over steps, weight maps of the two spaces, cost."""
    maps = record["maps"]
    # Where the spaces agree, both are to be seen.
    styles: dict[str, dict[str, Any]] = {"plain": {}, "primary": {"lw": 4, "alpha": 0.6}, "path": {}}
    entries = record["scenes"]
    size, widths = (19, 3.9 * len(entries)), [1.35, 1.35, 1, 1, 1, 1.2]
    figure, axes = plt.subplots(len(entries), 6, figsize=size, squeeze=False, layout="constrained", width_ratios=widths)
    for row, (scene, entry) in zip(axes, entries.items(), strict=True):
        steps, checked = np.arange(len(entry["methods"]["plain"]["weight"])), np.array(entry["checked"])
        plain = entry["methods"]["plain"]
        for name, (label, colour) in METHODS.items():
            found = entry["methods"][name]
            if name != "plain":
                row[0].plot(steps, found["weight"], color=colour, label=label, **styles[name])
            row[1].plot(
                steps, np.array(found["variance"]) / plain["variance"], color=colour, label=label, **styles[name]
            )
            unit = np.array(plain["variance"])[checked]
            marks: dict[str, Any] = {"color": colour, "ls": "none", "marker": "x", "ms": 5, "capsize": 2}
            row[1].errorbar(checked, np.array(found["error"]) / unit, np.array(found["error_error"]) / unit, **marks)
        row[0].plot(steps, steps / (steps + 1), color="#bbbbbb", ls=":", label="n/(n+1)")
        row[0].set(title=f"{scene}: mean control weight", xlabel="step", ylabel="weight", ylim=(0, 1.02))
        row[0].legend(fontsize=8)
        row[1].set(
            title="variance over runs (× squared error)",
            xlabel="step",
            ylabel="relative to a plain render",
            yscale="log",
        )
        row[1].legend(fontsize=8)
        reference = maps[f"{scene}/reference"]
        row[2].imshow(srgb(reference / np.quantile(reference, 0.98)))
        row[2].set_title("converged, last step", fontsize=9)
        drawn: Any = None
        for axis, name in zip(row[3:5], ("primary", "path"), strict=True):
            drawn = axis.imshow(maps[f"{scene}/{name}"], vmin=0, vmax=1, cmap="viridis")
            axis.set_title(f"weights, {METHODS[name][0]}", fontsize=9)
        figure.colorbar(drawn, ax=list(row[3:5]), label="control weight (mean over runs)", shrink=0.8)
        for axis in row[2:5]:
            axis.axis("off")
        place = np.arange(len(METHODS))
        for shift, what, shade in ((-0.2, "image", 1.0), (0.2, "step", 0.5)):
            times = [entry["costs"][name][f"{what}_ms"] for name in METHODS]
            bars = row[5].bar(place + shift, times, 0.38, color=[m[1] for m in METHODS.values()], alpha=shade)
            row[5].bar_label(bars, [f"{what}\n{time / times[0]:.2f}×" for time in times], fontsize=7)
        row[5].set_xticks(place, [m[0] for m in METHODS.values()], fontsize=8)
        row[5].set(title="cost: image, gradient step", ylabel="milliseconds")
        row[5].margins(y=0.18)
    words = f"{record['settings']['resolution']}², {record['settings']['spp']} spp a step, {record['settings']['runs']} runs"
    figure.suptitle(f"{words}, the same parameters for all")
    return figure
