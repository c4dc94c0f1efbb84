"""Table."""

import numpy as np

from benchmarks import markdown
from benchmarks.runner.records import Record


def table(record: Record) -> str:
    """What was left of the errors."""
    rows = []
    for name, of in record["methods"].items():
        finals = [
            markdown.median_range((float(np.median(values)), min(values), max(values)))
            for values in ([run[what] for run in of["runs"]] for what in ("surface", "pictures"))
        ]
        rows.append([name, f"{of['rate']:g}", *finals])
    settings = record["settings"]
    said = (
        f"Of the start's, after {settings['seconds']:g} s of the processor, {settings['seeds']} seeds: median (least to greatest). "
        f"{settings['views']} views of {settings['resolution']}², mini-batches of {settings['pixels']} pixels, {settings['spp']} spp."
    )
    return said + "\n\n" + markdown.table(["pixels", "rate", "surface error", "picture error"], rows)
