"""Table and figure."""

from benchmarks import figures, markdown
from benchmarks.runner.records import Record


def table(record: Record) -> str:
    """What was left of the errors, and when `auto` was where the stock loops ended."""
    rows = []
    for name, found in record["problems"].items():
        for method, of in ((method, of) for method, of in found.items() if "runs" in of):
            finals = [markdown.spread([run[what] for run in of["runs"]]) for what in ("surface", "pictures")]
            names = ("rate", "spp", "indirect", "strength") if method == "LargeSteps" else ("rate", "spp", "indirect")
            tuned = ", ".join(f"{of[name]:g}" for name in names) if "rate" in of else ""
            reached = found["seconds to the stock loops' best"] if method == "auto" else []
            when = ", ".join("never" if at is None else f"{at:.1f} s" for at in reached)
            rows.append([name, method, tuned, *finals, when])
    head = "problem | method | rate, spp, indirect spp, λ | surface error | picture error | at the best stock loop's end after"
    text = "Of the start's, after {seconds:g} s of the processor, {seeds} seeds: median (least to greatest)."
    return markdown.blocks(text.format(**record["settings"]), markdown.table(head, rows))


def plot(record: Record) -> figures.Figure:
    """Error of the surface over seconds."""
    panels = {
        name: {method: [run["curve"] for run in of["runs"]] for method, of in found.items() if "runs" in of}
        for name, found in record["problems"].items()
    }
    return figures.curves(panels, "processor seconds", "surface error / at the start")
