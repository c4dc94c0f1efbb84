"""Table and figure."""

from matplotlib.figure import Figure

from benchmarks import figures, markdown
from benchmarks.runner.records import Record


def table(record: Record) -> str:
    """Final errors, and those of each form over Adam's."""
    blocks = []
    for name, entry in record["entries"].items():
        methods = entry["methods"]
        rows = []
        for method, f in methods.items():
            end = f["runs"][0][-1]
            others = (f"{w['rate']:.3g}: {w['error']:.3f}" for w in f.get("whole", []) if w["rate"] != f["rate"])
            row = [
                method,
                f"{f['rate']:.3g}",
                str(f["steps"]),
                f"{f['final'][0]:.3f}",
                ", ".join(others),
                f"{end[0]:.0f}",
            ]
            rows.append([*row, f"{end[1] / 1e6:.1f}"])
        seeds = f"{entry['seeds']} seed{'s' if entry['seeds'] > 1 else ''}"
        blocks += [
            f"**`{name.partition(', ')[0]}`**, {entry['options']['resolution']}², the processor time of {entry['steps']} steps of "
            f"`meta, 1 + 2`, {seeds}.",
            markdown.table(
                [
                    "method",
                    "rate",
                    "steps",
                    "final error (median)",
                    "at other rates",
                    "processor seconds",
                    "million paths",
                ],
                rows,
            ),
            "Final error over that of the other:",
        ]
        over = [[*pair.split(" / "), f"{ratio:.2f}"] for pair, ratio in entry["summary"].items()]
        blocks.append(markdown.table(["method", "other", "error ratio"], over))
    return "\n\n".join(blocks)


def plot(record: Record) -> Figure:
    """Error over seconds and over paths."""
    panels = {
        f"{name}, over {unit}": {
            f"{method}, rate {found['rate']:g}": figures.points(found["runs"], column)
            for method, found in entry["methods"].items()
        }
        for name, entry in record["entries"].items()
        for column, unit in enumerate(("processor seconds", "paths"))
    }
    return figures.curves(panels, "", columns=2)
