"""Table and figure."""

import numpy as np

from benchmarks import figures, markdown
from benchmarks.runner.records import Record


def table(record: Record) -> str:
    """Where the mean loss is least, and where its mean derivative is zero."""

    def summary(name: str, spp: str, what: str) -> str:
        place, error = record["places"][name][spp][what], record["errors"][name][spp][what]
        return "outside" if place is None else f"{place:.3f}" + ("" if error is None else f" ± {error:.3f}")

    kinds = ("least", "stop")
    places = [(name, spp) for name, entry in record["places"].items() for spp in entry]
    rows = [[name, spp, *(summary(name, spp, what) for what in kinds)] for name, spp in places]
    text = "`three-bodies`, {resolution}², {runs} renders at {count} factors from {factors[0]:g} to {factors[-1]:g} of the fog's true "
    text += "extinction, 1."
    return markdown.blocks(
        markdown.fill(text, record["settings"], record, {"count": len(record["factors"])}),
        markdown.table("loss | spp | mean loss least at | mean derivative 0 at", rows),
    )


def plot(record: Record) -> figures.Figure:
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
