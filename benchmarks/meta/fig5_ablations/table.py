"""Table."""

from benchmarks import markdown
from benchmarks.runner.records import Record


def table(record: Record) -> str:
    """Meta, Fig. 5."""
    settings = record["settings"]
    rows = [
        [name, f"{f['rate']:g}", f"{f['final'][0]:.3f} ({f['final'][1]:.3f} to {f['final'][2]:.3f})"]
        for name, f in record["methods"].items()
    ]
    sizes = f"`ajar`, {settings['resolution']}², {settings['seconds']:g} s, {settings['seeds']} seeds, each tuned."
    return f"{sizes}\n\n{markdown.table(['form, and what is left out', 'rate', 'final error: median (range)'], rows)}"
