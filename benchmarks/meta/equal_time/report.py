"""Table and figure."""

from matplotlib.figure import Figure

from benchmarks import figures, markdown
from benchmarks.runner.records import Record


def table(record: Record) -> str:
    """Meta, Figs 1, 6 and 9."""
    blocks = []
    for name, entry in record["entries"].items():
        methods, summary = entry["methods"], entry["summary"]
        rows = []
        for method, f in methods.items():
            end = f["runs"][0][-1]
            row = [
                method,
                f"{f['rate']:g}",
                f"{f['final'][0]:.3f} ({f['final'][1]:.3f} to {f['final'][2]:.3f})",
                f"{end[0]:.1f}",
            ]
            row.append(f"{end[1] / 1e6:.2f}")
            rows.append(row)
        budget = ", ".join(f"{value:g} {unit}" for unit, value in entry["budget"].items())
        head = ["method", "rate", "final error: median (range)", "seconds", "million paths"]
        lines = [
            f"**`{name}`**, {entry['options']['resolution']}², {budget}, {entry['seeds']} seeds.",
            markdown.table(head, rows),
        ]
        adam = [m for m, f in methods.items() if f["group"] == "adam"]
        reach = []
        for pair, f in summary.items():
            ours, theirs = pair.split(" / ")
            if theirs in adam[-2:] and ours in ("meta", "coupled 3 spp", "coupled 3 spp, rcv"):
                ratios = [f"{f[u]:.1f}×" if f[u] else "never" for u in ("samples_ratio", "seconds_ratio")]
                reach.append([ours, theirs, *ratios])
        lines += [
            "How many times fewer paths, and less time, until the final error of the other is reached (median run):"
        ]
        lines += [markdown.table(["method", "reaches the end of", "fewer paths", "less time"], reach)]
        blocks += lines
    return "\n\n".join(blocks)


def plot(record: Record) -> Figure:
    """Error over seconds and over paths."""
    panels = {
        f"{name}, over {unit}": {
            f"{method}, rate {found['rate']:g}": figures.points(found["runs"], column)
            for method, found in entry["methods"].items()
        }
        for name, entry in record["entries"].items()
        for column, unit in enumerate(("seconds", "paths"))
    }
    return figures.curves(panels, "", columns=2)
