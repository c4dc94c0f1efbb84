"""Table and figure."""

import numpy as np
from matplotlib.figure import Figure

from benchmarks import figures, markdown
from benchmarks.runner.records import Record


def table(record: Record) -> str:
    """Meta: variance and cost of differences."""
    variance = record["variance"]
    rows = []
    for name, entry in variance["problems"].items():
        for space in ("path", "primary"):
            f = entry[space]
            ratios = [f"{v / f['gradient']:.1e}" for v in f["difference"]]
            rows.append([name, space, f"{f['slope']:.2f}", *ratios])
    steps = next(iter(variance["problems"].values()))["steps"]
    sizes = f"{variance['resolution']}², {variance['spp']} spp, {variance['runs']} runs."
    sizes += " Var ΔF / Var F by step, a share of the way to the truth:"
    first = markdown.table(["problem", "space", "slope, log-log", *(f"{s:g}" for s in steps)], rows)
    blocks = [sizes, first]
    for size, cost in record["cost"].items():
        keys = list(next(iter(cost.values())))
        blocks.append(f"Whole estimates of all views (`chalice` has two) and their parts for one view, at {size}²:")
        blocks.append(
            markdown.table(
                ["milliseconds", *cost], [[key, *(f"{cost[name][key]:.2f}" for name in cost)] for key in keys]
            )
        )
    if "noise" in record:
        found = record["noise"]
        blocks.append(
            f"Var F of plain gradients times samples per pixel, over that at {found['spp'][0]}, near the truth: what equal paths in "
            f"steps of so many leave of noise ({found['resolution']}², {found['runs']} runs):"
        )
        rows = []
        for name, values in found["problems"].items():
            of_paths = [v * n for v, n in zip(values, found["spp"], strict=True)]
            rows.append([name, *(f"{v / of_paths[0]:.3f}" for v in of_paths)])
        blocks.append(markdown.table(["problem", *(f"{n} spp" for n in found["spp"])], rows))
    return "\n\n".join(blocks)


def plot(record: Record) -> Figure:
    """Variance of the difference over that of the gradient, against the step."""
    contenders = {
        f"{name}, {space}: slope {found[space]['slope']:.2f}": [
            (found["steps"][::-1], np.array(found[space]["difference"])[::-1] / found[space]["gradient"])
        ]
        for name, found in record["variance"]["problems"].items()
        for space in ("path", "primary")
    }
    return figures.curves({"": contenders}, "step, share of the way to the truth", "Var ΔF / Var F", log="xy")
