"""Table."""

import numpy as np

from benchmarks import markdown
from benchmarks.runner.records import Record


def table(record: Record) -> str:
    """Angles and PSNR, where no shadow falls and where one may."""
    places = [name for name in ("lit", "in shadow", "all") if name in record["found"]["descent"]["angle"][0]]
    rows = []
    for name, entry in record["found"].items():
        angles = [f"{np.mean([a[place] for a in entry['angle']]):.1f}" if "angle" in entry else "" for place in places]
        psnr = [f"{np.mean([p[place] for p in entry['psnr']]):.2f}" for place in places]
        rows.append([name, *angles, *psnr])
    head = ["", *(f"angle, {place} (°)" for place in places), *(f"PSNR, {place} (dB)" for place in places)]
    training, held_out = record["lights"]
    pixels = ", ".join(f"{count} {name}" for name, count in record["pixels"].items())
    said = f"{training} lights, {held_out} held out; pixels: {pixels}. Angles are medians, to the normals of least squares."
    return f"{said}\n\n{markdown.table(head, rows)}"
