"""Table."""

from benchmarks import markdown
from benchmarks.runner.records import Record


def table(record: Record) -> str:
    """Per task: final errors, and ratios to uniform at checkpoints."""
    parts = []
    for name, entry in record["entries"].items():
        rows = []
        for method, run in entry["methods"].items():
            rows.append([method, f"{run['rate']:g}", f"{entry['errors'][method][-1]:.3f}"])
            for ratios in entry["over uniform"].values():
                rows[-1].append(" ".join(f"{x:.2f}" for x in ratios[method]))
        head = [
            "pixels",
            "rate",
            "error at equal time",
            *(f"over uniform, at tenths of the {by}" for by in entry["over uniform"]),
        ]
        sizes = ", ".join(f"{key}={value}" for key, value in entry["options"].items())
        budget = f"{entry['steps']} steps, falling rates" if entry.get("steps") else f"{entry['seconds']:g} s"
        summary = f"{entry['count']} pixels a step, {budget}, {entry['seeds']} seeds"
        text = f"**{name}**{f' ({sizes})' if sizes else ''}, {summary}.\n\n{markdown.table(head, rows)}"
        if "time" in entry:
            found = (f"{method} {'never' if x is None else f'{x:.2f}'}" for method, x in entry["time"].items())
            text += f"\n\nTime to the least error that all reach, over that of uniform pixels: {', '.join(found)}."
        parts.append(text)
    return "\n\n".join(parts)
