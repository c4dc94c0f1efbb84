"""Table."""

from benchmarks import markdown
from benchmarks.runner.records import Record


def table(record: Record) -> str:
    """Per entrant: errors, seconds, and what these are over uniform mini-batches'."""
    rows = []
    for entry in markdown.named(record["methods"], "name"):
        seconds, time = sorted(run[-1][0] for run in entry["runs"]["seen"]), record.get("time", {}).get(entry["name"])
        over = record.get("over uniform", {}).get("time", {}).get(entry["name"], [])
        row = markdown.fill("{name} | {rate:g} | {final[seen]!m} | {final[unseen]!m}", entry)
        at_end = "" if time is None else f"{time:.2f}"
        rows.append([row, f"{seconds[len(seconds) // 2]:.1f}", at_end, " ".join(f"{x:.2f}" for x in over)])
    head = "pixels | rate | error, views seen | unseen | processor seconds | time to the worse of both ends, over uniform's"
    head += " | error over uniform's, at tenths of the time"
    c = record["conditions"]
    text = (
        f"8³ to {c['grid_resolution']}³, doubled before steps {', '.join(map(str, c['changes']))}; {c['views'] - 4} views of "
        f"{c['resolution']}², {c['count']} pixels and {c['steps']} steps; medians and ranges of {c['seeds']} seeds."
    )
    return markdown.blocks(text, markdown.table(head, rows))
