"""Table."""

from benchmarks import markdown
from benchmarks.runner.records import Record


def table(record: Record) -> str:
    """Gigabytes, and copies of the unknowns."""
    grids = [key for key in next(iter(record["methods"].values())) if key.isdigit()]
    rows = [
        [by, *(f"{entry[grid]['bytes'] / 1e9:.2f} GB, {entry[grid]['copies']:.1f}" for grid in grids)]
        for by, entry in record["methods"].items()
    ]
    return (
        "Greatest resident size of the process, and what it has more than at 16³ in copies of the unknowns (extinction and "
        f"emission, 16 bytes a voxel).\n\n{markdown.table(['method', *(f'{grid}³' for grid in grids)], rows)}"
    )
