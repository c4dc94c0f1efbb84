"""Table."""

from benchmarks import markdown
from benchmarks.runner.records import Record


def table(record: Record) -> str:
    """Ratios."""
    return ratios(record, "`smoke`")


def ratios(record: Record, what: str) -> str:
    """Of a grid of something."""
    settings = record["settings"]
    rows = [[name, f"{m:.2f}", f"{low:.2f} to {high:.2f}"] for name, (low, m, high) in record["ratios"].items()]
    size = f"{what}, {settings['resolution']}², a grid of {settings['grid']}³, {settings['spp']} spp, {settings['repeats']} repeats."
    return f"{size}\n\n{markdown.table(['ratio', 'median', 'range'], rows)}"
