"""Table."""

from benchmarks import markdown
from benchmarks.runner.records import Record


def table(record: Record) -> str:
    """Per entrant: errors, seconds, and what these are over uniform mini-batches'."""
    rows = []
    for name, entry in record["methods"].items():
        seconds = sorted(run[-1][0] for run in entry["runs"]["seen"])
        time = record.get("time", {}).get(name)
        rows.append(
            [
                name,
                f"{entry['rate']:g}",
                *("{:.3f} ({:.3f} to {:.3f})".format(*entry["final"][group]) for group in ("seen", "unseen")),
                f"{seconds[len(seconds) // 2]:.1f}",
                "" if time is None else f"{time:.2f}",
                " ".join(f"{x:.2f}" for x in record.get("over uniform", {}).get("time", {}).get(name, [])),
            ]
        )
    c = record["conditions"]
    head = [
        "pixels",
        "rate",
        "error, views seen",
        "unseen",
        "processor seconds",
        "time to the worse of both ends, over uniform's",
        "error over uniform's, at tenths of the time",
    ]
    doublings = ", ".join(map(str, c["changes"]))
    text = (
        f"8³ to {c['grid_resolution']}³, doubled before steps {doublings}; {c['views'] - 4} views of {c['resolution']}², {c['count']} "
        f"pixels and {c['steps']} steps; medians and ranges of {c['seeds']} seeds."
    )
    return markdown.blocks(text, markdown.table(head, rows))
