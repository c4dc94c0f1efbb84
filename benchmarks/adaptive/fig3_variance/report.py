"""Table and figure."""

from benchmarks import figures, markdown
from benchmarks.adaptive.fig3_variance.run import SHOWN
from benchmarks.runner.records import Record


def table(record: Record) -> str:
    """Per case and scheme, and the ratios."""
    blocks = []
    for entry in markdown.named(record["cases"], "case"):
        text = "`mirror-trio`, {case}: {resolution}², {count} pixels with two paths each, {runs} runs."
        rows = [
            [
                markdown.fill("{name} | {variance:.3g} ± {error:.1g}", scheme),
                f"{scheme['z']:.1f}" if "z" in scheme else "",
            ]
            for scheme in markdown.named(entry["schemes"], "name")
        ]
        ratios = ", ".join("{} {:.2f} ± {:.2f}".format(name, *ratio) for name, ratio in entry["ratios"].items())
        head = "scheme | variance at equal paths | mean against all pixels, z"
        blocks += [markdown.fill(text, entry), markdown.table(head, rows), f"Ratios: {ratios}."]
    return markdown.blocks(*blocks)


def plot(record: Record) -> figures.Figure:
    """The picture, and maps of pixel probabilities over uniform ones."""
    maps, first = record["maps"], next(iter(record["cases"]))
    shown = {f"{name}, over uniform": maps[f"{first}|{name}"] for name in SHOWN}
    return figures.pictures([{"reference": maps[f"{first}|reference"], **shown}], cmap="magma", norm="log", vmin=0.1)
