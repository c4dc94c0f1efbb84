"""Table and figure."""

import numpy as np

from benchmarks import figures, markdown
from benchmarks.adaptive.equal_time.run import timed
from benchmarks.runner.records import Record


def table(record: Record) -> str:
    """All races in one table; then per task final errors, and ratios to uniform at checkpoints."""
    parts = [all_races(record)]
    for name, entry in record["entries"].items():
        over = entry["over uniform"]
        rows = []
        for method, run in entry["methods"].items():
            ratios = (" ".join(f"{x:.2f}" for x in of[method]) for of in over.values())
            rows.append([method, f"{run['rate']:g}", f"{entry['errors'][method][-1]:.3f}", *ratios])
        head = " | ".join(
            ["pixels | rate | error at equal time", *(f"over uniform, at tenths of the {by}" for by in over)]
        )
        sizes = ", ".join(f"{key}={value}" for key, value in entry["options"].items())
        budget = f"{entry['steps']} steps, falling rates" if entry.get("steps") else f"{entry['seconds']:g} s"
        summary = f"{entry['count']} pixels a step, {budget}, {entry['seeds']} seeds"
        parts += [f"**{name}**{f' ({sizes})' if sizes else ''}, {summary}.", markdown.table(head, rows)]
        if "time" in entry:
            found = (f"{method} {'never' if x is None else f'{x:.2f}'}" for method, x in entry["time"].items())
            parts.append(f"Time to the least error that all reach, over that of uniform pixels: {', '.join(found)}.")
    return markdown.blocks(*parts)


def all_races(record: Record) -> str:
    """Of each race: errors of Eq. 5 and adaptive pixels over uniform ones' at its end, and the time to the least error that all reach."""
    rows, ends = [], []
    for name, entry in record["entries"].items():
        over, time = entry["over uniform"], entry.get("time", {}).get("adaptive")
        pairs = [(by, method) for by in ("time", "samples") for method in ("loss", "adaptive")]
        cells = (f"{over[by][method][-1]:.2f}" if method in over[by] else "–" for by, method in pairs)
        rows.append([name, *cells, f"{time:.2f}" if time else "–"])
        if not name.startswith("mirror-trio"):
            ends.append(over["time"]["adaptive"][-1])
    head = "race | Eq. 5, equal time | adaptive, equal time | Eq. 5, equal samples | adaptive, equal samples | time"
    mean = float(np.exp(np.log(ends).mean()))
    return markdown.blocks(
        "**All races**: error at the end over that of uniform pixels, and the time of adaptive pixels to the least error that all reach "
        f"over theirs. Geometric mean of adaptive pixels at equal time: {mean:.2f}, without `mirror-trio`, whose error crosses 0.",
        markdown.table(head, rows),
    )


def plot(record: Record) -> figures.Figure:
    """Error over seconds."""
    panels = {
        name: {
            f"{method}: {entry['errors'][method][-1]:.3f}": figures.points(runs)
            for method, runs in timed(entry["methods"], record["seconds_per_path"][name]).items()
        }
        for name, entry in record["entries"].items()
    }
    return figures.curves(panels, "seconds")
