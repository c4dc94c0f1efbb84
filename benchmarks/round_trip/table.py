"""Table."""

import numpy as np

from benchmarks import markdown
from benchmarks.runner.records import Record


def table(record: Record) -> str:
    """PSNR against the photographs and the run's own pictures, by format."""
    rows = []
    for name, entry in record["found"].items():
        own = np.array(entry["rows"]["run"]["photographs"])
        for kind, row in entry["rows"].items():
            loss = "" if kind == "run" else f"{np.max(own - np.array(row['photographs'])):.2f}"
            cells = [f"{np.mean(row[key]):.2f}" for key in ("photographs", "pictures")]
            rows.append([name, "the run (other noise)" if kind == "run" else kind, cells[0], loss, cells[1]])
    head = ["capture, unknowns", "read from", "photographs (dB)", "loss, at most (dB)", "the run's pictures (dB)"]
    said = "; ".join(
        f"{name}: {entry['training']} photographs and {entry['held_out']} held out, {entry['size']} pixels, "
        f"{entry['steps']} steps"
        for name, entry in record["found"].items()
    )
    return f"{said}. Means over held-out photographs.\n\n{markdown.table(head, rows)}"
