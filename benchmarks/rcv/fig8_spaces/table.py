"""Table."""

from benchmarks import markdown
from benchmarks.runner.records import Record


def table(record: Record) -> str:
    """Fig. 8."""
    settings = record["settings"]
    rows = []
    for scene, entry in record["scenes"].items():
        for space, f in entry["summary"].items():
            ratios = (f["weight"], f["variance_ratio"], f["error_ratio_at_last"], f["image_cost"], f["step_cost"])
            rows.append([scene, space, *(f"{x:.2f}" for x in ratios)])
    head = [
        "scene",
        "space",
        "mean weight",
        "variance ÷",
        "error ÷ at the last step",
        "cost of an image",
        "cost of a step",
    ]
    sizes = f"{settings['resolution']}², {settings['spp']} spp, {settings['steps']} steps, {settings['runs']} runs"
    sizes += "; relative to a plain render."
    return f"{sizes}\n\n{markdown.table(head, rows)}"
