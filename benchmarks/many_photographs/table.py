"""Table."""

from benchmarks import markdown
from benchmarks.runner.records import Record


def table(record: Record) -> str:
    """Peaks by the number of photographs."""
    rows = [
        [count, *(f"{entry[name] / 1e6:.0f} MB" for name in ("read", "run"))]
        for count, entry in record["peaks"].items()
    ]
    head = ["photographs", "peak once read", "peak after the steps"]
    return f"Photographs of {record['side']}² pixels, {record['pixels']} pixels a step.\n\n{markdown.table(head, rows)}"
