"""Table."""

from benchmarks import markdown
from benchmarks.runner.records import Record


def table(record: Record) -> str:
    """Time per step relative to being alone."""
    rows = [
        [kind, f"{ratio['median']:.3f} ± {ratio['standard_error']:.3f}"] for kind, ratio in record["ratios"].items()
    ]
    share = record["processor_share"]
    summary = ", ".join(f"{name} {value:.1%}" for name, value in share.items())
    return f"{markdown.table(['with', 'time of a step, relative to alone'], rows)}\n\nShare of both processors, page open: {summary}."
