"""Table and figure."""

import numpy as np

from benchmarks import figures, markdown
from benchmarks.runner.records import Record


def table(record: Record) -> str:
    """Meta, Figs 3 and 4."""
    names = {"adam": "Adam's mean", "meta": "meta", "independent": "meta, independent statistics"}
    row = "{error[half]:.3f} | {error[-1]:.3f} | {variance_over_plain[0]:.3f} | {variance_over_plain[1]:.3f} | {lag:.2f} | "
    row += "{predicted_over_actual[2]:.2f} | {predicted_over_actual[0]:.2f} to {predicted_over_actual[4]:.2f} | {within:.0f} %"
    rows, others = [], []
    for path, entry in record["paths"].items():
        for method, f in entry["methods"].items():
            half = row.replace("half", str(len(f["error"]) // 2))
            rows.append([path, names[method], markdown.fill(half, f, {"within": 100 * f["within_half_to_two"]})])
        other = "{var_f_over_actual:.2f} | {var_d_over_actual:.2f} | {alpha_off[1]:+.3f} ({alpha_off[0]:+.3f} to {alpha_off[2]:+.3f})"
        others.append([path, markdown.fill(other, entry), f"{100 * entry['alpha_below_best']:.0f} %"])
    text = "Forward derivatives of pixels by the left wall's blue, {resolution}², one sample per pixel and step, "
    text += "{steps} steps, {runs} runs; errors and variances over those of one sample:"
    head = "path | estimate | RMSE, half way | at the end | variance, half way | at the end | lag, steps | predicted / actual deviation"
    return markdown.blocks(
        text.format(**record["settings"]),
        markdown.table(f"{head} | 5 % to 95 % of pixels and steps | single predictions within 0.5 to 2", rows),
        "Variances that single runs estimate over the actual ones, medians, and α less the best one:",
        markdown.table("path | Var F | Var ΔF | α off: median (5 % to 95 %) | α below the best", others),
    )


def plot(record: Record) -> figures.Figure:
    """Error over all pixels, and the estimates of the median pixel with the deviation that one run predicts."""
    panels = {}
    for path, found in record["paths"].items():
        methods = found["methods"]
        panels[f"{path}: RMSE / one sample's"] = {name: figures.over_steps(f["error"]) for name, f in methods.items()}
        truth = np.array(found["truth"])[:, 2]
        panels[f"{path}: median pixel, derivative by blue"] = {"true": figures.over_steps(truth)}
        for name in ("adam", "meta"):
            run, known = (np.array(methods[name][key])[:, 2] for key in ("run", "run_predicted"))
            panels[f"{path}: median pixel, derivative by blue"][name] = figures.band(range(len(run)), run, known)
    return figures.curves(panels, "step", "", columns=2, log="")
