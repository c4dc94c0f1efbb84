"""Table and figure."""

from benchmarks import figures, markdown
from benchmarks.derivative_bias import METHODS
from benchmarks.runner.records import Record


def table(record: Record) -> str:
    """Fig. 7."""
    losses = {name: {method: entry[method] for method in METHODS} for name, entry in record["fig7"]["losses"].items()}
    text = "{resolution}², {spp} spp, {runs} runs, step {step}; relative to the derivative's mean."
    return markdown.blocks(
        text.format(**record["settings"]),
        markdown.records(
            "loss | image | bias of the derivative | RMS over pixels | variance",
            "{loss} | {method} | {signed:+.1%} ± {signed_error:.1%} | {rms:.2f} | {variance:.2f}",
            markdown.named(losses, "loss", "", "method"),
        ),
        f"The image's variance is {record['fig7']['image_variance_ratio']:.1f} × lower with the control variate.",
    )


def plot(record: Record) -> figures.Figure:
    """Fig. 7: the derivative of each loss, and the bias of its estimates."""
    kinds = ("reference", "plain", "rcv", "plain/bias", "debiased/bias", "rcv/bias")
    rows = [
        {f"{loss}, {kind}": record["maps"][f"{loss}/{kind}"] for kind in kinds} for loss in record["fig7"]["losses"]
    ]
    return figures.pictures(rows, signed=True)
