"""Table."""

import numpy as np

from benchmarks import markdown
from benchmarks.runner.records import Record


def table(record: Record) -> str:
    """Held-out PSNR of each."""
    rows = []
    for name, entry in record["found"].items():
        means = [float(np.mean(one)) for one in entry["psnr"]]
        spread = f" ± {np.std(means):.2f}" if len(means) > 1 else ""
        settings = ", ".join(f"{key} {value:g}" for key, value in entry.get("settings", {}).items())
        steps = f"{np.mean(entry['steps']):.0f}" if "steps" in entry else ""
        rows.append([name, f"{np.mean(means):.2f}{spread}", f"{min(entry['psnr'][0]):.2f}", steps, settings])
    sizes = record["sizes"]
    said = f"{sizes['views']} photographs, {sizes['held_out']} held out, {record['seconds']:g} s each."
    head = ["", "held-out PSNR (dB)", "the worst of them", "steps", "settings"]
    grid = [
        [f"{row['spp']}", f"{row['rate']:g}", f"{row['steps']}", f"{np.mean(row['psnr']):.2f}"]
        for row in record["grid"]
    ]
    tried = markdown.table(["stock loop: spp", "rate", "steps", "held-out PSNR (dB)"], grid)
    return f"{said}\n\n{markdown.table(head, rows)}\n\n{tried}"
