"""Tables."""

from typing import Any

from benchmarks import markdown
from benchmarks.runner.records import Record

_POWERS = {"methods": "³", "textures": "²"}


def table(record: Record) -> str:
    """Gigabytes, and copies of the unknowns, of grids and of textures."""
    both = [_rows(record[part], power) for part, power in _POWERS.items() if part in record]
    return (
        "Greatest resident size of the process, and what it has more than at 16³ voxels or 64² texels in copies of the unknowns "
        "(extinction and emission, 16 bytes a voxel; reflectance, 12 bytes a texel).\n\n" + "\n\n".join(both)
    )


def _rows(methods: dict[str, Any], power: str) -> str:
    sizes = [key for key in next(iter(methods.values())) if key.isdigit()]
    rows = [
        [by, *(f"{entry[size]['bytes'] / 1e9:.2f} GB, {entry[size]['copies']:.1f}" for size in sizes)]
        for by, entry in methods.items()
    ]
    return markdown.table(["method", *(f"{size}{power}" for size in sizes)], rows)
