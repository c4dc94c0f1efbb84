"""Tables."""

from benchmarks import markdown
from benchmarks.runner.records import Record


def table(record: Record) -> str:
    """Cuts, kills and the cost."""
    cuts = [
        [name, e["cuts"], e["resumed"], e["same_bits"], e["from_the_last_checkpoint"], e["nothing_left_over"]]
        for name, e in record["cuts"].items()
    ]
    kills = [[name, e["operations"], e["killed"], e["right"]] for name, e in record["kills"].items()]
    cost = [
        [name, e["problem"], f"{e['seconds']:.1f}", e["flushes"], f"{e['flush_seconds']:.2f}", f"{e['share']:.2%}"]
        for name, e in record["cost"].items()
    ]
    parts = [
        (["power cuts, method", "cuts", "resumed", "same bits", "from the last checkpoint", "nothing left over"], cuts),
        (["kills, command", "file operations", "killed", "as it should be"], kills),
        (["cost, method", "problem", "s of the run", "flushes", "s they took", "share"], cost),
    ]
    return "\n\n".join(markdown.table(head, [list(map(str, row)) for row in rows]) for head, rows in parts if rows)
