"""Figure."""

import matplotlib.pyplot as plt
from matplotlib.figure import Figure

from benchmarks.internals import srgb
from benchmarks.runner.records import Record

SHOWN = {
    "photograph": "photograph",
    "projection": "projection",
    "stock": "stock",
    "stock-normals": "stock, normals",
    "stages": "stages",
}


def plot(record: Record) -> Figure:
    """A held-out photograph of the vase that the project renders, and what each makes of it."""
    maps = record["maps"]
    race = next(race for name, race in record["races"].items() if name.startswith("vase"))
    shown = {name: label for name, label in SHOWN.items() if name in maps}
    figure, axes = plt.subplots(1, len(shown), figsize=(2.4 * len(shown), 4), layout="constrained")
    for axis, (name, label) in zip(axes, shown.items(), strict=True):
        axis.imshow(srgb(maps[name]))
        psnr = race["found"].get(name, {}).get("psnr")
        axis.set_title(label if psnr is None else f"{label}\n{psnr[-1][0]:.1f} dB")
        axis.axis("off")
    return figure
