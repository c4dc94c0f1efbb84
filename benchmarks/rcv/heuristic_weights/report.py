"""Table and figure."""

from matplotlib.figure import Figure

from benchmarks import figures, markdown
from benchmarks.runner.records import Record


def table(record: Record) -> str:
    """Errors by rule and path."""
    settings = record["settings"]
    sizes = f"`three-bodies`, {settings['resolution']}², {settings['spp']} spp, {settings['runs']} runs"
    parts = [f"{sizes}; squared error of the image over a plain render's."]
    for name, found in record["paths"].items():
        places = [0, 1, len(found["steps"]) // 2, len(found["steps"]) - 1]
        heads = [f"step {found['steps'][place]}" for place in places]
        rows = [
            [
                rule,
                *(f"{entry['error'][place]:.3f} ± {entry['standard_error'][place]:.3f}" for place in places),
                f"{entry['weight'][-1]:.3f}",
            ]
            for rule, entry in found["rules"].items()
            if rule != "plain"
        ]
        parts.append(markdown.table([f"{name}, rule", *heads, "last weight"], rows))
    return "\n\n".join(parts)


def plot(record: Record) -> Figure:
    """Error over a plain render's, a panel per path."""
    panels = {
        name: {
            rule: figures.band(found["steps"], entry["error"], entry["standard_error"])
            for rule, entry in found["rules"].items()
        }
        for name, found in record["paths"].items()
    }
    return figures.curves(panels, "step", "squared error over a plain render's", level=1.0)
