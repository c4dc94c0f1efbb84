"""Table."""

import numpy as np

from benchmarks import markdown
from benchmarks.runner.records import Record


def table(record: Record) -> str:
    """Errors at the end."""
    rows = []
    for problem, losses in record["problems"].items():
        for loss, choices in losses.items():
            for choice, of in choices.items():
                found = [
                    markdown.median_range((float(np.median(of[what])), min(of[what]), max(of[what])))
                    if what in of
                    else "–"
                    for what in ("surface", "pictures")
                ]
                rows.append([problem, loss, choice, *found, f"{np.median(of['steps']):.0f}"])
    settings = record["settings"]
    said = (
        f"Of the start's, after {settings['seconds']:g} s of the processor, {settings['seeds']} seeds: median (least to greatest). "
        f"{settings['views']} views of {settings['resolution']}², of `shadow-art` 2."
    )
    return (
        said
        + "\n\n"
        + markdown.table(["problem", "loss", "choice", "surface error", "picture error", "steps"], rows)
        + "\n\n"
        + _means(record)
    )


def _means(record: Record) -> str:
    """Geometric means over the problems of each choice's median over that of `plain`."""
    rows = []
    pairs = sorted(
        {(loss, choice) for losses in record["problems"].values() for loss in losses for choice in losses[loss]}
    )
    for loss, choice in pairs:
        row = [loss, choice]
        for what in ("surface", "pictures"):
            ratios = [
                np.median(losses[loss][choice][what]) / np.median(losses[loss]["plain"][what])
                for losses in record["problems"].values()
                if what in losses[loss]["plain"]
            ]
            row.append(f"{np.exp(np.mean(np.log(ratios))):.3f}")
        rows.append(row)
    return "Over that of `plain`, geometric mean over problems:\n\n" + markdown.table(
        ["loss", "choice", "surface error", "picture error"], rows
    )
