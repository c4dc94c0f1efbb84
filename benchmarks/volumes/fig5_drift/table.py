"""Table."""

from benchmarks import markdown
from benchmarks.runner.records import Record


def table(record: Record) -> str:
    """Distances from the truth."""
    entry = record["descents"]["three-bodies"]
    keys = list(next(iter(entry["methods"].values()))["distance"])
    rows = [
        [name, *(f"{100 * mean:+.1f} ± {100 * error:.1f} %" for mean, error in found["distance"].values())]
        for name, found in entry["methods"].items()
    ]
    return (
        f"`three-bodies`, {entry['resolution']}², {entry['steps']} steps, learning rate {entry['rate']:g}, "
        f"{entry['seeds']} seeds.\n\n{markdown.table(['loss, method', *keys], rows)}"
    )
