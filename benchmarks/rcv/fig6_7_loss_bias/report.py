"""Table and figure."""

from matplotlib.figure import Figure

from benchmarks import figures, markdown
from benchmarks.derivative_bias import METHODS
from benchmarks.runner.records import Record


def table(record: Record) -> str:
    """Fig. 7."""
    settings = record["settings"]
    rows = []
    for loss, entry in record["fig7"]["losses"].items():
        for method in METHODS:
            f = entry[method]
            rows.append(
                [
                    loss,
                    method,
                    f"{f['signed']:+.1%} ± {f['signed_error']:.1%}",
                    f"{f['rms']:.2f}",
                    f"{f['variance']:.2f}",
                ]
            )
    head = ["loss", "image", "bias of the derivative", "RMS over pixels", "variance"]
    ratio = f"The image's variance is {record['fig7']['image_variance_ratio']:.1f} × lower with the control variate."
    sizes = f"{settings['resolution']}², {settings['spp']} spp, {settings['runs']} runs, step {settings['step']}"
    sizes += "; relative to the derivative's mean."
    return f"{sizes}\n\n{markdown.table(head, rows)}\n\n{ratio}"


def plot(record: Record) -> Figure:
    """Fig. 7: the derivative of each loss, and the bias of its estimates."""
    kinds = ("reference", "plain", "rcv", "plain/bias", "debiased/bias", "rcv/bias")
    rows = [
        {f"{loss}, {kind}": record["maps"][f"{loss}/{kind}"] for kind in kinds} for loss in record["fig7"]["losses"]
    ]
    return figures.pictures(rows, signed=True)
