"""Table."""

from benchmarks import markdown
from benchmarks.runner.records import Record


def table(record: Record) -> str:
    """Ratios of variances at each step."""
    rows = [
        [
            name,
            f"{entry['count']} of {entry['views']}",
            str(point["step"]),
            f"{point['uniform']:.2f}",
            f"{min(point['density']):.2f} to {max(point['density']):.2f}",
            *(f"{ratio:.2f} ± {error:.2f}" for ratio, error in zip(point["ratio"], point["error"], strict=True)),
        ]
        for name, entry in record["problems"].items()
        for point in entry["points"]
    ]
    head = [
        "problem",
        "views a step",
        "after steps",
        "uniform share",
        "importance of views",
        "variance",
        "variance in Adam's units",
    ]
    return markdown.blocks(
        "Variance of the gradient over that of equally likely views, as many a step.", markdown.table(head, rows)
    )
