"""Table."""

from benchmarks.runner.records import Record
from benchmarks.volumes.cost.table import ratios


def table(record: Record) -> str:
    """Ratios."""
    return ratios(record, "A sparse grid")
