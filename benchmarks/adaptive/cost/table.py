"""Table."""

from benchmarks import markdown
from benchmarks.runner.records import Record


def table(record: Record) -> str:
    """Refreshes, image sizes, memory."""
    settings = record["settings"]
    rows = [
        [name, f"{e['uniform']:.1f}", f"{e['kept']:.1f}", f"{e['refreshed']:.1f}", f"{e['share']:.1%}"]
        for name, e in record["refresh"].items()
    ]
    sizes = record["step_ms"]
    first = next(iter(sizes.values()))
    by_size = [[f"{size}²", f"{ms:.1f}", f"{ms / first:.3f}"] for size, ms in sizes.items()]
    memory = record["memory"]
    where = "host memory" if memory["host"] else "the device"
    return "\n\n".join(
        [
            f"{settings['count']} pixels a step, milliseconds of a step:",
            markdown.table(
                ["problem", "uniform", "adaptive, same probabilities", "updated every 20 steps", "share of updates"],
                rows,
            ),
            "By the size of the image, importance-map updates included, `plain-and-textured`:",
            markdown.table(["image", "ms a step", "over the smallest"], by_size),
            f"16 views of 4 megapixels: at most {memory['peak_gb']:.2f} GB resident, references in {where}.",
        ]
    )
