"""Tables."""

from benchmarks import markdown
from benchmarks.runner.records import Record


def table(record: Record) -> str:
    """The overhead, and what pruning saves."""
    overhead = [
        [workers, e["tasks"], f"{e['command_seconds']:.0f}", f"{e['sum_of_runs']:.0f}", f"{e['overhead']:.1%}"]
        for workers, e in record["overhead"].items()
    ]
    pruning = [
        [seed, e["pruned"], "yes" if e["same_best"] else f"no, error × {e['error_ratio']:.2f}"]
        + [f"{e[what]:.2f}" for what in ("steps", "samples", "seconds", "wall_seconds", "steps_to_best")]
        for seed, e in record["pruning"].items()
    ]
    parts = [
        (["workers", "tasks", "s of the command", "s of the runs in sum", "overhead"], overhead),
        (
            ["seed", "pruned", "same best", "steps", "paths", "s of steps", "s of runs", "steps until the best"],
            pruning,
        ),
    ]
    return "\n\n".join(markdown.table(head, [list(map(str, row)) for row in rows]) for head, rows in parts if rows)
