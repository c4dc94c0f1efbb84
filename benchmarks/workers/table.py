"""Tables."""

from benchmarks import markdown
from benchmarks.runner.records import Record


def table(record: Record) -> str:
    """One for each part that was measured."""
    parts = []
    if record["same"]:
        rows = [[name, f"{row['relative']:.1e}"] for name, row in record["same"].items()]
        parts.append(markdown.table(["workers", "parameters apart from one process's, relative"], rows))
    if record["efficiency"]:
        rows = [
            [count, f"{1e3 * row['one_process']:.0f}", f"{1e3 * row['workers']:.0f}", f"{1e3 * row['busy']:.0f}"]
            for count, row in record["efficiency"].items()
        ]
        names = [
            "n",
            "ms a step, one process of n threads",
            "n workers of one thread",
            "of these, the slowest worker's own",
        ]
        parts.append(markdown.table(names, rows))
    if record["link"]:
        rows = [
            [
                name,
                *(f"{row[key] / 1e6:.2f}" for key in ("sent", "received")),
                f"{1e3 * row['seconds']:.0f}",
                f"{row['wire_share']:.0%}",
            ]
            for name, row in record["link"].items()
        ]
        parts.append(
            markdown.table(["parameters", "MB sent a step", "MB received", "ms a step", "share on the wire"], rows)
        )
    if record["kills"]:
        rows = [
            [name, str(row["kills"]), str(row["right"]), f"{row['longest_wait']:.0f}"]
            for name, row in record["kills"].items()
        ]
        parts.append(markdown.table(["method", "kills", "ended with the same bits", "longest wait (s)"], rows))
        kinds = [row for of in record["kills"].values() for row in of["rows"]]
        waits = [
            [kind, str(len(of)), str(sum(row["right"] for row in of)), f"{max(row['wait'] for row in of):.0f}"]
            for kind in dict.fromkeys(row["kind"] for row in kinds)
            if (of := [row for row in kinds if row["kind"] == kind])
        ]
        parts.append(
            markdown.table(["what was killed", "times", "ended with the same bits", "longest wait (s)"], waits)
        )
    if record.get("stragglers"):
        rows = [
            [name, "yes" if row["right"] else "no", str(row["moved"]), f"{row['wait']:.0f}"]
            for name, row in record["stragglers"].items()
        ]
        names = ["method, one worker at a tenth of its speed", "same bits", "times moved", "longest wait (s)"]
        parts.append(markdown.table(names, rows))
    return "\n\n".join(parts)
