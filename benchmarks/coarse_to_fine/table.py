"""Table."""

import numpy as np

from benchmarks import markdown
from benchmarks.runner.records import Record


def table(record: Record) -> str:
    """Errors at the end, by what becomes of states."""
    settings = record["settings"]
    rows = []
    for name, entry in record["problems"].items():
        for by, ways in entry["methods"].items():
            for key in next(iter(ways.values()))["errors"]:
                summary = [
                    f"{np.mean(way['errors'][key]):.4f} ± {np.std(way['errors'][key]):.4f}, {way['jump']:.2f}"
                    for way in ways.values()
                ]
                rows.append([f"{name}, {by}", key, *summary])
    head = ["problem, method", "parameter", *next(iter(next(iter(record["problems"].values()))["methods"].values()))]
    sizes = "; ".join(
        f"`{name}`: {entry['steps']} steps, finer at {entry['changes'][0]} and {entry['changes'][1]}"
        for name, entry in record["problems"].items()
    )
    return f"{sizes}; {settings['seeds']} seeds. Error, mean ± spread, and the jump of the loss.\n\n{markdown.table(head, rows)}"
