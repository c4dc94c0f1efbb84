"""Figure."""

import matplotlib.pyplot as plt
from matplotlib.figure import Figure

from benchmarks.runner.records import Record

COLOURS = {"default": "#1f6fb4", "plain": "#c98a2b"}


def plot(record: Record) -> Figure:
    """Held-out PSNR over processor minutes, one axis per capture; training PSNR dashed."""
    captures = record["captures"]
    figure, axes = plt.subplots(1, len(captures), figsize=(5.5 * len(captures), 4), squeeze=False, layout="constrained")
    for axis, (name, capture) in zip(axes[0], captures.items(), strict=True):
        for entrant, found in capture["methods"].items():
            minutes, held_out, training = zip(*found["curve"], strict=True)
            axis.plot(minutes, held_out, "o-", color=COLOURS[entrant], label=f"{entrant}: {held_out[-1]:.1f} dB")
            axis.plot(minutes, training, "--", color=COLOURS[entrant])
        axis.set(title=f"{name}³", xlabel="processor minutes", ylabel="PSNR (dB)")
        axis.legend()
    return figure
