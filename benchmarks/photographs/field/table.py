"""Table."""

from benchmarks import markdown
from benchmarks.runner.records import Record


def table(record: Record) -> str:
    """Held-out PSNR of each by processor minutes."""
    rows = []
    for name, capture in record["captures"].items():
        for entrant, found in capture["methods"].items():
            curve = found["curve"]
            middle = min(curve, key=lambda point: abs(point[0] - capture["minutes"] / 2))
            steps = ", ".join(f"{stage}: {count}" for stage, count in found["steps"].items())
            rows.append(
                [f"{name}³", entrant, f"{curve[-1][0]:.1f}", f"{middle[1]:.2f} ({middle[0]:.1f})", f"{curve[-1][1]:.2f}", f"{curve[-1][2]:.2f}", steps]
            )  # fmt: skip
    head = ["capture, voxels", "", "minutes", "held-out PSNR (dB) on the way (minutes)", "held-out PSNR (dB)", "training PSNR (dB)", "steps"]  # fmt: skip
    return markdown.table(head, rows)
