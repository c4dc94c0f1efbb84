"""Table."""

from benchmarks import markdown
from benchmarks.runner.records import Record


def table(record: Record) -> str:
    """Final errors, and those of each form over Adam's."""
    blocks = []
    for name, entry in record["entries"].items():
        methods = entry["methods"]
        rows = []
        for method, f in methods.items():
            end = f["runs"][0][-1]
            row = [method, f"{f['rate']:g}", str(f["steps"]), f"{f['final'][0]:.3f}", f"{end[0]:.0f}"]
            rows.append([*row, f"{end[1] / 1e6:.1f}"])
        seeds = f"{entry['seeds']} seed{'s' if entry['seeds'] > 1 else ''}"
        blocks += [
            f"**`{name}`**, {entry['options']['resolution']}², the processor time of {entry['steps']} steps of "
            f"`meta, 1 + 2`, {seeds}.",
            markdown.table(
                ["method", "rate", "steps", "final error (median)", "processor seconds", "million paths"], rows
            ),
            "Final error over that of the other:",
        ]
        reach = []
        for pair, f in entry["summary"].items():
            ours, theirs = pair.split(" / ")
            reach.append([ours, theirs, f"{f['error_ratio']:.2f}"])
        blocks.append(markdown.table(["method", "other", "error ratio"], reach))
    return "\n\n".join(blocks)
