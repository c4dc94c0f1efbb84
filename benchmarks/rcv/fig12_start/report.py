"""Table and figure."""

from benchmarks import figures, markdown
from benchmarks.runner.records import Record


def table(record: Record) -> str:
    """Weights of the first value, and mean squares."""
    rows = []
    for found in markdown.named(record["decays"], "alpha", "", "name"):
        columns = (found[key] for key in ("mean_square", "closed_form", "standard_error"))
        worst = max(abs(m - c) / e for m, c, e in zip(*columns, strict=True))
        places = [n for n in (10, 50, 200) if n <= len(found["closed_form"])]
        weights = " / ".join(f"{found['first_weight'][n - 1]:.2g}" for n in places)
        squares = " / ".join(f"{found['mean_square'][n - 1]:.3f}" for n in places)
        rows.append([found["alpha"], found["name"], weights, squares, f"{worst:.1f}", found["forgotten_after"]])
    head = "α | mean | weight of the first value after 10 / 50 / 200 | mean square | largest z against the closed form"
    head += " | values until the first weighs 1 − α or less"
    return markdown.blocks(
        f"{record['settings']['sequences']} sequences of normal variates.", markdown.table(head, rows)
    )


def plot(record: Record) -> figures.Figure:
    """Mean squares of the two means, beside their closed forms."""
    panels = {
        f"α = {alpha}": {
            f"{name}, {kind}": figures.over_steps(found[key])
            for name, found in entry.items()
            for kind, key in (("measured", "mean_square"), ("closed form", "closed_form"))
        }
        for alpha, entry in record["decays"].items()
    }
    return figures.curves(panels, "n", "mean square")
