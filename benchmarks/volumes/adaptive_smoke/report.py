"""Table and figure."""

from matplotlib.figure import Figure

from benchmarks import figures, markdown
from benchmarks.runner.records import Record


def table(record: Record) -> str:
    """Final errors, and ratios to uniform draws."""
    rows = [
        [
            name,
            f"{e['rate']:g}",
            "{:.3f} ({:.3f} to {:.3f})".format(*e["final"]["both"]),
            *(" ".join(f"{x:.3f}" for x in ratios[name][1::3]) for ratios in record["over uniform"].values()),
        ]
        for name, e in record["methods"].items()
    ]
    s = record["settings"]
    head = [
        "pixels",
        "learning rate",
        "final error",
        *(f"over uniform, at .2 .5 .8 of the {by}" for by in record["over uniform"]),
    ]
    return (
        f"`smoke`, {s['resolution']}², grids of {s['grid']}³, {s['count']} pixels a step, L2, {s['seconds']:g} s, {s['seeds']} seeds.\n\n"
        f"{markdown.table(head, rows)}"
    )


def plot(record: Record) -> Figure:
    """Error over seconds and over paths."""
    panels = {
        f"over {unit}": {
            f"{name}: {entry['final']['both'][0]:.3f}": figures.points(entry["runs"]["both"], column)
            for name, entry in record["methods"].items()
        }
        for column, unit in enumerate(("seconds", "paths"))
    }
    return figures.curves(panels, "")
