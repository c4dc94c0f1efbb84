"""Tables."""

from benchmarks import markdown
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
