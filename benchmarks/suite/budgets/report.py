"""Table."""

from benchmarks import markdown
from benchmarks.runner.records import Record


def table(record: Record) -> str:
    """Errors of both sides at tenths of the time."""
    rows = []
    for entry in record["entries"].values():
        falling = ", falling" if entry["setting"]["falling"] else ""
        words = f"{{problem}} | {{seconds:g}} s | {{setting[spp]}} spp, {{setting[rate]:g}}{falling}"
        errors = (" ".join(f"{error:.3f}" for error in entry[side]) for side in ("loop", "auto"))
        speed = f"**{entry['speed']:.2g}**" if entry["speed"] else "below 1"
        rows.append([markdown.fill(words, entry), *errors, speed, entry["seeds"]])
    head = "problem | budget | the loop's setting | loop, at tenths | auto, at tenths | times as early | seeds"
    return markdown.table(head, rows)
