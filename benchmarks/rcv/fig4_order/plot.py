"""Figure."""

from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

from benchmarks.internals import srgb
from benchmarks.runner.records import Record

PATHS = {"still": "unchanging parameters", "drift": "drifting parameters"}

METHODS = {
    "plain": ("plain render", "#888888"),
    "before": ("updated before use", "#c0392b"),
    "after": ("updated after use", "#1f6fb4"),
}


def plot(record: Record) -> Figure:
    """A row per path: signed bias over steps, the rendered scene, |bias| maps of the two orders."""
    maps = record["maps"]
    figure, axes = plt.subplots(2, 4, figsize=(14, 7), layout="constrained", width_ratios=[1.5, 1, 1, 1])
    for line, (path, title) in zip(axes, PATHS.items(), strict=True):
        result = record["paths"][path]
        for name, (label, colour) in METHODS.items():
            for how, style in (("converged", "none"), ("paired", "-")):
                if how not in result["methods"][name] or (name == "plain"):
                    continue
                rows = result["methods"][name][how]
                x = [row["step"] for row in rows]
                y, e = ([100 * row[key] for row in rows] for key in ("signed", "signed_error"))
                against = "converged image" if how == "converged" else "fixed weights, same samples"
                marks: dict[str, Any] = {"capsize": 2, "marker": "o" if how == "paired" else "x", "ms": 4, "ls": style}
                alpha = 1.0 if how == "paired" else 0.45
                line[0].errorbar(x, y, e, color=colour, alpha=alpha, label=f"{label}, less {against}", **marks)
        line[0].axhline(0, color="black", lw=0.7)
        line[0].set(xlabel="step", ylabel="mean bias, % of the image's mean", title=f"{title} (± standard error)")
        line[0].legend(fontsize=7)
        line[1].imshow(srgb(maps[f"{path}/reference"] / np.quantile(maps[f"{path}/reference"], 0.98)))
        line[1].set_title(f"converged, step {record['settings']['steps'] - 1}", fontsize=9)
        top = 100 * float(np.quantile(maps[f"{path}/before"], 0.98))
        drawn: Any = None
        for axis, name in zip(line[2:], ("before", "after"), strict=True):
            drawn = axis.imshow(100 * maps[f"{path}/{name}"], vmin=0, vmax=top, cmap="magma")
            entry = result["methods"][name]
            last = entry["paired"][-1]
            words = f"bias {last['signed']:+.2%} ± {last['signed_error']:.2%}, rms {last['rms']:.2%}"
            axis.set_title(f"{METHODS[name][0]}\n{words}\nequivalent to {entry['equivalent_spp']:.0f} spp", fontsize=9)
        figure.colorbar(drawn, ax=line[3], label="|mean over runs less fixed weights|,\n% of the image's mean")
        for axis in line[1:]:
            axis.axis("off")
    figure.suptitle(
        f"indirect-room, {record['settings']['resolution']}², {record['settings']['spp']} spp a step, {record['settings']['runs']} runs"
    )
    return figure
