"""Table and figure."""

from matplotlib.figure import Figure

from benchmarks import figures, markdown
from benchmarks.runner.records import Record


def table(record: Record) -> str:
    """Error at equal time, and memory."""
    rows = []
    for loss, entries in record["losses"].items():
        for name, entry in entries.items():
            unchanged = entries[name.removesuffix(", changed")]["final"][0]
            middle, low, high = entry["final"]
            rows.append(
                [
                    loss.upper(), name, entry["spp"], f"{entry['rate']:g}", entry["steps"], f"{middle:.4f} ({low:.4f} to {high:.4f})",
                    f"**{middle / unchanged:.2f}**" if name.endswith("changed") else "1",
                ]
            )  # fmt: skip
    settings = record["settings"]
    parts = [
        f"`indirect-room`, {settings['resolution']}², texture {settings['texture_resolution']}², {settings['seconds']:g} s, "
        f"{settings['seeds']} seeds; error of the texture (RMSE; {record['start']:.3f} at the start), median and range.",
        markdown.table(["loss", "loop", "spp", "rate", "steps", "error", "of the unchanged"], rows),
    ]
    if "leaks" in record:
        leaks = [
            [name, entry["points"][-1][0], f"{entry['kib_per_1000_steps']:+.0f}", f"{entry['points'][1][2]} to {entry['points'][-1][2]}"]
            for name, entry in record["leaks"].items()
        ]  # fmt: skip
        head = ["loop", "steps", "KiB per 1000 steps", "lines of dr.whos"]
        parts += ["Memory of the changed loops:", markdown.table(head, leaks)]
    return "\n\n".join(parts)


def plot(record: Record) -> Figure:
    """Error over seconds, a panel for each loss."""
    panels = {
        f"{loss.upper()} loss": {
            f"{name}, {entry['spp']} spp": [
                tuple(zip((0.0, record["start"]), *run, strict=True)) for run in entry["runs"]
            ]
            for name, entry in entries.items()
        }
        for loss, entries in record["losses"].items()
    }
    return figures.curves(panels, "seconds", "RMSE of the texture", log="")
