"""Table."""

from benchmarks import markdown
from benchmarks.runner.records import Record


def table(record: Record) -> str:
    """What the owner waits for, and the run's speed."""
    names = {"owner": "the owner alone", "crowd": "with the strangers"}
    rows = [
        [names[mode], f"{of['median']:.3f} s", f"{of['longest']:.3f} s", str(of["count"])]
        for mode, of in record["waits"].items()
    ]
    speed, crowd = record["speed"], record["crowd"]
    summary = (
        f"Speed of the run with the strangers, relative to without: {speed['median']:.3f} ± {speed['standard_error']:.3f}. "
        f"Connected in the mean: {crowd['idle']:.0f} idle, {crowd['busy']:.0f} busy, {crowd['answered']:.0f} refusals a second."
    )
    return f"{markdown.table(['the page is asked for by', 'median wait', 'longest', 'times'], rows)}\n\n{summary}"
