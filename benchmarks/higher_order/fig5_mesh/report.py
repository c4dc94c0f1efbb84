"""Table and figure."""

from benchmarks import figures, markdown
from benchmarks.runner.records import Record


def table(record: Record) -> str:
    """What was left of the loss."""
    text = "{numbers} numbers, 6 views of {resolution}², {seconds:g} s of the processor, runs: {runs}."
    rows = [
        [method, ", ".join(f"{run['final']:.3f}" for run in runs), ", ".join(str(run["steps"]) for run in runs)]
        for method, runs in record["methods"].items()
    ]
    return markdown.blocks(
        markdown.fill(text, record, record["settings"]), markdown.table("method | loss / at the start | steps", rows)
    )


def plot(record: Record) -> figures.Figure:
    """Loss over seconds."""
    methods = {method: [run["curve"] for run in runs] for method, runs in record["methods"].items()}
    return figures.curves({f"sphere-to-mesh: {record['numbers']} numbers": methods}, "seconds", "loss / at the start")
