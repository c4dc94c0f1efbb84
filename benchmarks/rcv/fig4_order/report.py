"""Table and figure."""

from benchmarks import figures, markdown
from benchmarks.runner.records import Record


def table(record: Record) -> str:
    """Fig. 4."""
    names = {"plain": "plain render", "before": "updated before use (biased)", "after": "updated after use"}
    rows = []
    for path, entry in record["paths"].items():
        for method, name in names.items():
            found = entry["methods"][method]
            absolute = "{signed:+.2%} ± {signed_error:.2%}".format(**found["converged"][-1])
            paired = "{signed:+.3%} ± {signed_error:.3%}, {rms:.2%}"
            bias = paired.format(**found["paired"][-1]) if "paired" in found else ""
            rows.append([path, name, absolute, bias, f"{found['equivalent_spp']:.0f}"])
    head = "parameters | statistics | bias against a converged image | bias, paired: mean, RMS over pixels | worth plain spp"
    text = "{resolution}², {spp} spp, {steps} steps, {runs} runs, `indirect-room`.".format(**record["settings"])
    return markdown.blocks(text, markdown.table(head, rows))


def plot(record: Record) -> figures.Figure:
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
