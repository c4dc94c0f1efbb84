"""Table and figure."""

from benchmarks import figures, markdown
from benchmarks.runner.records import Record


def table(record: Record) -> str:
    """Final errors, and ratios to uniform draws."""
    over = record["over uniform"]
    rows = [
        [
            markdown.fill("{name} | {rate:g} | {final[both]!m}", entry),
            *(" ".join(f"{x:.3f}" for x in ratios[entry["name"]][1::3]) for ratios in over.values()),
        ]
        for entry in markdown.named(record["methods"], "name")
    ]
    head = ["pixels | learning rate | final error", *(f"over uniform, at .2 .5 .8 of the {by}" for by in over)]
    text = "`smoke`, {resolution}², grids of {grid}³, {count} pixels a step, L2, {seconds:g} s, {seeds} seeds."
    return markdown.blocks(text.format(**record["settings"]), markdown.table(" | ".join(head), rows))


def plot(record: Record) -> figures.Figure:
    """Error over seconds and over paths."""
    panels = {
        f"over {unit}": {
            f"{name}: {entry['final']['both'][0]:.3f}": figures.points(entry["runs"]["both"], column)
            for name, entry in record["methods"].items()
        }
        for column, unit in enumerate(("seconds", "paths"))
    }
    return figures.curves(panels, "")
