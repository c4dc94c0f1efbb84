"""Tables."""

from __future__ import annotations

from typing import Any

import numpy as np

from benchmarks import markdown
from benchmarks.runner.records import Record

PLAIN = "as it is"
TITLES = {"plain": "as a plain sum", "adam": "in Adam's units"}


def table(record: Record) -> str:
    """Variances over those of the estimator as it is, of a step and of the mean of steps, and ends of descents."""
    parts = []
    for unit, title in TITLES.items():
        for key, what in (("step", "of a single step"), ("mean", "of the mean over the steps")):
            parts.append(f"Variance {title}, {what}, over that of the estimator as it is with as many samples.")
            parts.append(_variances(record["variance"], unit, key))
    parts.append(
        "Squared distance of the mean gradient from the plain one's, over what noise makes it, in Adam's units."
    )
    parts.append(_variances(record["variance"], "adam", "distance"))
    if "descents" in record:
        parts.append("Error after the descent, relative to the start: mean over seeds, and the largest.")
        parts.append(_descents(record["descents"]))
    return markdown.blocks(*parts)


def _variances(problems: dict[str, Any], unit: str, key: str) -> str:
    def value(entry: Any) -> float:
        found = entry[unit][key]
        return found[0] if isinstance(found, list) else found

    columns = [(name, n) for name, of in problems.items() for n in of]
    names = list(dict.fromkeys(m for of in problems.values() for each in of.values() for m in each))
    rows = []
    for method in names:
        if method == PLAIN and key != "distance":
            continue
        cells = []
        for name, n in columns:
            entry = problems[name][n]
            over = 1.0 if key == "distance" else value(entry[PLAIN])
            cells.append(f"{value(entry[method]) / over:.2g}" if method in entry else "-")
        rows.append([method, *cells])
    return markdown.table(["", *(f"{name}, {n}" for name, n in columns)], rows)


def _descents(problems: dict[str, Any]) -> str:
    columns = [(name, n) for name, of in problems.items() for n in of]
    names = list(dict.fromkeys(m for of in problems.values() for each in of.values() for m in each))
    rows = []
    for method in names:
        cells = []
        for name, n in columns:
            entry = problems[name][n].get(method)
            cells.append(f"{np.mean(entry['errors']):.3f} ({max(entry['errors']):.3f})" if entry else "-")
        rows.append([method, *cells])
    return markdown.table(["", *(f"{name}, {n}" for name, n in columns)], rows)
