"""Table and figure."""

from benchmarks import figures, markdown
from benchmarks.runner.records import Record


def table(record: Record) -> str:
    """Final errors, and those of each form over Adam's."""
    blocks = []
    head = "method | rate | steps | final error (median) | at other rates | processor seconds | million paths"
    for name, entry in record["entries"].items():
        rows = []
        for found in markdown.named(entry["methods"], "method"):
            seconds, paths, _ = found["runs"][0][-1]
            whole = (w for w in found.get("whole", []) if w["rate"] != found["rate"])
            others = ", ".join(f"{w['rate']:.3g}: {w['error']:.3f}" for w in whole)
            row = markdown.fill("{method} | {rate:.3g} | {steps} | {final[0]:.3f}", found)
            rows.append([row, others, f"{seconds:.0f}", f"{paths / 1e6:.1f}"])
        text = "**`{}`**, {}², the processor time of {} steps of `meta, 1 + 2`, {} seed{}."
        seeds, size = entry["seeds"], entry["options"]["resolution"]
        over = [[*pair.split(" / "), f"{ratio:.2f}"] for pair, ratio in entry["summary"].items()]
        blocks += [
            text.format(name.partition(", ")[0], size, entry["steps"], seeds, "s" if seeds > 1 else ""),
            markdown.table(head, rows),
            "Final error over that of the other:",
            markdown.table("method | other | error ratio", over),
        ]
    return markdown.blocks(*blocks)


def plot(record: Record) -> figures.Figure:
    """Error over seconds and over paths."""
    return figures.curves(figures.error_panels(record["entries"], "processor seconds"), "", columns=2)
