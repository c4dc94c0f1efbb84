"""Table and figure."""

from typing import Any

from matplotlib.figure import Figure

from benchmarks import figures, markdown
from benchmarks.runner.records import Record


def table(record: Record) -> str:
    """Ratios of variances, then descents."""
    s, variance = record["settings"], record["variance"]
    alphas = [f"{point['alpha']:g}" for point in next(iter(variance.values()))]
    parts = [
        f"{s['resolution']}² pixels, {s['spp']} paths each, {s['runs']} gradients; differential over ordinary, by alpha."
    ]
    for label, of in (
        ("variance of the image's derivative", "derivative"),
        ("variance of the loss's gradient", "loss"),
    ):
        rows = [[name, *(_ratio(point[of]) for point in points)] for name, points in variance.items()]
        parts += [f"**{label}** at equal paths; at equal processor time", markdown.table(["scene", *alphas], rows)]
    worst = max(
        abs(point[of]["z"]) for points in variance.values() for point in points for of in ("derivative", "loss")
    )
    count = 2 * sum(map(len, variance.values()))
    parts.append(f"The largest |z| of the difference of the {count} pairs of means: {worst:.2f}.")
    rows = [
        [name, kind, f"{entry['mean']:.3f} ± {entry['error']:.2g}", f"{entry['seconds']:.1f}"]
        for name, entries in record["descents"].items()
        for kind, entry in entries.items()
    ]
    head = ["scene", "pixels, derivatives", "error of alpha, last quarter", "processor seconds a run"]
    parts += [
        f"**descents**: {s['steps']} steps of {s['count']} pixels, two paths each, {s['seeds']} seeds",
        markdown.table(head, rows),
    ]
    return markdown.blocks(*parts)


def _ratio(entry: dict[str, Any]) -> str:
    return f"{entry['ratio']:.2g} ± {entry['error']:.1g}; {entry['ratio'] * entry['cost']:.2g}"


def plot(record: Record) -> Figure:
    """Error along the descents."""
    panels = {
        name: {label: figures.over_steps(entry["along"]) for label, entry in entries.items()}
        for name, entries in record["descents"].items()
    }
    return figures.curves(panels, "step", "error of alpha / at the start")
