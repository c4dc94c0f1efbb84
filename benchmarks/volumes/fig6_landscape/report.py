"""Table and figure."""

import numpy as np
from matplotlib.figure import Figure

from benchmarks import figures, markdown
from benchmarks.runner.records import Record


def table(record: Record) -> str:
    """Where the mean loss is least, and where its mean derivative is zero."""

    def summary(name: str, spp: str, what: str) -> str:
        place, error = record["places"][name][spp][what], record["errors"][name][spp][what]
        if place is None:
            return "outside"
        return f"{place:.3f}" + ("" if error is None else f" ± {error:.3f}")

    rows = [
        [name, spp, summary(name, spp, "least"), summary(name, spp, "stop")]
        for name, entry in record["places"].items()
        for spp in entry
    ]
    s, factors = record["settings"], record["factors"]
    head = ["loss", "spp", "mean loss least at", "mean derivative 0 at"]
    return (
        f"`three-bodies`, {s['resolution']}², {s['runs']} renders at {len(factors)} factors from {factors[0]:g} to {factors[-1]:g} of "
        f"the fog's true extinction, 1.\n\n{markdown.table(head, rows)}"
    )


def plot(record: Record) -> Figure:
    """Mean loss and mean derivative against the factor."""
    panels = {
        f"{loss}: mean {what}": {
            f"{spp} spp": figures.band(record["factors"], *np.array(rows)[:, column : column + 2].T)
            for spp, rows in by_spp.items()
        }
        for loss, by_spp in record["table"].items()
        for what, column in (("loss", 0), ("derivative", 2))
    }
    return figures.curves(panels, "factor on the fog's extinction (truth 1)", "", columns=2, log="", level=0.0)
