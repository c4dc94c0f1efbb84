"""Table and figure."""

from benchmarks import figures, markdown
from benchmarks.runner.records import Record


def table(record: Record) -> str:
    """Along one descent."""
    last = len(record["weight"]) - 1
    row = "{0} | {{weight[{0}]:.3f}} | {{weight_10_50_90[1][{0}]:.3f}} | {{variance_ratio[{0}]:.3f}} ± {{variance_ratio_error[{0}]:.3f}}"
    rows = [
        [markdown.fill(row.format(n), record)] for n in (1, 5, 20, 50, 100, 200, 500, last) if n < last or n == last
    ]
    keys = list(record["errors"]["rcv"])
    ends = [[method, *(_median(runs[key]) for key in keys)] for method, runs in record["errors"].items()]
    text = "`three-bodies`, {resolution}², {spp} spp, L1, Adam at {rate:g}, {steps} steps; weights and variance over {runs} runs along one "
    text += "descent's path."
    seeds = record["settings"]["seeds"]
    return markdown.blocks(
        text.format(**record["settings"]),
        markdown.table("step | weight, mean over pixels | median | variance over that of a plain render", rows),
        f"Errors over the initial ones, mean of the last fifth of the steps: median of {seeds} seeds (range).",
        markdown.table(" | ".join(["image", *keys]), ends),
    )


def _median(runs: list[list[float]]) -> str:
    last = sorted(sum(run[-(len(run) // 5) :]) / (len(run) // 5) for run in runs)
    return markdown.median_range((last[len(last) // 2], last[0], last[-1]))


def plot(record: Record) -> figures.Figure:
    """Weight, variance over a plain render's, and a panel for each parameter."""
    steps = range(len(record["weight"]))
    panels = {
        "control weight": {"mean": figures.over_steps(record["weight"])},
        "variance over a plain render's": {
            "control variate": figures.band(steps, record["variance_ratio"], record["variance_ratio_error"])
        },
    }
    for key in record["errors"]["rcv"]:
        panels[f"error of {key.split('.')[0]}"] = {
            method: figures.over_steps(*runs[key]) for method, runs in record["errors"].items()
        }
    return figures.curves(panels, "step", "", columns=3)
