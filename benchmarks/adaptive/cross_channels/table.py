"""Table."""

from benchmarks import markdown
from benchmarks.runner.records import Record

FORMS = ("Eq. 5", "summed, many", "between colours, many", "summed, few", "between colours, few")


def table(record: Record) -> str:
    """Per problem: variances over uniform pixels', the two forms' ratio, and Eq. 5 over each."""
    rows, gains = [], []
    for name, entry in record["problems"].items():
        variance = entry["variance"]
        ratios = [entry[f"between over summed, {kind}"] for kind in ("many", "few")]
        rows.append([name, *(f"{variance[form][0]:.3f}" for form in FORMS)])
        rows[-1] += ["{:.3f} ± {:.3f}".format(*ratio) for ratio in ratios]
        made = (form for form in variance if form not in ("uniform", "Eq. 5"))
        gains.append(
            f"`{name}`: " + ", ".join(f"{form} {variance['Eq. 5'][0] / variance[form][0]:.2f}" for form in made)
        )
    head = ["problem", *FORMS, "between colours over summed, many", "few"]
    return markdown.blocks(
        "Variance of one draw over a uniform one's.",
        markdown.table(head, rows),
        f"Variance of Eq. 5 over: {'; '.join(gains)}.",
    )
