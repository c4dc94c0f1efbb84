"""Table and figure."""

from matplotlib.figure import Figure

from benchmarks import figures, markdown
from benchmarks.derivative_bias import METHODS
from benchmarks.runner.records import Record


def table(record: Record) -> str:
    """The bias of each image."""
    settings, network = record["settings"], record["network"]
    sizes = (
        f"{settings['resolution']}², {settings['spp']} spp, {settings['runs']} runs, step {settings['step']}; relative to the derivative's "
        f"mean. The network tells {network['accuracy']:.0%} of new crops, by chance {network['chance']:.0%}."
    )
    found = record["bias"]["losses"]["perceptual"]
    rows = []
    for method in METHODS:
        f = found[method]
        rows.append(
            [
                method,
                f"{f['rms']:.2f} ({f['square']:.3f} ± {f['square_error']:.3f})",
                f"{f['signed']:+.1%} ± {f['signed_error']:.1%}",
                f"{f['variance']:.2f}",
            ]
        )
    ends = [
        [
            f"{name} spp",
            f"{entry['rate']:g}",
            markdown.median_range(entry["final"]),
            f"{entry['runs'][0][-1][1] / 1e6:.1f}",
        ]
        for name, entry in record["tasks"]["cornell-box"]["methods"].items()
    ]
    parts = [
        sizes,
        markdown.table(["image", "bias, RMS over pixels (its square)", "mean bias", "variance"], rows),
        f"Descents of {settings['steps']} steps, {settings['seeds']} seeds:",
        markdown.table(["image", "rate", "final error of the wall (range)", "million paths"], ends),
    ]
    return "\n\n".join(parts)


def plot(record: Record) -> Figure:
    """The walls that descents find, and the bias of the derivative."""
    maps, ends = record["maps"], record["tasks"]["cornell-box"]["methods"]
    walls = {f"{name} spp: {entry['final'][0]:.2f}": maps[f"wall/{name}"] for name, entry in ends.items()}
    bias = {f"bias, {method}": maps[f"perceptual/{method}/bias"] for method in METHODS}
    return figures.pictures([{"reference": maps["wall/reference"], **walls}, bias], signed=True)
