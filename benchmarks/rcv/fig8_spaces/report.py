"""Table and figure."""

import numpy as np

from benchmarks import figures, markdown
from benchmarks.runner.records import Record


def table(record: Record) -> str:
    """Fig. 8."""
    text = "{resolution}², {spp} spp, {steps} steps, {runs} runs; relative to a plain render."
    fields = ("weight", "variance_ratio", "error_ratio_at_last", "image_cost", "step_cost")
    return markdown.blocks(
        text.format(**record["settings"]),
        markdown.records(
            "scene | space | mean weight | variance ÷ | error ÷ at the last step | cost of an image | cost of a step",
            " | ".join(["{scene} | {space}", *(f"{{{field}:.2f}}" for field in fields)]),
            markdown.named(record["scenes"], "scene", "summary", "space"),
        ),
    )


def plot(record: Record) -> figures.Figure:
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
