"""Table."""

from typing import Any

from benchmarks import markdown
from benchmarks.runner.records import Record


def table(record: Record) -> str:
    """Per problem, then the summary."""
    settings = record["settings"]
    problems = record["problems"]
    steps = [str(point["step"]) for point in next(iter(problems.values()))["points"]]
    parts = [
        f"{settings['spp']} samples per pixel, {settings['runs']} gradients of each; plain / relative, ± is of the relative one. Steps are "
        "those done before; λ is the share of the scene's own probabilities at each."
    ]
    for name, title in (("adaptive", "by the gradient's variance"), ("power", "by power")):
        rows = [
            [key, entry["emitters"], *(_cell(point, name) for point in entry["points"])]
            for key, entry in problems.items()
        ]
        parts += [f"**{title}**, variance over uniform's", markdown.table(["problem", "emitters", *steps], rows)]
    rows = []
    for name, summary in record["summary"].items():
        worst = [f"{ratio:.2f} ± {error:.1g}" for ratio, error in summary["worst"]]
        rows.append([name, summary["problems"], *(f"{mean:.2f}" for mean in summary["mean"]), *worst])
    head = ["emitters by", "problems", "geometric mean at the end, plain", "relative", "worst of all steps, plain"]
    cost = [
        [key, *(f"{entry['cost'][kind]:.2f}" for kind in ("gradient", "descent"))] for key, entry in problems.items()
    ]
    return markdown.blocks(
        *parts,
        markdown.table([*head, "relative"], rows),
        "Processor time over uniform draws'",
        markdown.table(["problem", "a gradient with tables", "steps with all that is learnt"], cost),
    )


def _cell(point: dict[str, Any], name: str) -> str:
    (plain, relative), (_, error) = point[name]
    shown = f"{plain:.2f} / {relative:.2f} ± {error:.1g}"
    return f"{shown}, λ {point['uniform']:.2g}" if name == "adaptive" else shown
