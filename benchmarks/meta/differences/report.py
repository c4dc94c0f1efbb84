"""Table and figure."""

import numpy as np

from benchmarks import figures, markdown
from benchmarks.runner.records import Record


def table(record: Record) -> str:
    """Meta: variance and noise of differences."""
    variance, noise = record["variance"], record["noise"]
    first = next(iter(variance["problems"].values()))
    text = "{resolution}², {spp} spp, {runs} runs. Var ΔF / Var F by step, a share of the way to the truth:".format(
        **variance
    )
    rows = []
    for name, entry in variance["problems"].items():
        for space in ("path", "primary"):
            ratios = (f"{value / entry[space]['gradient']:.1e}" for value in entry[space]["difference"])
            rows.append([name, space, f"{entry[space]['slope']:.2f}", *ratios])
    head = ["problem | space | slope, log-log", *(f"{step:g}" for step in first["steps"])]
    parts = [text, markdown.table(" | ".join(head), rows)]
    rows = []
    for name, values in noise["problems"].items():
        of_paths = [v * n for v, n in zip(values, noise["spp"], strict=True)]
        rows.append([name, *(f"{v / of_paths[0]:.3f}" for v in of_paths)])
    text = "Var F of plain gradients times samples per pixel, over that at {spp[0]}, near the truth: what equal paths in steps of so many "
    text += "leave of noise ({resolution}², {runs} runs):"
    head = " | ".join(["problem", *(f"{n} spp" for n in noise["spp"])])
    return markdown.blocks(*parts, markdown.fill(text, noise), markdown.table(head, rows))


def plot(record: Record) -> figures.Figure:
    """Variance of the difference over that of the gradient, against the step."""
    contenders = {
        f"{name}, {space}: slope {found[space]['slope']:.2f}": [
            (found["steps"][::-1], np.array(found[space]["difference"])[::-1] / found[space]["gradient"])
        ]
        for name, found in record["variance"]["problems"].items()
        for space in ("path", "primary")
    }
    return figures.curves({"": contenders}, "step, share of the way to the truth", "Var ΔF / Var F", log="xy")
