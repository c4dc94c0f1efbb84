"""Table."""

from benchmarks import markdown
from benchmarks.runner.records import Record


def table(record: Record) -> str:
    """Distances from the truth."""
    keys = list(next(iter(record["drift"].values())))
    rows = [
        [name, *(f"{100 * mean:+.1f} ± {100 * error:.1f} %" for mean, error in entry.values())]
        for name, entry in record["drift"].items()
    ]
    settings = record["settings"]
    return (
        f"`three-bodies`, {settings['resolution']}², {settings['steps']} steps, learning rate {record['rate']:g}, "
        f"{settings['seeds']} seeds.\n\n{markdown.table(['loss, method', *keys], rows)}"
    )
