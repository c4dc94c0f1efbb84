"""Table."""

from benchmarks import markdown
from benchmarks.runner.records import Record


def table(record: Record) -> str:
    """What was left of the loss."""
    settings = record["settings"]
    rows = []
    for name, task in record["tasks"].items():
        for method, runs in task["methods"].items():
            finals = ", ".join(f"{run['final']:.3f}" for run in runs)
            rows.append([name, task["numbers"], method, finals, ", ".join(str(run["steps"]) for run in runs)])
    lead = f"{settings['views']} views of {settings['resolution']}², {settings['seconds']:g} s of the processor, runs: {settings['runs']}."
    return f"{lead}\n\n" + markdown.table(["task", "numbers", "method", "loss / at the start", "steps"], rows)
