"""Table."""

from __future__ import annotations

from benchmarks import markdown
from benchmarks.runner.records import Record


def table(record: Record) -> str:
    """Seconds to the first step, and where they go."""
    rows = []
    for name, entry in record["problems"].items():
        cold, warm = entry["cold"], entry["warm"]
        rows.append([
            name, f"{warm['seconds']:.1f}", f"{warm['loading']:.1f}", f"{warm['compiling']:.1f}", f"{cold['seconds']:.1f}",
            f"{cold['reference images']:.1f}", f"{cold['compiling']:.1f}",
        ])  # fmt: skip
    head = ["problem", "warm, s", "of that loading", "compiling", "cold, s", "of that reference images", "compiling"]
    worst = {kind: max(entry[kind]["seconds"] for entry in record["problems"].values()) for kind in ("warm", "cold")}
    return "\n\n".join(
        [
            "Seconds from typing the command to its first step. Cold: empty cache, kernels compiled and reference images rendered.",
            markdown.table(head, rows),
            f"At most {worst['warm']:.1f} s warm, {worst['cold']:.1f} s cold.",
        ]
    )
