"""Table."""

from benchmarks import markdown
from benchmarks.runner.records import Record


def table(record: Record) -> str:
    """Meta, Figs 3 and 4."""
    settings = record["settings"]
    rows = []
    for path, entry in record["paths"].items():
        for method, f in entry["methods"].items():
            q = f["predicted_over_actual"]
            error = [f"{f['error'][n] / entry['methods']['plain']['error'][n]:.2f}" for n in (len(f["error"]) // 2, -1)]
            rows.append([path, method, *error, f"{q[2]:.2f}", f"{q[0]:.2f} to {q[4]:.2f}"])
    head = [
        "parameters",
        "estimate",
        "RMSE / plain's, half way",
        "at the end",
        "predicted / actual deviation",
        "5 % to 95 % of texels and steps",
    ]
    sizes = f"`indirect-room`, {settings['resolution']}², 4 paths per pixel and step, {settings['steps']} steps, {settings['runs']} runs."
    return f"{sizes}\n\n{markdown.table(head, rows)}"
