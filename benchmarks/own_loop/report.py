"""Table and figure."""

from benchmarks import figures, markdown
from benchmarks.runner.records import Record


def table(record: Record) -> str:
    """Error at equal time."""
    rows = []
    for entry in markdown.named(record["losses"], "loss", "", "name"):
        name, (middle, low, high) = entry["name"], entry["final"]
        unchanged = record["losses"][entry["loss"]][name.removesuffix(", changed")]["final"][0]
        ratio = f"**{middle / unchanged:.2f}**" if name.endswith("changed") else "1"
        row = markdown.fill("{name} | {spp} | {rate:g} | {steps}", entry)
        rows.append([entry["loss"].upper(), row, f"{middle:.4f} ({low:.4f} to {high:.4f})", ratio])
    text = "`indirect-room`, {resolution}², texture {texture_resolution}², {seconds:g} s, {seeds} seeds; error of the texture (RMSE; "
    text += "{start:.3f} at the start), median and range."
    return markdown.blocks(
        markdown.fill(text, record, record["settings"]),
        markdown.table("loss | loop | spp | rate | steps | error | of the unchanged", rows),
    )


def plot(record: Record) -> figures.Figure:
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
