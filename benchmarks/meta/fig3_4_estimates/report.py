"""Table and figure."""

import numpy as np

from benchmarks import figures, markdown
from benchmarks.runner.records import Record


def table(record: Record) -> str:
    """Meta, Figs 3 and 4."""
    rows = []
    for found in markdown.named(record["paths"], "path", "methods", "method"):
        plain = record["paths"][found["path"]]["methods"]["plain"]["error"]
        errors = (f"{found['error'][n] / plain[n]:.2f}" for n in (len(plain) // 2, -1))
        row = "{predicted_over_actual[2]:.2f} | {predicted_over_actual[0]:.2f} to {predicted_over_actual[4]:.2f}"
        rows.append([found["path"], found["method"], *errors, markdown.fill(row, found)])
    head = "parameters | estimate | RMSE / plain's, half way | at the end | predicted / actual deviation | "
    head += "5 % to 95 % of texels and steps"
    text = "`indirect-room`, {resolution}², 4 paths per pixel and step, {steps} steps, {runs} runs."
    blocks = [text.format(**(record.get("sizes") or record["settings"])), markdown.table(head, rows)]
    return markdown.blocks(*blocks, *(derivatives(record["pixels"]) if "pixels" in record else ()))


def derivatives(found: Record) -> list[str]:
    """The paper's own figures."""
    names = {"adam": "Adam's mean", "meta": "meta", "independent": "meta, independent statistics"}
    row = "{error[half]:.3f} | {error[-1]:.3f} | {variance_over_plain[0]:.3f} | {variance_over_plain[1]:.3f} | {lag:.2f} | "
    row += "{predicted_over_actual[2]:.2f} | {predicted_over_actual[0]:.2f} to {predicted_over_actual[4]:.2f} | {within:.0f} %"
    rows, others = [], []
    for path, entry in found["paths"].items():
        for method, f in entry["methods"].items():
            half = row.replace("half", str(len(f["error"]) // 2))
            rows.append([path, names[method], markdown.fill(half, f, {"within": 100 * f["within_half_to_two"]})])
        other = "{var_f_over_actual:.2f} | {var_d_over_actual:.2f} | {alpha_off[1]:+.3f} ({alpha_off[0]:+.3f} to {alpha_off[2]:+.3f})"
        others.append([path, markdown.fill(other, entry), f"{100 * entry['alpha_below_best']:.0f} %"])
    text = "Forward derivatives of pixels by the left wall's blue, {resolution}², one sample per pixel and step, "
    text += "{steps} steps, {runs} runs; errors and variances over those of one sample:"
    head = "path | estimate | RMSE, half way | at the end | variance, half way | at the end | lag, steps | predicted / actual deviation"
    return [
        text.format(**found),
        markdown.table(f"{head} | 5 % to 95 % of pixels and steps | single predictions within 0.5 to 2", rows),
        "Variances that single runs estimate over the actual ones, medians, and α less the best one:",
        markdown.table("path | Var F | Var ΔF | α off: median (5 % to 95 %) | α below the best", others),
    ]


def plot(record: Record) -> figures.Figure:
    """Error of the gradient of all texels along both paths, and pixels' estimates with the deviation that one run predicts."""
    panels = {
        f"{path}: RMSE over texels": {name: figures.over_steps(f["error"]) for name, f in found["methods"].items()}
        for path, found in record["paths"].items()
    }
    for path, found in record.get("pixels", {}).get("paths", {}).items():
        truth = np.array(found["truth"])[:, 2]
        contenders = {"true": figures.over_steps(truth)}
        for name in ("adam", "meta"):
            run, known = (np.array(found["methods"][name][key])[:, 2] for key in ("run", "run_predicted"))
            contenders[name] = figures.band(range(len(run)), run, known)
        panels[f"{path}: median pixel, derivative by blue"] = contenders
    return figures.curves(panels, "step", "", columns=2, log="")
