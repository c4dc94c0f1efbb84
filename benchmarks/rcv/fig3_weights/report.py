"""Table and figure."""

from matplotlib.figure import Figure

from benchmarks import figures, markdown
from benchmarks.runner.records import Record


def table(record: Record) -> str:
    """Fig. 3."""
    settings = record["settings"]
    rows = [
        [
            rule,
            f"{f['variance'][2]:.3f}",
            f"{f['weight'][-1]:.3f}",
            f"{f['variance'][-1]:.4f}",
            f"{f['bias']:+.2%} ± {f['bias_error']:.2%}",
        ]
        for rule, f in record["rules"].items()
    ]
    sizes = f"{settings['resolution']}², {settings['spp']} spp, {settings['steps']} steps, {settings['runs']} runs"
    return (
        f"{sizes}; at the last step but where it says otherwise, variance relative to one render's.\n\n"
        + markdown.table(["rule", "variance after 3 renders", "weight", "variance", "bias"], rows)
    )


def plot(record: Record) -> Figure:
    """Weights and variance over the steps."""
    steps, rules = range(record["settings"]["steps"]), record["rules"]
    panels = {
        "weight": {rule: figures.over_steps(found["weight"]) for rule, found in rules.items()},
        "variance over one render's": {
            rule: figures.band(steps, found["variance"], found["variance_error"]) for rule, found in rules.items()
        },
    }
    return figures.curves(panels, "step", "")
