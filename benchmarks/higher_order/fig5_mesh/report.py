"""Table and figure."""

from matplotlib.figure import Figure

from benchmarks import figures, markdown
from benchmarks.runner.records import Record


def table(record: Record) -> str:
    """What was left of the loss."""
    settings = record["settings"]
    rows = []
    for method, runs in record["methods"].items():
        finals = [f"{run['final']:.3f}" for run in runs]
        rows.append([method, ", ".join(finals), ", ".join(str(run["steps"]) for run in runs)])
    size = (
        f"{record['numbers']} numbers, 6 views of {settings['resolution']}², {settings['seconds']:g} s of the processor"
    )
    return f"{size}, runs: {settings['runs']}.\n\n" + markdown.table(["method", "loss / at the start", "steps"], rows)


def plot(record: Record) -> Figure:
    """Loss over seconds."""
    methods = {method: [run["curve"] for run in runs] for method, runs in record["methods"].items()}
    return figures.curves({f"sphere-to-mesh: {record['numbers']} numbers": methods}, "seconds", "loss / at the start")
