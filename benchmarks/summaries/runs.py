"""The life of a run."""

from __future__ import annotations

from typing import Any

import numpy as np

from summaries.tables import table

CHECKPOINTS = """\
One checkpoint in fifty steps, written to the disk and waited for; the machine was busy. `quad` has no renderer, and
steps of a tenth of a millisecond: there a checkpoint costs more than two hundredths. The default writes less often
where it would."""

WATCHING = """\
Blocks by turns: alone, with the live files, with the page open in a browser. The page costs
nothing that shows: the run keeps its speed within 3 %."""


COARSE = """\
Counts are of steps, so the machine's load does not matter. The default carries what the estimator remembers and
begins the optimizer's state anew. A whole texture, seen well from the start, gains nothing by being coarse at first; the smoke's
extinction does."""


def coarse_to_fine(found: dict[str, Any]) -> str:
    """Errors at the end, by what becomes of states."""
    rows = []
    for name, entry in found["problems"].items():
        for by, ways in entry["methods"].items():
            for key in next(iter(ways.values()))["errors"]:
                told = [
                    f"{np.mean(way['errors'][key]):.4f} ± {np.std(way['errors'][key]):.4f}, {way['jump']:.2f}"
                    for way in ways.values()
                ]
                rows.append([f"{name}, {by}", key, *told])
    head = ["problem, method", "parameter", *next(iter(next(iter(found["problems"].values()))["methods"].values()))]
    sizes = "; ".join(
        f"`{name}`: {entry['steps']} steps, finer at {entry['changes'][0]} and {entry['changes'][1]}"
        for name, entry in found["problems"].items()
    )
    return f"{sizes}; {found['seeds']} seeds. Error, mean ± spread, and the jump of the loss.\n\n{table(head, rows)}"


def checkpoints(found: dict[str, Any]) -> str:
    """The share of the run."""
    rows = []
    for name, entry in found["cases"].items():
        e = entry[str(found["steps"])] if str(found["steps"]) in entry else next(iter(entry.values()))
        size = f"{e['bytes'] / 1e6:.2f}"
        rows.append([name, f"{e['step_ms']:.1f}", f"{e['checkpoint_ms']:.0f}", size, f"{e['share_checkpoints']:.2%}"])
    return table(["case", "ms a step", "ms a checkpoint", "MB", "share of the run"], rows)


def watching(found: dict[str, Any]) -> str:
    """Time per step relative to being alone."""
    rows = [[kind, f"{ratio['median']:.3f} ± {ratio['standard_error']:.3f}"] for kind, ratio in found["ratios"].items()]
    share = found["processor_share"]
    told = ", ".join(f"{name} {value:.1%}" for name, value in share.items())
    return (
        f"{table(['with', 'time of a step, relative to alone'], rows)}\n\nShare of both processors, page open: {told}."
    )
