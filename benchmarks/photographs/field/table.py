"""Table."""

from benchmarks import markdown
from benchmarks.runner.records import Record

HEAD = [
    "capture, voxels",
    "",
    "minutes",
    "held-out PSNR on the way (minutes)",
    "held-out PSNR (dB)",
    "training PSNR (dB)",
    "steps",
]


def table(record: Record) -> str:
    """Held-out PSNR of each by processor minutes."""
    rows = []
    for name, capture in record["captures"].items():
        for entrant, found in capture["methods"].items():
            curve = found["curve"]
            way = ", ".join(f"{point[1]:.2f} ({point[0]:.1f})" for point in curve[:-2])
            end, held_out, training = (f"{x:.{digits}f}" for x, digits in zip(curve[-1], (1, 2, 2), strict=True))
            steps = ", ".join(f"{stage}: {count}" for stage, count in found["steps"].items())
            row = [f"{name}³", entrant, end, way, held_out, training, steps]
            rows.append(row)
    return markdown.table(HEAD, rows)
