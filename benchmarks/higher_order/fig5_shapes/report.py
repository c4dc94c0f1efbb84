"""Table and figure."""

from benchmarks import figures, markdown
from benchmarks.runner.records import Record


def table(record: Record) -> str:
    """What was left of the loss."""
    rows = []
    for found in markdown.named(record["tasks"], "task", "methods", "method"):
        finals = ", ".join(f"{run['final']:.3f}" for run in found["runs"])
        steps = ", ".join(str(run["steps"]) for run in found["runs"])
        rows.append([markdown.fill("{task} | {numbers} | {method} | {setting:g}", found), finals, steps])
    text = "{views} views of {resolution}², {seconds:g} s of the processor, runs: {runs}."
    head = "task | numbers | method | rate or radius, in σ | loss / at the start | steps"
    return markdown.blocks(text.format(**record["settings"]), markdown.table(head, rows))


def plot(record: Record) -> figures.Figure:
    """Loss over seconds."""
    panels = {
        f"{name}: {task['numbers']} numbers": {
            method: [run["curve"] for run in found["runs"]] for method, found in task["methods"].items()
        }
        for name, task in record["tasks"].items()
    }
    return figures.curves(panels, "seconds", "loss / at the start", log="")
