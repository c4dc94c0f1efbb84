"""Table and figure."""

from matplotlib.figure import Figure

from benchmarks import figures, markdown
from benchmarks.adaptive.fig3_variance.run import SHOWN
from benchmarks.runner.records import Record


def table(record: Record) -> str:
    """Per case and scheme, and the ratios."""
    blocks = []
    for case, entry in record["cases"].items():
        rows = [
            [name, f"{e['variance']:.3g} ± {e['error']:.1g}", f"{e['z']:.1f}" if "z" in e else ""]
            for name, e in entry["schemes"].items()
        ]
        ratios = ", ".join("{} {:.2f} ± {:.2f}".format(name, *ratio) for name, ratio in entry["ratios"].items())
        sizes = f"{entry['resolution']}², {entry['count']} pixels with two paths each, {entry['runs']} runs."
        head = ["scheme", "variance at equal paths", "mean against all pixels, z"]
        blocks += [f"`mirror-trio`, {case}: {sizes}", markdown.table(head, rows), f"Ratios: {ratios}."]
    return markdown.blocks(*blocks)


def plot(record: Record) -> Figure:
    """The picture, and maps of pixel probabilities over uniform ones."""
    maps, first = record["maps"], next(iter(record["cases"]))
    shown = {f"{name}, over uniform": maps[f"{first}|{name}"] for name in SHOWN}
    return figures.pictures([{"reference": maps[f"{first}|reference"], **shown}], cmap="magma", norm="log", vmin=0.1)
