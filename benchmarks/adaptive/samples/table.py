"""Table."""

from benchmarks import markdown
from benchmarks.runner.records import Record

KINDS = {"whole": "whole views", "drawn": "a quarter of the pixels", "rcv": "control variate"}


def table(record: Record) -> str:
    """Products, relative to whole views at the most samples."""
    numbers = sorted({int(n) for entry in record["problems"].values() for n in entry["whole"]})
    parts = []
    for index, about in enumerate(("plain", "in Adam's units")):
        rows = []
        for name, entry in record["problems"].items():
            unit = entry["whole"][max(entry["whole"], key=int)][index]
            for kind, title in KINDS.items():
                cells = [
                    f"{entry[kind][str(n)][index] / unit:.3g}" if str(n) in entry.get(kind, {}) else "-"
                    for n in numbers
                ]
                rows.append([name, title, *cells])
        head = ["problem", "", *(str(n) for n in numbers)]
        parts += [
            f"Variance times paths, {about}, over that of whole views at the most samples.",
            markdown.table(head, rows),
        ]
    return markdown.blocks(*parts)
