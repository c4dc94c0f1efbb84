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
            axis.plot(
                minutes, training, "x--", color=COLOURS[entrant], label=f"{entrant}, training: {training[-1]:.1f} dB"
            )
        axis.set(title=f"{name}³", xlabel="processor minutes", ylabel="PSNR (dB)")
        axis.set_xlim(0, 1.1 * max(found["curve"][-1][0] for found in capture["methods"].values()))
        axis.legend()
    return figure
