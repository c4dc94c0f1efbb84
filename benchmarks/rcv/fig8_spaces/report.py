"""Table and figure."""

import numpy as np
from matplotlib.figure import Figure

from benchmarks import figures, markdown
from benchmarks.runner.records import Record


def table(record: Record) -> str:
    """Fig. 8."""
    settings = record["settings"]
    rows = []
    for scene, entry in record["scenes"].items():
        for space, f in entry["summary"].items():
            ratios = (f["weight"], f["variance_ratio"], f["error_ratio_at_last"], f["image_cost"], f["step_cost"])
            rows.append([scene, space, *(f"{x:.2f}" for x in ratios)])
    head = [
        "scene",
        "space",
        "mean weight",
        "variance ÷",
        "error ÷ at the last step",
        "cost of an image",
        "cost of a step",
    ]
    sizes = f"{settings['resolution']}², {settings['spp']} spp, {settings['steps']} steps, {settings['runs']} runs"
    sizes += "; relative to a plain render."
    return f"{sizes}\n\n{markdown.table(head, rows)}"


def plot(record: Record) -> Figure:
    """Per scene: mean weight, and variance over a plain render's."""
    panels = {}
    for scene, entry in record["scenes"].items():
        spaces = {name: found for name, found in entry["methods"].items() if name != "plain"}
        plain = np.array(entry["methods"]["plain"]["variance"])
        panels[f"{scene}: weight"] = {name: figures.over_steps(found["weight"]) for name, found in spaces.items()}
        panels[f"{scene}: variance over plain"] = {
            name: figures.over_steps(np.array(found["variance"]) / plain) for name, found in spaces.items()
        }
    return figures.curves(panels, "step", "", columns=2)
