"""Table."""

from benchmarks import markdown
from benchmarks.runner.records import Record


def table(record: Record) -> str:
    """Variance times evaluations over that of the plain estimator."""
    problems = record["problems"]
    names = list(next(iter(next(iter(problems.values())).values())))
    head = ["", *(f"{problem}: {order}" for problem, orders in problems.items() for order in orders)]
    rows = [
        [name, *(f"{cuts[name]:.2g}" for orders in problems.values() for cuts in orders.values())] for name in names
    ]
    text = "{runs} runs of {samples} evaluations; below 1 pays.".format(**record["settings"])
    return markdown.blocks(text, markdown.table(" | ".join(head), rows))
