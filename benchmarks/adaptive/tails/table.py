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
        parts.append(
            f"Variance {title}, by samples per pixel, over that of the estimator as it is: of a single step's gradient / of the "
            "mean over the steps / squared distance of that mean from the plain one's with the most samples, over what noise makes "
            "it (1: no bias)."
        )
        parts.append(_variances(record.get("variance", {}), unit))
    if "descents" in record:
        parts.append("Error after the descent, relative to the start: mean over seeds, and the largest.")
        parts.append(_descents(record["descents"]))
    return markdown.blocks(*parts)


def _variances(problems: dict[str, Any], unit: str) -> str:
    numbers = list(dict.fromkeys(n for of in problems.values() for n in of))
    rows = []
    for name, of in problems.items():
        for method in dict.fromkeys(m for each in of.values() for m in each):
            cells = [_cell(of[n], method, unit) if n in of else "-" for n in numbers]
            rows.append([f"`{name}`", method, *cells])
    return markdown.table(["problem", "", *numbers], rows)


def _cell(entries: dict[str, Any], method: str, unit: str) -> str:
    if method not in entries:
        return "-"
    found, plain = entries[method][unit], entries[PLAIN][unit]
    ratios = (found["step"][0] / plain["step"][0], found["mean"] / plain["mean"], found["distance"])
    return " / ".join(f"{ratio:.2g}" for ratio in ratios)


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
    return markdown.table(["", *(f"`{name}`, {n} spp" for name, n in columns)], rows)
