"""Table."""

from benchmarks import markdown
from benchmarks.runner.records import Record


def table(record: Record) -> str:
    """Per scheme."""
    rows = [
        [name, f"{e['variance']:.3g} ± {e['error']:.1g}", f"{e['z']:.1f}" if "z" in e else ""]
        for name, e in record["schemes"].items()
    ]
    ratios = ", ".join(f"{name} {ratio:.2f}" for name, ratio in record["ratios"].items())
    head = ["scheme", "variance at equal paths", "mean against all pixels, z"]
    settings = record["settings"]
    return (
        f"`mirror-trio`, {settings['resolution']}², {settings['count']} pixels with two paths each, {settings['runs']} runs.\n\n"
        f"{markdown.table(head, rows)}\n\nRatios: {ratios}."
    )
