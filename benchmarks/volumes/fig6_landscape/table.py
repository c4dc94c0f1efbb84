"""Table."""

from benchmarks import markdown
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
