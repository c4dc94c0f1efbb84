"""Table."""

from benchmarks import markdown
from benchmarks.runner.records import Record


def table(record: Record) -> str:
    """Variance times evaluations over that of the plain estimator."""
    settings = record["settings"]
    problems = record["problems"]
    names = list(next(iter(next(iter(problems.values())).values())))
    head = ["", *(f"{problem}: {order}" for problem, orders in problems.items() for order in orders)]
    rows = [
        [name, *(f"{orders[order][name]:.2g}" for orders in problems.values() for order in orders)] for name in names
    ]
    return (
        f"{settings['runs']} runs of {settings['samples']} evaluations; below 1 pays.\n\n{markdown.table(head, rows)}"
    )
