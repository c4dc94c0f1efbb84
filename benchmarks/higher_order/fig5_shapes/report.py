"""Table and figure."""

from matplotlib.figure import Figure

from benchmarks import figures, markdown
from benchmarks.runner.records import Record


def table(record: Record) -> str:
    """What was left of the loss."""
    settings = record["settings"]
    rows = []
    for name, task in record["tasks"].items():
        for method, found in task["methods"].items():
            finals = ", ".join(f"{run['final']:.3f}" for run in found["runs"])
            steps = ", ".join(str(run["steps"]) for run in found["runs"])
            rows.append([name, task["numbers"], method, f"{found['setting']:g}", finals, steps])
    lead = f"{settings['views']} views of {settings['resolution']}², {settings['seconds']:g} s of the processor, runs: {settings['runs']}."
    columns = ["task", "numbers", "method", "rate or radius, in σ", "loss / at the start", "steps"]
    return f"{lead}\n\n" + markdown.table(columns, rows)


def plot(record: Record) -> Figure:
    """Loss over seconds."""
    panels = {
        f"{name}: {task['numbers']} numbers": {
            method: [run["curve"] for run in found["runs"]] for method, found in task["methods"].items()
        }
        for name, task in record["tasks"].items()
    }
    return figures.curves(panels, "seconds", "loss / at the start", log="")
