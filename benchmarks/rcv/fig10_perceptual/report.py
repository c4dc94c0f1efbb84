"""Table and figure."""

from benchmarks import figures, markdown
from benchmarks.derivative_bias import METHODS
from benchmarks.runner.records import Record


def table(record: Record) -> str:
    """The bias of each image."""
    text = "{resolution}², {spp} spp, {runs} runs, step {step}; relative to the derivative's mean. The network tells {accuracy:.0%} of new "
    text += "crops, by chance {chance:.0%}."
    row = "{name} | {rms:.2f} ({square:.3f} ± {square_error:.3f}) | {signed:+.1%} ± {signed_error:.1%} | {variance:.2f}"
    losses = record["bias"]["losses"]["perceptual"]
    ends = [
        [markdown.fill("{name} spp | {rate:g} | {final!m}", entry), f"{entry['runs'][0][-1][1] / 1e6:.1f}"]
        for entry in markdown.named(record["tasks"]["cornell-box"]["methods"], "name")
    ]
    return markdown.blocks(
        markdown.fill(text, record["settings"], record["network"]),
        markdown.records(
            "image | bias, RMS over pixels (its square) | mean bias | variance",
            row,
            markdown.named({method: losses[method] for method in METHODS}, "name"),
        ),
        "Descents of {steps} steps, {seeds} seeds:".format(**record["settings"]),
        markdown.table("image | rate | final error of the wall (range) | million paths", ends),
    )


def plot(record: Record) -> figures.Figure:
    """The walls that descents find, and the bias of the derivative."""
    maps, ends = record["maps"], record["tasks"]["cornell-box"]["methods"]
    walls = {f"{name} spp: {entry['final'][0]:.2f}": maps[f"wall/{name}"] for name, entry in ends.items()}
    bias = {f"bias, {method}": maps[f"perceptual/{method}/bias"] for method in METHODS}
    return figures.pictures([{"reference": maps["wall/reference"], **walls}, bias], signed=True)
