"""Table."""

from benchmarks import markdown
from benchmarks.runner.records import Record


def table(record: Record) -> str:
    """Final errors at equal time."""
    parts = []
    for kind, s in record["schedules"].items():
        rows = [
            [
                name,
                f"{e['rate']:g}",
                *("{:.3f} ({:.3f} to {:.3f})".format(*e["final"][views]) for views in ("seen", "unseen")),
                ", ".join(map(str, e["steps"])),
            ]
            for name, e in s["methods"].items()
        ]
        head = ["method", "learning rate", "error of views seen", "of views unseen", "steps"]
        parts.append(
            f"`nerf-volume`, {s['resolution']}², grids of {s['grid']}³, {kind} rates, {s['seconds']:g} s, {s['seeds']} seeds. "
            f"Errors over the initial ones.\n\n{markdown.table(head, rows)}"
        )
    return "\n\n".join(parts)
