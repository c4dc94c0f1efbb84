"""Table and figure."""

from matplotlib.figure import Figure

from benchmarks import figures, markdown
from benchmarks.runner.records import Record


def table(record: Record) -> str:
    """Fig. 4."""
    settings = record["settings"]
    names = {"plain": "plain render", "before": "updated before use (biased)", "after": "updated after use"}
    rows = []
    for path, entry in record["paths"].items():
        for method, name in names.items():
            f = entry["methods"][method]
            converged, paired = f["converged"][-1], f["paired"][-1] if "paired" in f else None
            bias = f"{paired['signed']:+.3%} ± {paired['signed_error']:.3%}, {paired['rms']:.2%}" if paired else ""
            absolute = f"{converged['signed']:+.2%} ± {converged['signed_error']:.2%}"
            rows.append([path, name, absolute, bias, f"{f['equivalent_spp']:.0f}"])
    head = [
        "parameters",
        "statistics",
        "bias against a converged image",
        "bias, paired: mean, RMS over pixels",
        "worth plain spp",
    ]
    sizes = f"{settings['resolution']}², {settings['spp']} spp, {settings['steps']} steps, {settings['runs']} runs, `indirect-room`."
    return f"{sizes}\n\n{markdown.table(head, rows)}"


def plot(record: Record) -> Figure:
    """Mean bias over the steps, by the order of updates, and against what it is measured."""
    panels = {
        path: {
            f"{method}, {how}": figures.band(
                *zip(*((r["step"], r["signed"], r["signed_error"]) for r in rows), strict=True)
            )
            for method, entry in found["methods"].items()
            for how, rows in entry.items()
            if how in ("converged", "paired")
        }
        for path, found in record["paths"].items()
    }
    return figures.curves(panels, "step", "mean bias over the mean of the image", log="", level=0.0)
