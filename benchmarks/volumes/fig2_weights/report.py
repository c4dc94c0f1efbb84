"""Table and figure."""

from matplotlib.figure import Figure

from benchmarks import figures, markdown
from benchmarks.runner.records import Record


def table(record: Record) -> str:
    """Along one descent."""
    steps = [n for n in (1, 5, 20, 50, 100, 200, 500) if n < len(record["weight"])] + [len(record["weight"]) - 1]
    rows = [
        [
            str(n),
            f"{record['weight'][n]:.3f}",
            f"{record['weight_10_50_90'][1][n]:.3f}",
            f"{record['variance_ratio'][n]:.3f} ± {record['variance_ratio_error'][n]:.3f}",
        ]
        for n in steps
    ]
    keys = list(record["errors"]["rcv"])
    ends = [[method, *(_median(runs[key]) for key in keys)] for method, runs in record["errors"].items()]
    s = record["settings"]
    return (
        f"`three-bodies`, {s['resolution']}², {s['spp']} spp, L1, Adam at {s['rate']:g}, {s['steps']} steps; weights and variance over "
        f"{s['runs']} runs along one descent's path.\n\n"
        f"{markdown.table(['step', 'weight, mean over pixels', 'median', 'variance over that of a plain render'], rows)}\n\n"
        f"Errors over the initial ones, mean of the last fifth of the steps: median of {s['seeds']} seeds (range).\n\n"
        f"{markdown.table(['image', *keys], ends)}"
    )


def _median(runs: list[list[float]]) -> str:
    last = sorted(sum(run[-(len(run) // 5) :]) / (len(run) // 5) for run in runs)
    return f"{last[len(last) // 2]:.3f} ({last[0]:.3f} to {last[-1]:.3f})"


def plot(record: Record) -> Figure:
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
