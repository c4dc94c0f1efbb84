"""Table and figure."""

from benchmarks import figures, markdown
from benchmarks.runner.records import Record


def table(record: Record) -> str:
    """Errors by rule and path."""
    text = "`three-bodies`, {resolution}², {spp} spp, {runs} runs; squared error of the image over a plain render's."
    parts = [text.format(**record["settings"])]
    for name, found in record["paths"].items():
        places = [0, 1, len(found["steps"]) // 2, len(found["steps"]) - 1]
        heads = (f"step {found['steps'][place]}" for place in places)
        cells = (f"{{error[{place}]:.3f}} ± {{standard_error[{place}]:.3f}}" for place in places)
        head = " | ".join([f"{name}, rule", *heads, "last weight"])
        row = " | ".join(["{rule}", *cells, "{weight[-1]:.3f}"])
        rules = (entry for entry in markdown.named(found["rules"], "rule") if entry["rule"] != "plain")
        parts.append(markdown.records(head, row, rules))
    return markdown.blocks(*parts)


def plot(record: Record) -> figures.Figure:
    """Error over a plain render's, a panel per path."""
    panels = {
        name: {
            rule: figures.band(found["steps"], entry["error"], entry["standard_error"])
            for rule, entry in found["rules"].items()
        }
        for name, found in record["paths"].items()
    }
    return figures.curves(panels, "step", "squared error over a plain render's", level=1.0)
