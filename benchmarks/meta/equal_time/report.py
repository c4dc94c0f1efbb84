"""Table and figure."""

from benchmarks import figures, markdown
from benchmarks.runner.records import Record


def table(record: Record) -> str:
    """Meta, Figs 1, 6 and 9."""
    blocks = []
    for name, entry in record["entries"].items():
        methods, reach = entry["methods"], []
        rows = []
        for method, found in methods.items():
            seconds, paths, _ = found["runs"][0][-1]
            row = markdown.fill("{rate:g} | {final!m}", found)
            rows.append([method, row, f"{seconds:.1f}", f"{paths / 1e6:.2f}"])
        adam = [method for method, found in methods.items() if found["group"] == "adam"]
        for pair, found in entry["summary"].items():
            ours, theirs = pair.split(" / ")
            if theirs in adam[-2:] and ours in ("meta", "coupled 3 spp", "coupled 3 spp, rcv"):
                ratios = (found[unit] for unit in ("samples_ratio", "seconds_ratio"))
                reach.append([ours, theirs, *(f"{ratio:.1f}×" if ratio else "never" for ratio in ratios)])
        budget = ", ".join(f"{value:g} {unit}" for unit, value in entry["budget"].items())
        blocks += [
            f"**`{name}`**, {entry['options']['resolution']}², {budget}, {entry['seeds']} seeds.",
            markdown.table("method | rate | final error: median (range) | seconds | million paths", rows),
            "How many times fewer paths, and less time, until the final error of the other is reached (median run):",
            markdown.table("method | reaches the end of | fewer paths | less time", reach),
        ]
    return markdown.blocks(*blocks)


def plot(record: Record) -> figures.Figure:
    """Error over seconds and over paths."""
    return figures.curves(figures.error_panels(record["entries"]), "", columns=2)
