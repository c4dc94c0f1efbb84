"""Table and figure."""

import numpy as np
from matplotlib.figure import Figure

from benchmarks import figures, markdown
from benchmarks.runner.records import Record


def table(record: Record) -> str:
    """Meta, Figs 3 and 4."""
    sizes = record.get("sizes") or record["settings"]
    rows = []
    for path, entry in record["paths"].items():
        for method, f in entry["methods"].items():
            q = f["predicted_over_actual"]
            error = [f"{f['error'][n] / entry['methods']['plain']['error'][n]:.2f}" for n in (len(f["error"]) // 2, -1)]
            rows.append([path, method, *error, f"{q[2]:.2f}", f"{q[0]:.2f} to {q[4]:.2f}"])
    head = [
        "parameters",
        "estimate",
        "RMSE / plain's, half way",
        "at the end",
        "predicted / actual deviation",
        "5 % to 95 % of texels and steps",
    ]
    text = f"`indirect-room`, {sizes['resolution']}², 4 paths per pixel and step, {sizes['steps']} steps, {sizes['runs']} runs."
    blocks = [text, markdown.table(head, rows)]
    if "pixels" in record:
        blocks += derivatives(record["pixels"])
    return "\n\n".join(blocks)


def derivatives(found: Record) -> list[str]:
    """The paper's own figures."""
    names = {"adam": "Adam's mean", "meta": "meta", "independent": "meta, independent statistics"}
    rows, others = [], []
    for path, entry in found["paths"].items():
        for method, f in entry["methods"].items():
            q = f["predicted_over_actual"]
            rows.append(
                [
                    path,
                    names[method],
                    *(f"{f['error'][n]:.3f}" for n in (len(f["error"]) // 2, -1)),
                    *(f"{v:.3f}" for v in f["variance_over_plain"]),
                    f"{f['lag']:.2f}",
                    f"{q[2]:.2f}",
                    f"{q[0]:.2f} to {q[4]:.2f}",
                    f"{100 * f['within_half_to_two']:.0f} %",
                ]
            )
        off = entry["alpha_off"]
        ratios = [f"{entry[f'{key}_over_actual']:.2f}" for key in ("var_f", "var_d")]
        below = f"{100 * entry['alpha_below_best']:.0f} %"
        others.append([path, *ratios, f"{off[1]:+.3f} ({off[0]:+.3f} to {off[2]:+.3f})", below])
    sizes = (
        f"Forward derivatives of pixels by the left wall's blue, {found['resolution']}², one sample per pixel and step, "
        f"{found['steps']} steps, {found['runs']} runs; errors and variances over those of one sample:"
    )
    head = ["path", "estimate", "RMSE, half way", "at the end", "variance, half way", "at the end", "lag, steps"]
    head += ["predicted / actual deviation", "5 % to 95 % of pixels and steps", "single predictions within 0.5 to 2"]
    text = "Variances that single runs estimate over the actual ones, medians, and α less the best one:"
    second = ["path", "Var F", "Var ΔF", "α off: median (5 % to 95 %)", "α below the best"]
    return [sizes, markdown.table(head, rows), text, markdown.table(second, others)]


def plot(record: Record) -> Figure:
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
