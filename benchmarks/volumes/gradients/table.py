"""Table."""

from benchmarks import markdown
from benchmarks.runner.records import Record


def table(record: Record) -> str:
    """z-scores."""
    settings = record["settings"]
    rows = []
    for name, e in record["directions"].items():
        value, error = e["finite differences"]
        ours, theirs = e["differential ratio tracking"], e["prbvolpath"]
        rows.append([name, f"{value:.3g} ± {error:.1g}", *(f"{v:.3g}, z {z:.1f}" for v, _, z in (ours, theirs))])
    head = ["direction", "finite differences", "here", "`prbvolpath`"]
    return f"{settings['runs']} runs of {record['spp']} spp, depth {record['depth']}.\n\n{markdown.table(head, rows)}"
