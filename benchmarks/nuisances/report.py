"""Table."""

import numpy as np

from benchmarks import markdown
from benchmarks.runner.records import Record

_KEYS = ("colour", "light", "exposure", "vignetting", "response", "poses")


def table(record: Record) -> str:
    """Errors by nuisance, without and with the models of it."""
    rows = []
    for name, ways in record["faults"].items():
        for way, entry in ways.items():
            cells = (_cell(entry[key], 2 if key == "poses" else 4) if key in entry else "" for key in _KEYS)
            rows.append([name, way, *cells])
    head = (
        "nuisance | models | base colour | light (log) | exposure (stops) | vignetting (stops) | response | poses (°)"
    )
    seeds = record["settings"]["seeds"]
    said = f"{seeds} seeds, mean ± spread" if seeds > 1 else "1 seed"
    text = f"{record['steps']} steps, photographs of {record['size']}², {said}."
    return markdown.blocks(text, markdown.table(head, rows))


def _cell(errors: list[float], digits: int) -> str:
    spread = f" ± {np.std(errors):.{digits}f}" if len(errors) > 1 else ""
    return f"{np.mean(errors):.{digits}f}{spread}"
