"""Table."""

from benchmarks import markdown
from benchmarks.runner.records import Record


def table(record: Record) -> str:
    """Error and time of each denoiser, by problem and film size."""
    entries = {
        (name, side): entry
        for name, sizes in record["problems"].items()
        for side, entry in sorted(sizes.items(), key=lambda item: int(item[0]))
    }
    names = list(dict.fromkeys(way for entry in entries.values() for way in entry))
    rows = [
        [way, *(f"{e[way]['error']:.2f} ({e[way]['ms']:.0f} ms)" if way in e else "" for e in entries.values())]
        for way in names
    ]
    head = ["", *(f"`{name}`, {side}²" for name, side in entries)]
    return markdown.blocks(
        f"Error over that of the noisy picture of {record['settings']['spp']} spp, and time.",
        markdown.table(head, rows),
    )
