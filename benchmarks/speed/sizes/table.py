"""Table."""

from benchmarks import markdown
from benchmarks.runner.records import Record


def table(record: Record) -> str:
    """Milliseconds, and nanoseconds of a sample of the image."""
    sizes = dict(sorted(record["sizes"].items(), key=lambda item: int(item[0])))
    spp = record["settings"]["spp"]
    rows = [
        [name, *(f"{entry['ms'][name][0]:.2f}" for entry in sizes.values())]
        for name in next(iter(sizes.values()))["ms"]
    ]
    samples = [1e6 * entry["ms"]["image"][0] / (int(side) ** 2 * spp) for side, entry in sizes.items()]
    rows.append(["image, ns a sample", *(f"{each:.0f}" for each in samples)])
    rows.append(["peak memory, MB", *(f"{entry['bytes'] / 1e6:.0f}" for entry in sizes.values())])
    return markdown.blocks(
        f"`indirect-room`, {spp} spp, milliseconds (medians) by film size.",
        markdown.table(["", *(f"{side}²" for side in sizes)], rows),
    )
