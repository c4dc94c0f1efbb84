"""Table."""

from benchmarks import markdown
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
