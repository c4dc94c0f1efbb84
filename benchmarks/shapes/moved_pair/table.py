"""Table."""

import numpy as np

from benchmarks import markdown
from benchmarks.runner.records import Record


def table(record: Record) -> str:
    """Variances, and descents."""
    moves = record["settings"]["moves"]
    rows = []
    for scene, of in record["scenes"].items():
        for space, found in of.items():
            slope = np.polyfit(np.log(moves), np.log(found["geometric"]), 1)[0] if len(moves) > 1 else np.nan
            ends = [f"{found[what][n]:.2g}" for what in ("sum", "geometric") for n in (0, -1)]
            weights = [f"{found['weight'][n]:.3f}" for n in (0, -1)]
            rows.append([scene, space, *ends, f"{slope:.2f}", *weights, f"{found['cost']:.2f}"])
    head = ["scene", "space", *(f"{what}, {moves[n]:g}" for what in ("sum", "geometric mean") for n in (0, -1))]
    head += ["slope", *(f"weight, {moves[n]:g}" for n in (0, -1)), "cost"]
    descents = []
    for name, of in record["descents"].items():
        plain = record["descents"]["plain," + name.split(",")[1]]
        errors = ", ".join(f"{x:.3f}" for x in of["errors"])
        descents.append([name, errors, f"{of['step'] / plain['step']:.2f}"])
    samples = record["settings"]["samples"]
    said = f"Var[F - H] / Var F, {samples} samples; slope: power of the step that the geometric mean falls with."
    return "\n\n".join(
        [
            said,
            markdown.table(head, rows),
            f"`sphere-to-bunny`, L1, {record['settings']['steps']} steps.",
            markdown.table(["image, spp", "surface error / start's", "processor time of a step"], descents),
        ]
    )
