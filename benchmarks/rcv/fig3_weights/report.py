"""Table and figure."""

from benchmarks import figures, markdown
from benchmarks.runner.records import Record


def table(record: Record) -> str:
    """Fig. 3."""
    text = "{resolution}², {spp} spp, {steps} steps, {runs} runs; at the last step but where it says otherwise, variance relative to one "
    text += "render's."
    return markdown.blocks(
        text.format(**record["settings"]),
        markdown.records(
            "rule | variance after 3 renders | weight | variance | bias",
            "{rule} | {variance[2]:.3f} | {weight[-1]:.3f} | {variance[-1]:.4f} | {bias:+.2%} ± {bias_error:.2%}",
            markdown.named(record["rules"], "rule"),
        ),
    )


def plot(record: Record) -> figures.Figure:
    """Weights and variance over the steps."""
    steps, rules = range(record["settings"]["steps"]), record["rules"]
    panels = {
        "weight": {rule: figures.over_steps(found["weight"]) for rule, found in rules.items()},
        "variance over one render's": {
            rule: figures.band(steps, found["variance"], found["variance_error"]) for rule, found in rules.items()
        },
    }
    return figures.curves(panels, "step", "")
