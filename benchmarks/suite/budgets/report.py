"""Table."""

from benchmarks import markdown
from benchmarks.runner.records import Record


def table(record: Record) -> str:
    """Errors of both sides at tenths of the time."""
    rows = []
    for entry in record["entries"].values():
        setting = entry["setting"]
        words = f"{setting['spp']} spp, {setting['rate']:g}{', falling' if setting['falling'] else ''}"
        speed = f"**{entry['speed']:.2g}**" if entry["speed"] else "below 1"
        rows.append(
            [
                entry["problem"],
                f"{entry['seconds']:g} s",
                words,
                " ".join(f"{error:.3f}" for error in entry["loop"]),
                " ".join(f"{error:.3f}" for error in entry["auto"]),
                speed,
                str(entry["seeds"]),
            ]
        )
    head = ["problem", "budget", "the loop's setting", "loop, at tenths", "auto, at tenths", "times as early", "seeds"]
    return markdown.table(head, rows)
