"""Table."""

import numpy as np

from benchmarks import markdown
from benchmarks.runner.records import Record


def table(record: Record) -> str:
    """Errors by fault, without and with the models of it."""
    rows = []
    for name, ways in record["faults"].items():
        for way, entry in ways.items():
            cells = [_cell(entry[key]) if key in entry else "" for key in ("colour", "light", "exposure")]
            rows.append([name, way, *cells])
    head = ["fault", "models", "base colour", "light (log)", "exposure (stops)"]
    seeds = record["settings"]["seeds"]
    said = f"{seeds} seeds, mean ± spread" if seeds > 1 else "1 seed"
    return f"{record['steps']} steps, {said}.\n\n{markdown.table(head, rows)}"


def _cell(errors: list[float]) -> str:
    spread = f" ± {np.std(errors):.4f}" if len(errors) > 1 else ""
    return f"{np.mean(errors):.4f}{spread}"
