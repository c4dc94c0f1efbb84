"""Table and figure."""

from benchmarks import figures, markdown
from benchmarks.runner.records import Record


def table(record: Record) -> str:
    """Meta, Fig. 2."""
    horizons = [str(steps) for steps in record["settings"]["steps"]]
    cells = (f"{{{n}[rmse]:.5f}} | {{{n}[of_adam]:.2f}} | {{{n}[rate]:g}}" for n in horizons)
    return markdown.blocks(
        f"{record['settings']['seeds']} runs; each method tuned for each horizon on other seeds.",
        markdown.records(
            " | ".join(["method", *(f"RMSE after {n} steps | of Adam's | rate" for n in horizons)]),
            " | ".join(["{method}", *cells]),
            markdown.named(record["methods"], "method"),
        ),
    )


def plot(record: Record) -> figures.Figure:
    """The rate over the steps, with the range of 20 runs, and its RMSE."""
    horizon = str(record["settings"]["steps"][0])
    methods = {f"{name}, rate {entry[horizon]['rate']:g}": entry[horizon] for name, entry in record["methods"].items()}
    panels = {
        "rate, 20 runs": {name: figures.over_steps(*entry["runs"]) for name, entry in methods.items()},
        f"RMSE, tuned for {horizon} steps": {
            name: figures.over_steps(entry["curve"]) for name, entry in methods.items()
        },
    }
    return figures.curves(panels, "step", "")
