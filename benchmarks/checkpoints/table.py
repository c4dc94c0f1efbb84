"""Table."""

from benchmarks import markdown
from benchmarks.runner.records import Record


def table(record: Record) -> str:
    """The share of the run."""
    settings = record["settings"]
    rows = []
    for name, entry in record["cases"].items():
        e = entry[str(settings["steps"])] if str(settings["steps"]) in entry else next(iter(entry.values()))
        size = f"{e['bytes'] / 1e6:.2f}"
        rows.append([name, f"{e['step_ms']:.1f}", f"{e['checkpoint_ms']:.0f}", size, f"{e['share_checkpoints']:.2%}"])
    return markdown.table(["case", "ms a step", "ms a checkpoint", "MB", "share of the run"], rows)
