"""Table and figure."""

from matplotlib.figure import Figure

from benchmarks import figures, markdown
from benchmarks.runner.records import Record


def table(record: Record) -> str:
    """Weights of the first value, and mean squares."""
    rows = []
    for alpha, entry in record["decays"].items():
        for name, found in entry.items():
            worst = max(
                abs(m - c) / e
                for m, c, e in zip(found["mean_square"], found["closed_form"], found["standard_error"], strict=True)
            )
            places = [n for n in (10, 50, 200) if n <= len(found["closed_form"])]
            rows.append(
                [
                    alpha,
                    name,
                    " / ".join(f"{found['first_weight'][n - 1]:.2g}" for n in places),
                    " / ".join(f"{found['mean_square'][n - 1]:.3f}" for n in places),
                    f"{worst:.1f}",
                    str(found["forgotten_after"]),
                ]
            )
    heads = [
        "α",
        "mean",
        "weight of the first value after 10 / 50 / 200",
        "mean square",
        "largest z against the closed form",
    ]
    heads += ["values until the first weighs 1 − α or less"]
    settings = record["settings"]
    return f"{settings['sequences']} sequences of normal variates.\n\n{markdown.table(heads, rows)}"


def plot(record: Record) -> Figure:
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
