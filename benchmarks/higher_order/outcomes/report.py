"""Table and figure."""

from benchmarks import figures, markdown
from benchmarks.runner.records import Record


def table(record: Record) -> str:
    """Final errors of the runs whose outcomes the figure shows."""
    methods = list(next(iter(record["errors"].values())))
    rows = [[name, *(f"{errors[method]:.4f}" for method in methods)] for name, errors in record["errors"].items()]
    text = "Error of the parameters at the end, over that at the start."
    return markdown.blocks(text, markdown.table(" | ".join(["task", *methods]), rows))


def plot(record: Record) -> figures.Figure:
    """Per task: start, outcomes, reference."""
    rows = [
        {f"{name}: {kind}": record["maps"][f"{name}|{kind}"] for kind in ("start", *errors, "reference")}
        for name, errors in record["errors"].items()
    ]
    return figures.pictures(rows)
