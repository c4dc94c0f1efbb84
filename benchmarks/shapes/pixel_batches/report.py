"""Table and figure."""

from benchmarks import figures, markdown
from benchmarks.runner.records import Record


def table(record: Record) -> str:
    """What was left of the errors, and the gradient's variance."""
    rows = []
    for problem, found in record["problems"].items():
        uniform = found["methods"].get("uniform", {}).get("variance", 0.0)
        for name, of in found["methods"].items():
            values = ([run[what] for run in of["runs"] if what in run] for what in ("surface", "pictures"))
            finals = (markdown.spread(each) if each else "–" for each in values)
            noise = f"{of['variance'] / uniform:.3g}" if uniform else "–"
            rows.append([problem, name, f"{of['rate']:g}", *finals, noise])
    text = (
        "Of the start's, after {seconds:g} s of the processor, {seeds} seeds: median (least to greatest). "
        "Views of {resolution}², mini-batches of {pixels} pixels, {spp} spp. "
        "Variance of the gradient at the start, over that of uniform mini-batches."
    )
    head = "problem | pixels | rate | surface error | picture error | variance"
    return markdown.blocks(text.format(**record["settings"]), markdown.table(head, rows))


def plot(record: Record) -> figures.Figure:
    """Error of the surface over seconds, of the problems where it is known."""
    panels = {
        name: {method: [run["curve"] for run in entry["runs"]] for method, entry in found["methods"].items()}
        for name, found in record["problems"].items()
        if found["judged by"] == "surface"
    }
    return figures.curves(panels, "processor seconds", "surface error / at the start")
