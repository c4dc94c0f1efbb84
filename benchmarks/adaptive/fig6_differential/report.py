"""Table and figure."""

from typing import Any

from benchmarks import figures, markdown
from benchmarks.runner.records import Record


def table(record: Record) -> str:
    """Ratios of variances, then descents."""
    s, variance = record["settings"], record["variance"]
    alphas = [f"{point['alpha']:g}" for point in next(iter(variance.values()))]
    parts = [
        "{resolution}² pixels, {spp} paths each, {runs} gradients; differential over ordinary, by alpha.".format(**s)
    ]
    kinds = {"derivative": "variance of the image's derivative", "loss": "variance of the loss's gradient"}
    for of, label in kinds.items():
        rows = [[name, *(_ratio(point[of]) for point in points)] for name, points in variance.items()]
        head = " | ".join(["scene", *alphas])
        parts += [f"**{label}** at equal paths; at equal processor time", markdown.table(head, rows)]
    every = [point[of] for points in variance.values() for point in points for of in kinds]
    worst = max(abs(entry["z"]) for entry in every)
    return markdown.blocks(
        *parts,
        f"The largest |z| of the difference of the {len(every)} pairs of means: {worst:.2f}.",
        "**descents**: {steps} steps of {count} pixels, two paths each, {seeds} seeds".format(**s),
        markdown.records(
            "scene | pixels, derivatives | error of alpha, last quarter | processor seconds a run",
            "{scene} | {kind} | {mean:.3f} ± {error:.2g} | {seconds:.1f}",
            markdown.named(record["descents"], "scene", "", "kind"),
        ),
    )


def _ratio(entry: dict[str, Any]) -> str:
    return f"{entry['ratio']:.2g} ± {entry['error']:.1g}; {entry['ratio'] * entry['cost']:.2g}"


def plot(record: Record) -> figures.Figure:
    """Error along the descents."""
    panels = {
        name: {label: figures.over_steps(entry["along"]) for label, entry in entries.items()}
        for name, entries in record["descents"].items()
    }
    return figures.curves(panels, "step", "error of alpha / at the start")
